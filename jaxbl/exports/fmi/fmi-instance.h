/*
 * One instance of the model, and what both versions of FMI do with it. Nothing is shared between instances.
 */

#ifndef FMI_INSTANCE_HEADER
#define FMI_INSTANCE_HEADER

#include <float.h>
#include <math.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmi-model.h"

#if defined _WIN32
#define FMI_EXPORT __declspec(dllexport)
#elif defined __GNUC__
#define FMI_EXPORT __attribute__((visibility("default")))
#else
#define FMI_EXPORT
#endif

#define LONGEST 256
/* Share of a sample by which times of the environment may be off: they are sums of rounded steps. */
#define STEP_OFF 1e-6
#define TIME_OFF 0.25
/* Samples in a step, at most: they are counted without rounding. */
#define MOST_SAMPLES 1e9

/* Numbers of FMI's status, the same in both versions. */
enum
{
    OK = 0,
    ERROR = 3
};

/* Phases of an instance, and sets of them. */
enum
{
    INSTANTIATED = 1,
    INITIALIZING = 2,
    STEPPING = 4,
    TERMINATED = 8,
    BEFORE = INSTANTIATED | INITIALIZING
};

/* All that changes: a plain block of bytes. */
typedef struct
{
    Model model;
    double stop;     /* no step leads past it, s */
    double start;    /* of the simulation, s */
    int64_t samples; /* since then */
    int32_t phase;
    int32_t begun; /* whether the model is at the start values that are set */
} State;

typedef struct
{
    State state;
    void *environment;
    void (*callback)(void); /* the environment's function for the log, as another type */
    char *name;
} Instance;

/* A line in the log: what each version of FMI does with it. */
static void logged(const Instance *one, const char *message);

/* Of a serialised state: the token, and the state. */
#define BYTES (sizeof(MODEL_TOKEN) + sizeof(State))

/* An error with its line in the log. */
static int failed(const Instance *one, const char *format, ...)
{
    char text[LONGEST];
    va_list given;
    va_start(given, format);
    (void)vsnprintf(text, sizeof(text), format, given);
    va_end(given);
    if (one != NULL)
    {
        logged(one, text);
    }
    return (int)ERROR;
}

/* Of functions for variables of types that the model does not have, and for what it cannot do. */
static int absent(void *instance, size_t count, const char *what)
{
    return (count == 0u) ? (int)OK : failed((const Instance *)instance, "the model has no %s", what);
}

/* Whether there is an instance in one of some phases; if not, the log says why nothing is done. */
static bool ready(const Instance *one, int32_t phases, const char *why)
{
    const bool yes = (one != NULL) && ((one->state.phase & phases) != 0);
    if (!yes)
    {
        (void)failed(one, "%s", why);
    }
    return yes;
}

static void set_start_values(Instance *one)
{
    size_t i;
    memset(&one->state, 0, sizeof(one->state));
    for (i = 0u; i < MODEL_VARIABLES; i++)
    {
        one->state.model.values[i] = variables[i].start;
    }
    one->state.phase = INSTANTIATED;
    one->state.stop = ANY;
}

static int reset(Instance *one)
{
    if (one == NULL)
    {
        return (int)ERROR;
    }
    set_start_values(one);
    return (int)OK;
}

static Instance *created(const char *name, const char *token)
{
    Instance *one = NULL;
    const char *given = (name == NULL) ? "" : name;
    if ((token != NULL) && (strcmp(token, MODEL_TOKEN) == 0))
    {
        one = (Instance *)calloc(1u, sizeof(Instance));
    }
    if (one != NULL)
    {
        one->name = (char *)malloc(strlen(given) + 1u);
        if (one->name == NULL)
        {
            free(one);
            return NULL;
        }
        strcpy(one->name, given);
        set_start_values(one);
    }
    return one;
}

static void freed(Instance *one)
{
    if (one != NULL)
    {
        free(one->name);
        free(one);
    }
}

static double time_of(const Instance *one)
{
    return one->state.start + ((double)one->state.samples * MODEL_PERIOD);
}

/* What is read before the first step follows from the start values. */
static void begin(Instance *one)
{
    if ((one->state.begun == 0) && ((one->state.phase & BEFORE) != 0))
    {
        model_begin(&one->state.model);
        one->state.begun = 1;
    }
    one->state.model.values[MODEL_TIME] = time_of(one);
}

/* Whether there is a place for a value of each variable. */
static bool paired(const Instance *one, const uint32_t references[], size_t count, const double values[], size_t numbers)
{
    const bool yes = (count == numbers) && ((count == 0u) || ((references != NULL) && (values != NULL)));
    if (!yes)
    {
        (void)failed(one, "%zu values for %zu variables, or no place for them", numbers, count);
    }
    return yes;
}

static int get_numbers(Instance *one, const uint32_t references[], size_t count, double values[], size_t numbers)
{
    size_t i;
    if ((one == NULL) || !paired(one, references, count, values, numbers))
    {
        return (int)ERROR;
    }
    begin(one);
    for (i = 0u; i < count; i++)
    {
        if (references[i] >= MODEL_VARIABLES)
        {
            return failed(one, "no variable has the value reference %lu", (unsigned long)references[i]);
        }
        values[i] = one->state.model.values[references[i]];
    }
    return (int)OK;
}

/* Whether a variable may have a value now; if not, the log says why. */
static int checked(const Instance *one, uint32_t reference, double value)
{
    const Variable *which = NULL;
    const bool before = (one->state.phase & BEFORE) != 0;
    if (reference >= MODEL_VARIABLES)
    {
        return failed(one, "no variable has the value reference %lu", (unsigned long)reference);
    }
    which = &variables[reference];
    if ((which->change == NEVER) || ((which->change == FIXED) && !before))
    {
        return failed(one, "%s cannot be set%s", which->name, (which->change == FIXED) ? " after initialization" : "");
    }
    if (!(fabs(value) <= DBL_MAX) || (value < which->least) || (value > which->most) ||
        ((which->open != 0) && (value <= which->least)))
    {
        return failed(one, "%s: %g is out of range (min %g%s, max %g)", which->name, value, which->least,
                      (which->open != 0) ? ", exclusive" : "", which->most);
    }
    return (int)OK;
}

/* All of them or none. */
static int set_numbers(Instance *one, const uint32_t references[], size_t count, const double values[], size_t numbers)
{
    size_t i;
    if (!ready(one, BEFORE | STEPPING, "nothing can be set after termination") ||
        !paired(one, references, count, values, numbers))
    {
        return (int)ERROR;
    }
    for (i = 0u; i < count; i++)
    {
        if (checked(one, references[i], values[i]) != (int)OK)
        {
            return (int)ERROR;
        }
    }
    for (i = 0u; i < count; i++)
    {
        one->state.model.values[references[i]] = values[i];
        one->state.begun = 0;
    }
    return (int)OK;
}

static int set_times(Instance *one, double start, bool has_stop, double stop)
{
    if (!ready(one, INSTANTIATED, "initialization begins once, after the instance is made or reset"))
    {
        return (int)ERROR;
    }
    if (!(fabs(start) <= DBL_MAX))
    {
        return failed(one, "the start time should be a number");
    }
    one->state.start = start;
    one->state.stop = has_stop ? stop : ANY;
    return (int)OK;
}

/* From one phase to the next. */
static int entered(Instance *one, int32_t from, int32_t to, const char *why)
{
    if (!ready(one, from, why))
    {
        return (int)ERROR;
    }
    begin(one);
    one->state.phase = to;
    return (int)OK;
}

static int enter_initialization(Instance *one)
{
    return entered(one, INSTANTIATED, INITIALIZING, "initialization begins once, after the instance is made or reset");
}

static int exit_initialization(Instance *one)
{
    return entered(one, INITIALIZING, STEPPING, "initialization has not begun");
}

static int terminated(Instance *one)
{
    return entered(one, STEPPING, TERMINATED, "only what has been initialized can be terminated");
}

static int do_step(Instance *one, double time, double length)
{
    /* the end is what the environment can say exactly: a step is a difference of rounded times */
    const double slack = (STEP_OFF * MODEL_PERIOD) + (4.0 * DBL_EPSILON * (fabs(time) + fabs(length)));
    const double ratio = length / MODEL_PERIOD;
    const int64_t samples = ((ratio > 0.0) && (ratio < MOST_SAMPLES)) ? (int64_t)(ratio + 0.5) : 0;
    State *state = NULL;
    int64_t left;
    size_t i;
    if (!ready(one, STEPPING, "a step needs an initialized instance"))
    {
        return (int)ERROR;
    }
    state = &one->state;
    if ((samples < 1) || !(fabs(length - ((double)samples * MODEL_PERIOD)) <= slack))
    {
        return failed(one, "the communication step size %.17g s should be a multiple of the sample period %.17g s", length,
                      MODEL_PERIOD);
    }
    if (!(fabs(time - time_of(one)) <= (TIME_OFF * MODEL_PERIOD)))
    {
        return failed(one, "a step from %.17g s, but the instance is at %.17g s", time, time_of(one));
    }
    if ((time_of(one) + length) > (state->stop + (TIME_OFF * MODEL_PERIOD)))
    {
        return failed(one, "a step to %.12g s, past the stop time %.12g s", time_of(one) + length, state->stop);
    }
    for (left = samples; left > 0; left--)
    {
        model_sample(&state->model);
        state->samples++;
    }
    begin(one);
    for (i = 0u; i < MODEL_VARIABLES; i++)
    {
        if (!(fabs(state->model.values[i]) <= DBL_MAX))
        {
            return failed(one, "%s is not finite at %g s: the motion diverged", variables[i].name,
                          state->model.values[MODEL_TIME]);
        }
    }
    return (int)OK;
}

/* States of an instance: copies, in a place of the environment's or a new one. */
static int copied(const Instance *one, const void *from, void **place)
{
    if (place == NULL)
    {
        return failed(one, "no place for a state is given");
    }
    if (*place == NULL)
    {
        *place = malloc(sizeof(State));
    }
    if (*place == NULL)
    {
        return failed(one, "no memory for a state");
    }
    memcpy(*place, from, sizeof(State));
    return (int)OK;
}

static int kept(const Instance *one, void **place)
{
    return (one == NULL) ? (int)ERROR : copied(one, &one->state, place);
}

static int taken_back(Instance *one, const void *place)
{
    if ((one == NULL) || (place == NULL))
    {
        return failed(one, "no state is given");
    }
    memcpy(&one->state, place, sizeof(State));
    return (int)OK;
}

static int forgotten(void **place)
{
    if (place != NULL)
    {
        free(*place);
        *place = NULL;
    }
    return (int)OK;
}

static int serialise(const Instance *one, const void *place, unsigned char bytes[], size_t size)
{
    if ((place == NULL) || (bytes == NULL) || (size < BYTES))
    {
        return failed(one, "a state needs %zu bytes, not %zu", BYTES, size);
    }
    memcpy(bytes, MODEL_TOKEN, sizeof(MODEL_TOKEN));
    memcpy(&bytes[sizeof(MODEL_TOKEN)], place, sizeof(State));
    return (int)OK;
}

static int deserialise(const Instance *one, const unsigned char bytes[], size_t size, void **place)
{
    if ((bytes == NULL) || (size != BYTES) || (memcmp(bytes, MODEL_TOKEN, sizeof(MODEL_TOKEN)) != 0))
    {
        return failed(one, "these %zu bytes are no state of this model", size);
    }
    return copied(one, &bytes[sizeof(MODEL_TOKEN)], place);
}

#endif /* FMI_INSTANCE_HEADER */
