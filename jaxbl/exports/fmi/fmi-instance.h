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
typedef enum
{
    OK = 0,
    ERROR = 3
} Status;

typedef enum
{
    INSTANTIATED,
    INITIALIZING,
    STEPPING,
    TERMINATED
} Phase;

/* All that changes: a plain block of bytes. */
typedef struct
{
    Model model;
    double start;    /* of the simulation, s */
    int64_t samples; /* since then */
    int32_t phase;
    int32_t begun; /* whether the model is at the start values that are set */
} State;

typedef struct
{
    State state;
    void *environment;
    void (*log)(const void *instance, Status status, const char *message);
    void (*callback)(void); /* the environment's function for log, as another type */
    char *name;
} Instance;

/* What comes before the bytes of a serialised state. */
typedef struct
{
    char token[sizeof(MODEL_TOKEN)];
    uint64_t size;
} Head;

/* An error with its line in the log. */
static int failed(const Instance *one, const char *format, ...)
{
    char text[LONGEST];
    va_list given;
    va_start(given, format);
    (void)vsnprintf(text, sizeof(text), format, given);
    va_end(given);
    one->log(one, ERROR, text);
    return (int)ERROR;
}

static void set_start_values(Instance *one)
{
    size_t i;
    memset(&one->state, 0, sizeof(one->state));
    for (i = 0u; i < MODEL_VARIABLES; i++)
    {
        one->state.model.values[i] = variables[i].start;
    }
    one->state.phase = (int32_t)INSTANTIATED;
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

/* What is read before the first step follows from the start values. */
static void begin(Instance *one)
{
    if ((one->state.begun == 0) && (one->state.phase <= (int32_t)INITIALIZING))
    {
        model_begin(&one->state.model);
        one->state.begun = 1;
    }
    one->state.model.values[MODEL_TIME] = one->state.start + ((double)one->state.samples * MODEL_PERIOD);
}

static int get_numbers(Instance *one, const uint32_t references[], size_t count, double values[], size_t numbers)
{
    size_t i;
    if (count != numbers)
    {
        return failed(one, "%zu values for %zu variables", numbers, count);
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
    const bool before = one->state.phase <= (int32_t)INITIALIZING;
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
    if (count != numbers)
    {
        return failed(one, "%zu values for %zu variables", numbers, count);
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

static int enter_initialization(Instance *one, double start)
{
    if (one->state.phase != (int32_t)INSTANTIATED)
    {
        return failed(one, "initialization begins once, after the instance is made or reset");
    }
    if (!(fabs(start) <= DBL_MAX))
    {
        return failed(one, "the start time should be a number");
    }
    one->state.start = start;
    one->state.phase = (int32_t)INITIALIZING;
    return (int)OK;
}

static int exit_initialization(Instance *one)
{
    if (one->state.phase != (int32_t)INITIALIZING)
    {
        return failed(one, "initialization has not begun");
    }
    begin(one);
    one->state.phase = (int32_t)STEPPING;
    return (int)OK;
}

static int terminated(Instance *one)
{
    one->state.phase = (int32_t)TERMINATED;
    return (int)OK;
}

static int do_step(Instance *one, double time, double length)
{
    State *state = &one->state;
    const double now = state->start + ((double)state->samples * MODEL_PERIOD);
    /* the end is what the environment can say exactly: a step is a difference of rounded times */
    const double slack = (STEP_OFF * MODEL_PERIOD) + (4.0 * DBL_EPSILON * (fabs(time) + fabs(length)));
    const double ratio = length / MODEL_PERIOD;
    const int64_t samples = ((ratio > 0.0) && (ratio < MOST_SAMPLES)) ? (int64_t)(ratio + 0.5) : 0;
    int64_t left;
    size_t i;
    if (state->phase != (int32_t)STEPPING)
    {
        return failed(one, "a step needs an initialized instance");
    }
    if ((samples < 1) || !(fabs(length - ((double)samples * MODEL_PERIOD)) <= slack))
    {
        return failed(one, "the communication step size %.17g s should be a multiple of the sample period %.17g s", length,
                      MODEL_PERIOD);
    }
    if (!(fabs(time - now) <= (TIME_OFF * MODEL_PERIOD)))
    {
        return failed(one, "a step from %.17g s, but the instance is at %.17g s", time, now);
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
static int kept(const Instance *one, void **place)
{
    if (*place == NULL)
    {
        *place = malloc(sizeof(State));
    }
    if (*place == NULL)
    {
        return failed(one, "no memory for a state");
    }
    memcpy(*place, &one->state, sizeof(State));
    return (int)OK;
}

static int taken_back(Instance *one, const void *place)
{
    if (place == NULL)
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

static Head head(void)
{
    Head made;
    memset(&made, 0, sizeof(made));
    memcpy(made.token, MODEL_TOKEN, sizeof(MODEL_TOKEN));
    made.size = (uint64_t)sizeof(State);
    return made;
}

static size_t bytes_needed(void)
{
    return sizeof(Head) + sizeof(State);
}

static int serialise(const Instance *one, const void *place, unsigned char bytes[], size_t size)
{
    const Head first = head();
    if ((place == NULL) || (size < bytes_needed()))
    {
        return failed(one, "a state needs %zu bytes, not %zu", bytes_needed(), size);
    }
    memcpy(bytes, &first, sizeof(Head));
    memcpy(&bytes[sizeof(Head)], place, sizeof(State));
    return (int)OK;
}

static int deserialise(const Instance *one, const unsigned char bytes[], size_t size, void **place)
{
    const Head first = head();
    if ((size < bytes_needed()) || (memcmp(bytes, &first, sizeof(Head)) != 0))
    {
        return failed(one, "these %zu bytes are no state of this model", size);
    }
    if (*place == NULL)
    {
        *place = malloc(sizeof(State));
    }
    if (*place == NULL)
    {
        return failed(one, "no memory for a state");
    }
    memcpy(*place, &bytes[sizeof(Head)], sizeof(State));
    return (int)OK;
}

#endif /* FMI_INSTANCE_HEADER */
