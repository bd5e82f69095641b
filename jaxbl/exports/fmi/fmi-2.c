/*
 * Functions of the Functional Mock-up Interface 2.0 for co-simulation (https://fmi-standard.org), with declarations of their
 * own: no other header is needed. Where many are linked into one program, define FMI2_FUNCTION_PREFIX.
 */

#include "fmi-instance.h"

#if defined FMI2_FUNCTION_PREFIX && !defined FMI2_OVERRIDE_FUNCTION_PREFIX
#define PASTED(prefix, name) prefix##name
#define NAMED(prefix, name) PASTED(prefix, name)
#define NAME(name) NAMED(FMI2_FUNCTION_PREFIX, name)
#else
#define NAME(name) name
#endif

typedef void (*Logger)(void *environment, const char *name, int status, const char *category, const char *message, ...);

typedef struct
{
    Logger logger;
    void *(*allocate)(size_t count, size_t size);
    void (*release)(void *place);
    void (*finished)(void *environment, int status);
    void *environment;
} Callbacks;

enum
{
    MODEL_EXCHANGE = 0,
    CO_SIMULATION = 1,
    DISCARD = 2,
    LAST_SUCCESSFUL_TIME = 2
};

static void logged(const Instance *one, const char *message)
{
    const Logger call = (Logger)one->callback;
    if (call != NULL)
    {
        call(one->environment, one->name, (int)ERROR, "logStatusError", "%s", message);
    }
}

FMI_EXPORT const char *NAME(fmi2GetTypesPlatform)(void)
{
    return "default";
}

FMI_EXPORT const char *NAME(fmi2GetVersion)(void)
{
    return "2.0";
}

FMI_EXPORT int NAME(fmi2SetDebugLogging)(void *instance, int on, size_t count, const char *const categories[])
{
    (void)instance;
    (void)on;
    (void)count;
    (void)categories;
    return (int)OK;
}

FMI_EXPORT void *NAME(fmi2Instantiate)(const char *name, int kind, const char *token, const char *resources,
                                       const Callbacks *callbacks, int visible, int logging)
{
    Instance *one = (kind == (int)CO_SIMULATION) ? created(name, token) : NULL;
    const Logger call = (callbacks == NULL) ? NULL : callbacks->logger;
    (void)resources;
    (void)visible;
    (void)logging;
    if (one != NULL)
    {
        one->callback = (void (*)(void))call;
        one->environment = (callbacks == NULL) ? NULL : callbacks->environment;
    }
    else if (call != NULL)
    {
        call(callbacks->environment, (name == NULL) ? "" : name, (int)ERROR, "logStatusError", "%s",
             (kind != (int)CO_SIMULATION) ? "the model is for co-simulation alone"
                                          : "the guid is another one, or there is no memory");
    }
    return one;
}

FMI_EXPORT void NAME(fmi2FreeInstance)(void *instance)
{
    freed((Instance *)instance);
}

FMI_EXPORT int NAME(fmi2SetupExperiment)(void *instance, int has_tolerance, double tolerance, double start, int has_stop,
                                         double stop)
{
    (void)has_tolerance;
    (void)tolerance;
    return set_times((Instance *)instance, start, has_stop != 0, stop);
}

FMI_EXPORT int NAME(fmi2EnterInitializationMode)(void *instance)
{
    return enter_initialization((Instance *)instance);
}

FMI_EXPORT int NAME(fmi2ExitInitializationMode)(void *instance)
{
    return exit_initialization((Instance *)instance);
}

FMI_EXPORT int NAME(fmi2Terminate)(void *instance)
{
    return terminated((Instance *)instance);
}

FMI_EXPORT int NAME(fmi2Reset)(void *instance)
{
    return reset((Instance *)instance);
}

FMI_EXPORT int NAME(fmi2GetReal)(void *instance, const uint32_t references[], size_t count, double values[])
{
    return get_numbers((Instance *)instance, references, count, values, count);
}

FMI_EXPORT int NAME(fmi2SetReal)(void *instance, const uint32_t references[], size_t count, const double values[])
{
    return set_numbers((Instance *)instance, references, count, values, count);
}

#define OF_TYPE(name, type)                                                                                                \
    FMI_EXPORT int NAME(fmi2Get##name)(void *instance, const uint32_t references[], size_t count, type values[])           \
    {                                                                                                                      \
        (void)references;                                                                                                  \
        (void)values;                                                                                                      \
        return absent(instance, count, "variables of type " #name);                                                        \
    }                                                                                                                      \
    FMI_EXPORT int NAME(fmi2Set##name)(void *instance, const uint32_t references[], size_t count, const type values[])     \
    {                                                                                                                      \
        (void)references;                                                                                                  \
        (void)values;                                                                                                      \
        return absent(instance, count, "variables of type " #name);                                                        \
    }

typedef const char *String;

OF_TYPE(Integer, int)
OF_TYPE(Boolean, int)
OF_TYPE(String, String)

FMI_EXPORT int NAME(fmi2GetFMUstate)(void *instance, void **place)
{
    return kept((const Instance *)instance, place);
}

FMI_EXPORT int NAME(fmi2SetFMUstate)(void *instance, void *place)
{
    return taken_back((Instance *)instance, place);
}

FMI_EXPORT int NAME(fmi2FreeFMUstate)(void *instance, void **place)
{
    (void)instance;
    return forgotten(place);
}

FMI_EXPORT int NAME(fmi2SerializedFMUstateSize)(void *instance, void *place, size_t *size)
{
    (void)instance;
    (void)place;
    *size = BYTES;
    return (int)OK;
}

FMI_EXPORT int NAME(fmi2SerializeFMUstate)(void *instance, void *place, char bytes[], size_t size)
{
    return serialise((const Instance *)instance, place, (unsigned char *)bytes, size);
}

FMI_EXPORT int NAME(fmi2DeSerializeFMUstate)(void *instance, const char bytes[], size_t size, void **place)
{
    return deserialise((const Instance *)instance, (const unsigned char *)bytes, size, place);
}

FMI_EXPORT int NAME(fmi2GetDirectionalDerivative)(void *instance, const uint32_t unknowns[], size_t unknown_count,
                                                  const uint32_t knowns[], size_t known_count, const double seed[],
                                                  double found[])
{
    (void)unknowns;
    (void)unknown_count;
    (void)knowns;
    (void)known_count;
    (void)seed;
    (void)found;
    return absent(instance, 1u, "directional derivatives");
}

FMI_EXPORT int NAME(fmi2SetRealInputDerivatives)(void *instance, const uint32_t references[], size_t count,
                                                 const int orders[], const double values[])
{
    (void)references;
    (void)orders;
    (void)values;
    return absent(instance, count, "derivatives of inputs: they are held");
}

FMI_EXPORT int NAME(fmi2GetRealOutputDerivatives)(void *instance, const uint32_t references[], size_t count,
                                                  const int orders[], double values[])
{
    (void)references;
    (void)orders;
    (void)values;
    return absent(instance, count, "derivatives of outputs");
}

FMI_EXPORT int NAME(fmi2DoStep)(void *instance, double time, double length, int no_earlier_state)
{
    (void)no_earlier_state;
    return do_step((Instance *)instance, time, length);
}

FMI_EXPORT int NAME(fmi2CancelStep)(void *instance)
{
    return absent(instance, 1u, "steps that run beside the caller");
}

FMI_EXPORT int NAME(fmi2GetRealStatus)(void *instance, int kind, double *value)
{
    if ((instance == NULL) || (kind != (int)LAST_SUCCESSFUL_TIME))
    {
        return (int)DISCARD;
    }
    *value = time_of((const Instance *)instance);
    return (int)OK;
}

#define STATUS(name, type)                                                                                                 \
    FMI_EXPORT int NAME(fmi2Get##name)(void *instance, int kind, type *value)                                              \
    {                                                                                                                      \
        (void)instance;                                                                                                    \
        (void)kind;                                                                                                        \
        (void)value;                                                                                                       \
        return (int)DISCARD;                                                                                               \
    }

STATUS(Status, int)
STATUS(IntegerStatus, int)
STATUS(BooleanStatus, int)
STATUS(StringStatus, String)
