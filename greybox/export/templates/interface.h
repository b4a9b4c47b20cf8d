/* {{ title }}
 *
 * One step of {{ sample_time }} s of the identified model: {{ structure }}, {{ integrator }},
 * parameters baked in. Plain C (C89 and later), no memory allocation, no globals: as many ships
 * as you have states, from as many threads.
 *
{% for line in equations %} *   {{ line }}
{% endfor %} *
{% for line in notes %} * Note: {{ line }}.
{% endfor %} * Angles in rad and not wrapped; forward, starboard and clockwise positive; x_n, y_n north and east.
 */
#ifndef {{ guard }}
#define {{ guard }}

#ifdef __cplusplus
extern "C" {
#endif

/* seconds between two steps */
#define {{ upper }}_SAMPLE_TIME {{ sample_time }}
#define {{ upper }}_STATES {{ states | length }}
/* the first of the states, that a user sets */
#define {{ upper }}_MOTION {{ motion }}
#define {{ upper }}_INPUTS {{ inputs | length }}
#define {{ upper }}_OUTPUTS {{ outputs | length }}

/* Where the ship is{% if states | length > motion %}, and what its thrusters remember{% endif %}. */
typedef struct {
{% for id, port in states %}    double {{ id }}; /* {{ port }} */
{% endfor %}} {{ name }}_state;

/* What acts during a step: held from this sample to the next. */
typedef struct {
{% for id, port in inputs %}    double {{ id }}; /* {{ port }} */
{% endfor %}} {{ name }}_input;

/* What can be read at a sample. */
typedef struct {
{% for id, port in outputs %}    double {{ id }}; /* {{ port }} */
{% endfor %}} {{ name }}_output;

/* The names as they stand in the model file, in the order of the structures. */
extern const char *const {{ name }}_state_names[{{ upper }}_STATES];
extern const char *const {{ name }}_input_names[{{ upper }}_INPUTS];
extern const char *const {{ name }}_output_names[{{ upper }}_OUTPUTS];

/* Begin a run: keeps the motion that you have set, and puts what the thrusters remember at rest
 * on the first commands. */
void {{ name }}_begin({{ name }}_state *state, const {{ name }}_input *first);

/* Make one step; `next` may be `state`. */
void {{ name }}_step(const {{ name }}_state *state, const {{ name }}_input *input,
    {{ name }}_state *next);

/* Read the outputs at this sample. */
void {{ name }}_read(const {{ name }}_state *state, const {{ name }}_input *input,
    {{ name }}_output *output);

#ifdef __cplusplus
}
#endif

#endif
