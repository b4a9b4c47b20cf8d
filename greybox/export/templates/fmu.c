/* An FMU for co-simulation (FMI 2.0) around the model in model.c.
 *
 * The model steps on a grid of its own, one sample time apart, from the start of the experiment.
 * At each instant of the grid it takes its inputs as they are and holds them to the next. A
 * communication step may be longer, shorter or no multiple of the sample time: between two
 * instants of the grid the motion is interpolated linearly. */
#include "model.h"
#include "fmi2.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define FIRST_START MODEL_PARAMETERS
#define FIRST_INPUT (FIRST_START + MODEL_MOTION)
#define FIRST_OUTPUT (FIRST_INPUT + MODEL_INPUTS)
#define REALS (FIRST_OUTPUT + MODEL_OUTPUTS)
/* an array has at least one element */
#define BOOLEANS (MODEL_SWITCHES ? MODEL_SWITCHES : 1)
/* share of a sample by which times of the simulator may differ from the grid, and share of
 * themselves to which large times, such as seconds since 1970, are exact */
#define NEAR 1e-6
#define EXACT 1e-15

enum { INSTANTIATED, INITIALISING, STEPPING, TERMINATED, FAILED };

typedef struct {
    fmi2Real real[REALS];
    fmi2Boolean choice[BOOLEANS];
    /* states at this instant of the grid, and at the next where it was stepped to */
    double now[MODEL_STATES], next[MODEL_STATES];
    /* time at which the grid begins, and that the simulator has reached [s] */
    double start, time;
    /* this instant, counted, and the share of the step after it that has passed */
    double instant, share;
    int begun, ahead, phase;
} Data;

typedef struct {
    Data data;
    const fmi2CallbackFunctions *callbacks;
    char *name;
    fmi2Boolean logging;
} Instance;

typedef struct {
    char guid[sizeof MODEL_GUID];
    Data data;
} Saved;

static fmi2Status tell(Instance *of, fmi2Status status, const char *message)
{
    if (of->callbacks->logger && (of->logging || status >= fmi2Error))
        of->callbacks->logger(of->callbacks->componentEnvironment, of->name, status,
            "logStatusError", "%s", message);
    return status;
}

static fmi2Status refuse(Instance *of, const char *function, const char *why)
{
    char message[300];
    sprintf(message, "%.60s: %.200s", function, why);
    return tell(of, fmi2Error, message);
}

static void call(int (*function)(const double **, double **, int *, double *, int),
    const Data *data, const double *state, double *result)
{
    double choice[BOOLEANS];
    const double *given[4];
    double *found[1];
    int i;
    for (i = 0; i < BOOLEANS; i++)
        choice[i] = data->choice[i] ? 1 : 0;
    given[0] = state;
    given[1] = data->real + FIRST_INPUT;
    given[2] = choice;
    given[3] = data->real;
    found[0] = result;
    function(given, found, 0, 0, 0);
}

/* Share of a sample within which two times are the same instant. */
static double near_at(double time)
{
    return NEAR + EXACT * (time < 0 ? -time : time) / MODEL_SAMPLE_TIME;
}

static void reset(Data *data)
{
    memset(data, 0, sizeof *data);
    memcpy(data->real, model_start, sizeof model_start);
}

static void set_start(Data *data)
{
    memcpy(data->now, data->real + FIRST_START, MODEL_MOTION * sizeof(double));
}

/* Make the step that follows the present instant. */
static int look_ahead(Data *data)
{
    int i, finite = 1;
    if (!data->begun) {
        double rest[MODEL_STATES];
        call(MODEL_BEGIN, data, data->now, rest);
        memcpy(data->now, rest, sizeof rest);
        data->begun = 1;
    }
    call(MODEL_STEP, data, data->now, data->next);
    for (i = 0; i < MODEL_STATES; i++)
        finite = finite && data->next[i] - data->next[i] == 0;
    data->ahead = 1;
    return finite;
}

static void update_outputs(Data *data)
{
    double state[MODEL_STATES];
    int i;
    if (data->phase == INSTANTIATED || data->phase == INITIALISING)
        set_start(data);
    memcpy(state, data->now, sizeof state);
    if (data->ahead && data->share > 0)
        for (i = 0; i < MODEL_MOTION; i++)
            state[i] += data->share * (data->next[i] - data->now[i]);
    call(MODEL_READ, data, state, data->real + FIRST_OUTPUT);
}

FMI2(const char *, fmi2GetTypesPlatform)(void)
{
    return "default";
}

FMI2(const char *, fmi2GetVersion)(void)
{
    return "2.0";
}

FMI2(fmi2Status, fmi2SetDebugLogging)(fmi2Component c, fmi2Boolean on, size_t count,
    const fmi2String categories[])
{
    (void)count;
    (void)categories;
    ((Instance *)c)->logging = on;
    return fmi2OK;
}

FMI2(fmi2Component, fmi2Instantiate)(fmi2String name, fmi2Type type, fmi2String guid,
    fmi2String resources, const fmi2CallbackFunctions *callbacks, fmi2Boolean visible,
    fmi2Boolean logging)
{
    Instance *of;
    const char *why = 0;
    (void)resources;
    (void)visible;
    if (!callbacks)
        return 0;
    if (!name || !*name)
        why = "fmi2Instantiate: the instance has no name";
    else if (type != fmi2CoSimulation)
        why = "fmi2Instantiate: this FMU is for co-simulation only";
    else if (!guid || strcmp(guid, MODEL_GUID))
        why = "fmi2Instantiate: modelDescription.xml has another GUID than the binary";
    of = why ? 0 : calloc(1, sizeof *of);
    if (of && (of->name = malloc(strlen(name) + 1)) == 0) {
        free(of);
        of = 0;
    }
    if (!of) {
        if (callbacks->logger)
            callbacks->logger(callbacks->componentEnvironment, name ? name : "?", fmi2Error,
                "logStatusError", "%s", why ? why : "fmi2Instantiate: no memory");
        return 0;
    }
    strcpy(of->name, name);
    of->callbacks = callbacks;
    of->logging = logging;
    reset(&of->data);
    return of;
}

FMI2(void, fmi2FreeInstance)(fmi2Component c)
{
    if (c) {
        free(((Instance *)c)->name);
        free(c);
    }
}

FMI2(fmi2Status, fmi2SetupExperiment)(fmi2Component c, fmi2Boolean tolerance_defined,
    fmi2Real tolerance, fmi2Real start, fmi2Boolean stop_defined, fmi2Real stop)
{
    Instance *of = c;
    (void)tolerance_defined;
    (void)tolerance;
    (void)stop_defined;
    (void)stop;
    if (of->data.phase != INSTANTIATED)
        return refuse(of, "fmi2SetupExperiment", "the initialisation has begun");
    of->data.start = of->data.time = start;
    return fmi2OK;
}

FMI2(fmi2Status, fmi2EnterInitializationMode)(fmi2Component c)
{
    Instance *of = c;
    if (of->data.phase != INSTANTIATED)
        return refuse(of, "fmi2EnterInitializationMode", "the instance was initialised before");
    of->data.phase = INITIALISING;
    return fmi2OK;
}

FMI2(fmi2Status, fmi2ExitInitializationMode)(fmi2Component c)
{
    Instance *of = c;
    if (of->data.phase != INITIALISING)
        return refuse(of, "fmi2ExitInitializationMode", "the instance is not being initialised");
    set_start(&of->data);
    of->data.phase = STEPPING;
    return fmi2OK;
}

FMI2(fmi2Status, fmi2Terminate)(fmi2Component c)
{
    ((Instance *)c)->data.phase = TERMINATED;
    return fmi2OK;
}

FMI2(fmi2Status, fmi2Reset)(fmi2Component c)
{
    reset(&((Instance *)c)->data);
    return fmi2OK;
}

FMI2(fmi2Status, fmi2GetReal)(fmi2Component c, const fmi2ValueReference vr[], size_t count,
    fmi2Real value[])
{
    Instance *of = c;
    size_t i;
    int fresh = 0;
    for (i = 0; i < count; i++) {
        if (vr[i] >= REALS)
            return refuse(of, "fmi2GetReal", "there is no such value reference");
        if (vr[i] >= FIRST_OUTPUT && !fresh) {
            update_outputs(&of->data);
            fresh = 1;
        }
        value[i] = of->data.real[vr[i]];
    }
    return fmi2OK;
}

FMI2(fmi2Status, fmi2SetReal)(fmi2Component c, const fmi2ValueReference vr[], size_t count,
    const fmi2Real value[])
{
    Instance *of = c;
    size_t i;
    for (i = 0; i < count; i++) {
        if (vr[i] >= FIRST_OUTPUT)
            return refuse(of, "fmi2SetReal", "only parameters and inputs can be set");
        if (vr[i] >= FIRST_START && vr[i] < FIRST_INPUT && of->data.phase > INITIALISING)
            return refuse(of, "fmi2SetReal", "the start is set before the initialisation ends");
    }
    for (i = 0; i < count; i++)
        of->data.real[vr[i]] = value[i];
    return fmi2OK;
}

FMI2(fmi2Status, fmi2GetBoolean)(fmi2Component c, const fmi2ValueReference vr[], size_t count,
    fmi2Boolean value[])
{
    Instance *of = c;
    size_t i;
    for (i = 0; i < count; i++) {
        if (vr[i] + 1 > MODEL_SWITCHES)
            return refuse(of, "fmi2GetBoolean", "there is no such value reference");
        value[i] = of->data.choice[vr[i]];
    }
    return fmi2OK;
}

FMI2(fmi2Status, fmi2SetBoolean)(fmi2Component c, const fmi2ValueReference vr[], size_t count,
    const fmi2Boolean value[])
{
    Instance *of = c;
    size_t i;
    for (i = 0; i < count; i++) {
        if (vr[i] + 1 > MODEL_SWITCHES)
            return refuse(of, "fmi2SetBoolean", "there is no such value reference");
        if (of->data.phase > INITIALISING)
            return refuse(of, "fmi2SetBoolean", "it is set before the initialisation ends");
    }
    for (i = 0; i < count; i++)
        of->data.choice[vr[i]] = value[i];
    return fmi2OK;
}

static fmi2Status none(fmi2Component c, size_t count, const char *function)
{
    return count ? refuse(c, function, "the model has no variable of this type") : fmi2OK;
}

FMI2(fmi2Status, fmi2GetInteger)(fmi2Component c, const fmi2ValueReference vr[], size_t count,
    fmi2Integer value[])
{
    (void)vr;
    (void)value;
    return none(c, count, "fmi2GetInteger");
}

FMI2(fmi2Status, fmi2SetInteger)(fmi2Component c, const fmi2ValueReference vr[], size_t count,
    const fmi2Integer value[])
{
    (void)vr;
    (void)value;
    return none(c, count, "fmi2SetInteger");
}

FMI2(fmi2Status, fmi2GetString)(fmi2Component c, const fmi2ValueReference vr[], size_t count,
    fmi2String value[])
{
    (void)vr;
    (void)value;
    return none(c, count, "fmi2GetString");
}

FMI2(fmi2Status, fmi2SetString)(fmi2Component c, const fmi2ValueReference vr[], size_t count,
    const fmi2String value[])
{
    (void)vr;
    (void)value;
    return none(c, count, "fmi2SetString");
}

FMI2(fmi2Status, fmi2DoStep)(fmi2Component c, fmi2Real time, fmi2Real step, fmi2Boolean final)
{
    Instance *of = c;
    Data *data = &of->data;
    char message[300];
    double place, last, near = near_at(time + step);
    (void)final;
    if (data->phase != STEPPING)
        return refuse(of, "fmi2DoStep", "the instance is not initialised, or has ended");
    if (!(time - data->time <= near * MODEL_SAMPLE_TIME &&
            data->time - time <= near * MODEL_SAMPLE_TIME)) {
        sprintf(message, "fmi2DoStep: it begins at %.9g s, but the last step ended at %.9g s", time,
            data->time);
        return tell(of, fmi2Error, message);
    }
    if (!(step >= 0)) {
        sprintf(message, "fmi2DoStep: a step of %.9g s, it must be positive", step);
        return tell(of, fmi2Error, message);
    }
    place = (time + step - data->start) / MODEL_SAMPLE_TIME;
    last = data->instant;
    while (place - (last + 1) >= -near) {
        if (!data->ahead && !look_ahead(data)) {
            data->phase = FAILED;
            sprintf(message, "fmi2DoStep: the motion diverged after %.9g s, or an input is no number",
                data->start + last * MODEL_SAMPLE_TIME);
            return tell(of, fmi2Error, message);
        }
        memcpy(data->now, data->next, sizeof data->now);
        data->ahead = 0;
        data->instant = last += 1;
    }
    data->share = place - last > near ? place - last : 0;
    if (data->share > 0 && !data->ahead && !look_ahead(data)) {
        data->phase = FAILED;
        return refuse(of, "fmi2DoStep", "the motion diverged, or an input is no number");
    }
    data->time = time + step;
    return fmi2OK;
}

FMI2(fmi2Status, fmi2CancelStep)(fmi2Component c)
{
    return refuse(c, "fmi2CancelStep", "a step is never pending");
}

FMI2(fmi2Status, fmi2SetRealInputDerivatives)(fmi2Component c, const fmi2ValueReference vr[],
    size_t count, const fmi2Integer order[], const fmi2Real value[])
{
    (void)vr;
    (void)order;
    (void)value;
    return count ? refuse(c, "fmi2SetRealInputDerivatives", "inputs are held") : fmi2OK;
}

FMI2(fmi2Status, fmi2GetRealOutputDerivatives)(fmi2Component c, const fmi2ValueReference vr[],
    size_t count, const fmi2Integer order[], fmi2Real value[])
{
    (void)vr;
    (void)order;
    (void)value;
    return count ? refuse(c, "fmi2GetRealOutputDerivatives", "there are none") : fmi2OK;
}

FMI2(fmi2Status, fmi2GetDirectionalDerivative)(fmi2Component c, const fmi2ValueReference unknown[],
    size_t unknowns, const fmi2ValueReference known[], size_t knowns, const fmi2Real along[],
    fmi2Real value[])
{
    (void)unknown;
    (void)unknowns;
    (void)known;
    (void)knowns;
    (void)along;
    (void)value;
    return refuse(c, "fmi2GetDirectionalDerivative", "the FMU does not provide it");
}

FMI2(fmi2Status, fmi2GetStatus)(fmi2Component c, const fmi2StatusKind kind, fmi2Status *value)
{
    (void)kind;
    (void)value;
    return tell(c, fmi2Discard, "fmi2GetStatus: no step is pending");
}

FMI2(fmi2Status, fmi2GetRealStatus)(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value)
{
    Instance *of = c;
    if (kind != fmi2LastSuccessfulTime)
        return tell(of, fmi2Discard, "fmi2GetRealStatus: only the last successful time is known");
    *value = of->data.time;
    return fmi2OK;
}

FMI2(fmi2Status, fmi2GetIntegerStatus)(fmi2Component c, const fmi2StatusKind kind,
    fmi2Integer *value)
{
    (void)kind;
    (void)value;
    return tell(c, fmi2Discard, "fmi2GetIntegerStatus: there is none");
}

FMI2(fmi2Status, fmi2GetBooleanStatus)(fmi2Component c, const fmi2StatusKind kind,
    fmi2Boolean *value)
{
    if (kind != fmi2Terminated)
        return tell(c, fmi2Discard, "fmi2GetBooleanStatus: only whether it has ended is known");
    *value = ((Instance *)c)->data.phase >= TERMINATED;
    return fmi2OK;
}

FMI2(fmi2Status, fmi2GetStringStatus)(fmi2Component c, const fmi2StatusKind kind, fmi2String *value)
{
    (void)kind;
    (void)value;
    return tell(c, fmi2Discard, "fmi2GetStringStatus: there is none");
}

FMI2(fmi2Status, fmi2GetFMUstate)(fmi2Component c, fmi2FMUstate *state)
{
    Instance *of = c;
    Saved *saved = *state ? *state : calloc(1, sizeof *saved);
    if (!saved)
        return refuse(of, "fmi2GetFMUstate", "no memory");
    memcpy(saved->guid, MODEL_GUID, sizeof saved->guid);
    saved->data = of->data;
    *state = saved;
    return fmi2OK;
}

FMI2(fmi2Status, fmi2SetFMUstate)(fmi2Component c, fmi2FMUstate state)
{
    if (!state)
        return refuse(c, "fmi2SetFMUstate", "there is no state");
    ((Instance *)c)->data = ((Saved *)state)->data;
    return fmi2OK;
}

FMI2(fmi2Status, fmi2FreeFMUstate)(fmi2Component c, fmi2FMUstate *state)
{
    (void)c;
    if (state) {
        free(*state);
        *state = 0;
    }
    return fmi2OK;
}

FMI2(fmi2Status, fmi2SerializedFMUstateSize)(fmi2Component c, fmi2FMUstate state, size_t *size)
{
    (void)c;
    (void)state;
    *size = sizeof(Saved);
    return fmi2OK;
}

FMI2(fmi2Status, fmi2SerializeFMUstate)(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[],
    size_t size)
{
    if (!state || size < sizeof(Saved))
        return refuse(c, "fmi2SerializeFMUstate", "there is no state, or no room for it");
    memcpy(bytes, state, sizeof(Saved));
    return fmi2OK;
}

FMI2(fmi2Status, fmi2DeSerializeFMUstate)(fmi2Component c, const fmi2Byte bytes[], size_t size,
    fmi2FMUstate *state)
{
    Saved *saved;
    if (size != sizeof(Saved) || memcmp(bytes, MODEL_GUID, sizeof MODEL_GUID))
        return refuse(c, "fmi2DeSerializeFMUstate", "these bytes are of another model");
    saved = *state ? *state : calloc(1, sizeof *saved);
    if (!saved)
        return refuse(c, "fmi2DeSerializeFMUstate", "no memory");
    memcpy(saved, bytes, sizeof *saved);
    *state = saved;
    return fmi2OK;
}
