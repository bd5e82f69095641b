/* Run one instance of an FMU's library for Windows under torques from stdin. */

#include <stdarg.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <windows.h>

static HMODULE library;

static void log_2(void *environment, const char *name, int status, const char *category, const char *message, ...)
{
    va_list arguments;
    (void)environment; (void)name; (void)status; (void)category;
    va_start(arguments, message);
    vprintf(message, arguments);
    va_end(arguments);
    puts("");
}

static void log_3(void *environment, int status, const char *category, const char *message)
{
    (void)environment; (void)status; (void)category;
    puts(message);
}

static const struct { void *logger, *allocate, *release, *finished, *environment; } calls = {(void *)log_2};

#define FUNCTION(name) ((void *)GetProcAddress(library, name))
#define CALL(type, name, ...) ((int (*) type)FUNCTION(name))(__VA_ARGS__)
#define MAKE(type, name, ...) ((void *(*) type)FUNCTION(name))(__VA_ARGS__)

static int exchange_values(void *instance, int fmi, const uint32_t *references, size_t count, double *values, bool set)
{
    if (fmi == 2)
        return CALL((void *, const uint32_t *, size_t, double *), set ? "fmi2SetReal" : "fmi2GetReal",
                    instance, references, count, values);
    return CALL((void *, const uint32_t *, size_t, double *, size_t), set ? "fmi3SetFloat64" : "fmi3GetFloat64",
                instance, references, count, values, count);
}

static int step(void *instance, int fmi, double time, double length)
{
    bool event, terminate, early;
    double reached;
    if (fmi == 2)
        return CALL((void *, double, double, int), "fmi2DoStep", instance, time, length, 1);
    return CALL((void *, double, double, bool, bool *, bool *, bool *, double *), "fmi3DoStep",
                instance, time, length, true, &event, &terminate, &early, &reached);
}

/* Arguments: library, version of FMI, token, period, outputs. Torques come in, as numbers; outputs go out, as bits. */
int main(int count, char **arguments)
{
    const int fmi = atoi(arguments[2]), outputs = atoi(arguments[5]);
    const double period = atof(arguments[4]);
    uint32_t first = 1u, references[16];
    double torque, values[16];
    uint64_t word;
    long i;
    int k, failures = 0;
    void *instance;
    library = LoadLibraryA(arguments[1]);
    if (count != 6 || library == NULL)
        return 2;
    for (k = 0; k < outputs; k++)
        references[k] = 2u + (uint32_t)k;
    if (fmi == 2)
    {
        instance = MAKE((const char *, int, const char *, const char *, const void *, int, int), "fmi2Instantiate",
                        "a", 1, arguments[3], "", &calls, 0, 0);
        failures += CALL((void *, int, double, double, int, double), "fmi2SetupExperiment", instance, 0, 0.0, 0.0, 0, 0.0);
        failures += CALL((void *), "fmi2EnterInitializationMode", instance);
        failures += CALL((void *), "fmi2ExitInitializationMode", instance);
    }
    else
    {
        instance = MAKE((const char *, const char *, const char *, bool, bool, bool, bool, const void *, size_t, void *,
                         void *, void *),
                        "fmi3InstantiateCoSimulation", "a", arguments[3], NULL, false, false, false, false, NULL, 0u, NULL,
                        (void *)log_3, NULL);
        failures += CALL((void *, bool, double, double, bool, double), "fmi3EnterInitializationMode",
                         instance, false, 0.0, 0.0, false, 0.0);
        failures += CALL((void *), "fmi3ExitInitializationMode", instance);
    }
    for (i = 0; scanf("%lf", &torque) == 1; i++)
    {
        failures += exchange_values(instance, fmi, &first, 1u, &torque, true);
        failures += step(instance, fmi, (double)i * period, period);
        failures += exchange_values(instance, fmi, references, (size_t)outputs, values, false);
        for (k = 0; k < outputs; k++)
        {
            memcpy(&word, &values[k], sizeof(word));
            printf("%08lx%08lx ", (unsigned long)(word >> 32), (unsigned long)(word & 0xffffffffu));
        }
        puts("");
    }
    failures += step(instance, fmi, (double)i * period, 0.3 * period) == 0;
    (void)((void (*)(void *))FUNCTION(fmi == 2 ? "fmi2FreeInstance" : "fmi3FreeInstance"))(instance);
    return failures;
}
