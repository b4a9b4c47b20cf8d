/* {{ title }}: what the FMU knows of the model in model.c. */
#ifndef {{ guard }}
#define {{ guard }}

#if !defined FMI2_OVERRIDE_FUNCTION_PREFIX && !defined {{ name }}_EXPORTS
#define FMI2_FUNCTION_PREFIX {{ name }}_
#endif

#define MODEL_GUID "{{ guid }}"
#define MODEL_SAMPLE_TIME {{ sample_time }}
#define MODEL_PARAMETERS {{ parameters }}
#define MODEL_MOTION {{ motion }}
#define MODEL_STATES {{ states }}
#define MODEL_INPUTS {{ inputs }}
#define MODEL_SWITCHES {{ switches }}
#define MODEL_OUTPUTS {{ outputs }}

/* parameters, start of the motion, inputs */
static const double model_start[] = {
{% for value in start %}    {{ value }},
{% endfor %}};

#define MODEL_BEGIN {{ name }}_model_begin
#define MODEL_STEP {{ name }}_model_step
#define MODEL_READ {{ name }}_model_read

int {{ name }}_model_begin(const double **given, double **found, int *, double *, int);
int {{ name }}_model_step(const double **given, double **found, int *, double *, int);
int {{ name }}_model_read(const double **given, double **found, int *, double *, int);

#endif
