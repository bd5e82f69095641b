/*
 * Functions of the Functional Mock-up Interface 3.0 for co-simulation (https://fmi-standard.org), with declarations of their
 * own: no other header is needed. Where many are linked into one program, define FMI3_FUNCTION_PREFIX.
 */

#include "fmi-instance.h"

#if defined FMI3_FUNCTION_PREFIX && !defined FMI3_OVERRIDE_FUNCTION_PREFIX
#define PASTED(prefix, name) prefix##name
#define NAMED(prefix, name) PASTED(prefix, name)
#define NAME(name) NAMED(FMI3_FUNCTION_PREFIX, name)
#else
#define NAME(name) name
#endif

typedef void (*Logger)(void *environment, int status, const char *category, const char *message);
typedef void (*Callback)(void);
typedef const char *String;
typedef const uint8_t *Binary;

static void logged(const Instance *one, const char *message)
{
    const Logger call = (Logger)one->callback;
    if (call != NULL)
    {
        call(one->environment, (int)ERROR, "logStatusError", message);
    }
}

FMI_EXPORT const char *NAME(fmi3GetVersion)(void)
{
    return "3.0";
}

FMI_EXPORT int NAME(fmi3SetDebugLogging)(void *instance, bool on, size_t count, const String categories[])
{
    (void)instance;
    (void)on;
    (void)count;
    (void)categories;
    return (int)OK;
}

FMI_EXPORT void *NAME(fmi3InstantiateCoSimulation)(const char *name, const char *token, const char *resources, bool visible,
                                                   bool logging, bool events, bool early_return,
                                                   const uint32_t intermediate[], size_t intermediate_count,
                                                   void *environment, Logger logger, Callback intermediate_update)
{
    Instance *one = events ? NULL : created(name, token);
    (void)resources;
    (void)visible;
    (void)logging;
    (void)early_return;
    (void)intermediate;
    (void)intermediate_count;
    (void)intermediate_update;
    if (one != NULL)
    {
        one->callback = (Callback)logger;
        one->environment = environment;
    }
    else if (logger != NULL)
    {
        logger(environment, (int)ERROR, "logStatusError",
               events ? "the model has no event mode"
                      : "the instantiation token is another one, or there is no memory");
    }
    return one;
}

FMI_EXPORT void *NAME(fmi3InstantiateModelExchange)(const char *name, const char *token, const char *resources, bool visible,
                                                    bool logging, void *environment, Logger logger)
{
    (void)name;
    (void)token;
    (void)resources;
    (void)visible;
    (void)logging;
    if (logger != NULL)
    {
        logger(environment, (int)ERROR, "logStatusError", "the model is for co-simulation alone");
    }
    return NULL;
}

FMI_EXPORT void *NAME(fmi3InstantiateScheduledExecution)(const char *name, const char *token, const char *resources,
                                                         bool visible, bool logging, void *environment, Logger logger,
                                                         Callback clock_update, Callback lock, Callback unlock)
{
    (void)name;
    (void)token;
    (void)resources;
    (void)visible;
    (void)logging;
    (void)clock_update;
    (void)lock;
    (void)unlock;
    if (logger != NULL)
    {
        logger(environment, (int)ERROR, "logStatusError", "the model is for co-simulation alone");
    }
    return NULL;
}

FMI_EXPORT void NAME(fmi3FreeInstance)(void *instance)
{
    freed((Instance *)instance);
}

FMI_EXPORT int NAME(fmi3EnterInitializationMode)(void *instance, bool has_tolerance, double tolerance, double start,
                                                 bool has_stop, double stop)
{
    Instance *one = (Instance *)instance;
    const int status = set_times(one, start, has_stop, stop);
    (void)has_tolerance;
    (void)tolerance;
    return (status == (int)OK) ? enter_initialization(one) : status;
}

FMI_EXPORT int NAME(fmi3ExitInitializationMode)(void *instance)
{
    return exit_initialization((Instance *)instance);
}

FMI_EXPORT int NAME(fmi3EnterEventMode)(void *instance)
{
    return absent(instance, 1u, "events");
}

FMI_EXPORT int NAME(fmi3EnterStepMode)(void *instance)
{
    return absent(instance, 1u, "events");
}

FMI_EXPORT int NAME(fmi3EnterConfigurationMode)(void *instance)
{
    return absent(instance, 1u, "structural parameters");
}

FMI_EXPORT int NAME(fmi3ExitConfigurationMode)(void *instance)
{
    return absent(instance, 1u, "structural parameters");
}

FMI_EXPORT int NAME(fmi3Terminate)(void *instance)
{
    return terminated((Instance *)instance);
}

FMI_EXPORT int NAME(fmi3Reset)(void *instance)
{
    return reset((Instance *)instance);
}

FMI_EXPORT int NAME(fmi3GetFloat64)(void *instance, const uint32_t references[], size_t count, double values[],
                                    size_t numbers)
{
    return get_numbers((Instance *)instance, references, count, values, numbers);
}

FMI_EXPORT int NAME(fmi3SetFloat64)(void *instance, const uint32_t references[], size_t count, const double values[],
                                    size_t numbers)
{
    return set_numbers((Instance *)instance, references, count, values, numbers);
}

#define OF_TYPE(name, type)                                                                                                \
    FMI_EXPORT int NAME(fmi3Get##name)(void *instance, const uint32_t references[], size_t count, type values[],           \
                                       size_t numbers)                                                                     \
    {                                                                                                                      \
        (void)references;                                                                                                  \
        (void)values;                                                                                                      \
        (void)numbers;                                                                                                     \
        return absent(instance, count, "variables of type " #name);                                                        \
    }                                                                                                                      \
    FMI_EXPORT int NAME(fmi3Set##name)(void *instance, const uint32_t references[], size_t count, const type values[],     \
                                       size_t numbers)                                                                     \
    {                                                                                                                      \
        (void)references;                                                                                                  \
        (void)values;                                                                                                      \
        (void)numbers;                                                                                                     \
        return absent(instance, count, "variables of type " #name);                                                        \
    }

OF_TYPE(Float32, float)
OF_TYPE(Int8, int8_t)
OF_TYPE(UInt8, uint8_t)
OF_TYPE(Int16, int16_t)
OF_TYPE(UInt16, uint16_t)
OF_TYPE(Int32, int32_t)
OF_TYPE(UInt32, uint32_t)
OF_TYPE(Int64, int64_t)
OF_TYPE(UInt64, uint64_t)
OF_TYPE(Boolean, bool)
OF_TYPE(String, String)

FMI_EXPORT int NAME(fmi3GetBinary)(void *instance, const uint32_t references[], size_t count, size_t sizes[],
                                   Binary values[], size_t numbers)
{
    (void)references;
    (void)sizes;
    (void)values;
    (void)numbers;
    return absent(instance, count, "variables of type Binary");
}

FMI_EXPORT int NAME(fmi3SetBinary)(void *instance, const uint32_t references[], size_t count, const size_t sizes[],
                                   const Binary values[], size_t numbers)
{
    (void)references;
    (void)sizes;
    (void)values;
    (void)numbers;
    return absent(instance, count, "variables of type Binary");
}

/* Functions for clocks, of which there are none. */
#define OF_CLOCKS_1(name, a)                                                                                               \
    FMI_EXPORT int NAME(fmi3##name)(void *instance, const uint32_t references[], size_t count, a)                          \
    {                                                                                                                      \
        (void)references;                                                                                                  \
        (void)first;                                                                                                       \
        return absent(instance, count, "clocks");                                                                          \
    }
#define OF_CLOCKS_2(name, a, b)                                                                                            \
    FMI_EXPORT int NAME(fmi3##name)(void *instance, const uint32_t references[], size_t count, a, b)                       \
    {                                                                                                                      \
        (void)references;                                                                                                  \
        (void)first;                                                                                                       \
        (void)second;                                                                                                      \
        return absent(instance, count, "clocks");                                                                          \
    }

OF_CLOCKS_1(GetClock, bool first[])
OF_CLOCKS_1(SetClock, const bool first[])
OF_CLOCKS_2(GetIntervalDecimal, double first[], int second[])
OF_CLOCKS_1(SetIntervalDecimal, const double first[])
OF_CLOCKS_1(GetShiftDecimal, double first[])
OF_CLOCKS_1(SetShiftDecimal, const double first[])
OF_CLOCKS_2(GetShiftFraction, uint64_t first[], uint64_t second[])
OF_CLOCKS_2(SetShiftFraction, const uint64_t first[], const uint64_t second[])
OF_CLOCKS_2(SetIntervalFraction, const uint64_t first[], const uint64_t second[])

FMI_EXPORT int NAME(fmi3GetIntervalFraction)(void *instance, const uint32_t references[], size_t count, uint64_t counters[],
                                             uint64_t resolutions[], int qualifiers[])
{
    (void)references;
    (void)counters;
    (void)resolutions;
    (void)qualifiers;
    return absent(instance, count, "clocks");
}

FMI_EXPORT int NAME(fmi3GetNumberOfVariableDependencies)(void *instance, uint32_t reference, size_t *count)
{
    (void)reference;
    (void)count;
    return absent(instance, 1u, "dependencies of single elements");
}

FMI_EXPORT int NAME(fmi3GetVariableDependencies)(void *instance, uint32_t dependent, size_t elements[],
                                                 uint32_t independents[], size_t others[], int kinds[], size_t count)
{
    (void)dependent;
    (void)elements;
    (void)independents;
    (void)others;
    (void)kinds;
    (void)count;
    return absent(instance, 1u, "dependencies of single elements");
}

FMI_EXPORT int NAME(fmi3GetFMUState)(void *instance, void **place)
{
    return kept((const Instance *)instance, place);
}

FMI_EXPORT int NAME(fmi3SetFMUState)(void *instance, void *place)
{
    return taken_back((Instance *)instance, place);
}

FMI_EXPORT int NAME(fmi3FreeFMUState)(void *instance, void **place)
{
    (void)instance;
    return forgotten(place);
}

FMI_EXPORT int NAME(fmi3SerializedFMUStateSize)(void *instance, void *place, size_t *size)
{
    (void)instance;
    (void)place;
    *size = BYTES;
    return (int)OK;
}

FMI_EXPORT int NAME(fmi3SerializeFMUState)(void *instance, void *place, uint8_t bytes[], size_t size)
{
    return serialise((const Instance *)instance, place, bytes, size);
}

FMI_EXPORT int NAME(fmi3DeserializeFMUState)(void *instance, const uint8_t bytes[], size_t size, void **place)
{
    return deserialise((const Instance *)instance, bytes, size, place);
}

#define DERIVATIVE(name)                                                                                                   \
    FMI_EXPORT int NAME(fmi3##name)(void *instance, const uint32_t unknowns[], size_t unknown_count,                       \
                                    const uint32_t knowns[], size_t known_count, const double seed[], size_t seed_count,   \
                                    double found[], size_t found_count)                                                    \
    {                                                                                                                      \
        (void)unknowns;                                                                                                    \
        (void)unknown_count;                                                                                               \
        (void)knowns;                                                                                                      \
        (void)known_count;                                                                                                 \
        (void)seed;                                                                                                        \
        (void)seed_count;                                                                                                  \
        (void)found;                                                                                                       \
        (void)found_count;                                                                                                 \
        return absent(instance, 1u, "partial derivatives");                                                                \
    }

DERIVATIVE(GetDirectionalDerivative)
DERIVATIVE(GetAdjointDerivative)

FMI_EXPORT int NAME(fmi3EvaluateDiscreteStates)(void *instance)
{
    return absent(instance, 1u, "events");
}

FMI_EXPORT int NAME(fmi3UpdateDiscreteStates)(void *instance, bool *again, bool *terminate, bool *nominals_changed,
                                              bool *values_changed, bool *has_next, double *next)
{
    (void)again;
    (void)terminate;
    (void)nominals_changed;
    (void)values_changed;
    (void)has_next;
    (void)next;
    return absent(instance, 1u, "events");
}

FMI_EXPORT int NAME(fmi3GetOutputDerivatives)(void *instance, const uint32_t references[], size_t count,
                                              const int32_t orders[], double values[], size_t numbers)
{
    (void)references;
    (void)orders;
    (void)values;
    (void)numbers;
    return absent(instance, count, "derivatives of outputs");
}

/* Functions of the other kinds of FMUs: tools may look them up. */
#define OTHER_KIND(name, ...)                                                                                              \
    FMI_EXPORT int NAME(fmi3##name)(void *instance, __VA_ARGS__)                                                           \
    {                                                                                                                      \
        (void)first;                                                                                                       \
        (void)second;                                                                                                      \
        return absent(instance, 1u, "model exchange and no scheduled execution");                                          \
    }

OTHER_KIND(SetContinuousStates, const double first[], size_t second)
OTHER_KIND(GetContinuousStateDerivatives, double first[], size_t second)
OTHER_KIND(GetEventIndicators, double first[], size_t second)
OTHER_KIND(GetContinuousStates, double first[], size_t second)
OTHER_KIND(GetNominalsOfContinuousStates, double first[], size_t second)
OTHER_KIND(ActivateModelPartition, uint32_t first, double second)

FMI_EXPORT int NAME(fmi3EnterContinuousTimeMode)(void *instance)
{
    return absent(instance, 1u, "model exchange");
}

FMI_EXPORT int NAME(fmi3CompletedIntegratorStep)(void *instance, bool no_earlier_state, bool *event, bool *terminate)
{
    (void)no_earlier_state;
    (void)event;
    (void)terminate;
    return absent(instance, 1u, "model exchange");
}

FMI_EXPORT int NAME(fmi3SetTime)(void *instance, double time)
{
    (void)time;
    return absent(instance, 1u, "model exchange");
}

FMI_EXPORT int NAME(fmi3GetNumberOfEventIndicators)(void *instance, size_t *count)
{
    (void)instance;
    *count = 0u;
    return (int)OK;
}

FMI_EXPORT int NAME(fmi3GetNumberOfContinuousStates)(void *instance, size_t *count)
{
    (void)instance;
    *count = 0u;
    return (int)OK;
}

FMI_EXPORT int NAME(fmi3DoStep)(void *instance, double time, double length, bool no_earlier_state, bool *event,
                                bool *terminate, bool *early, double *reached)
{
    Instance *one = (Instance *)instance;
    const int status = do_step(one, time, length);
    (void)no_earlier_state;
    *event = false;
    *terminate = false;
    *early = false;
    *reached = (one == NULL) ? time : time_of(one);
    return status;
}
