/* An FMU's library for Windows, one instance of which runs under given torques. */

#include <stdarg.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <windows.h>

static HMODULE library;

static void logged_2(void *environment, const char *name, int status, const char *category, const char *message, ...)
{
    va_list given;
    (void)environment; (void)name; (void)status; (void)category;
    va_start(given, message);
    vprintf(message, given);
    va_end(given);
    puts("");
}

static void logged_3(void *environment, int status, const char *category, const char *message)
{
    (void)environment; (void)status; (void)category;
    puts(message);
}

static const struct { void *logger, *allocate, *release, *finished, *environment; } calls = {(void *)logged_2};

#define FOUND(name) ((void *)GetProcAddress(library, name))
#define CALL(type, name, ...) ((int (*) type)FOUND(name))(__VA_ARGS__)
#define MAKE(type, name, ...) ((void *(*) type)FOUND(name))(__VA_ARGS__)

static int ask(void *one, int fmi, const uint32_t *which, size_t count, double *values, bool set)
{
    if (fmi == 2)
        return CALL((void *, const uint32_t *, size_t, double *), set ? "fmi2SetReal" : "fmi2GetReal", one, which, count, values);
    return CALL((void *, const uint32_t *, size_t, double *, size_t), set ? "fmi3SetFloat64" : "fmi3GetFloat64", one, which,
                count, values, count);
}

static int step(void *one, int fmi, double time, double length)
{
    bool event, terminate, early;
    double reached;
    if (fmi == 2)
        return CALL((void *, double, double, int), "fmi2DoStep", one, time, length, 1);
    return CALL((void *, double, double, bool, bool *, bool *, bool *, double *), "fmi3DoStep", one, time, length, true, &event,
                &terminate, &early, &reached);
}

/* Arguments: library, version of FMI, token, period, outputs. Torques come in, as numbers; outputs go out, as bits. */
int main(int count, char **given)
{
    const int fmi = atoi(given[2]), outputs = atoi(given[5]);
    const double period = atof(given[4]);
    uint32_t first = 1u, which[16];
    double torque, values[16];
    uint64_t word;
    long i;
    int k, bad = 0;
    void *one;
    library = LoadLibraryA(given[1]);
    if (count != 6 || library == NULL)
        return 2;
    for (k = 0; k < outputs; k++)
        which[k] = 2u + (uint32_t)k;
    if (fmi == 2)
    {
        one = MAKE((const char *, int, const char *, const char *, const void *, int, int), "fmi2Instantiate", "a", 1, given[3], "",
                   &calls, 0, 0);
        bad += CALL((void *, int, double, double, int, double), "fmi2SetupExperiment", one, 0, 0.0, 0.0, 0, 0.0);
        bad += CALL((void *), "fmi2EnterInitializationMode", one) + CALL((void *), "fmi2ExitInitializationMode", one);
    }
    else
    {
        one = MAKE((const char *, const char *, const char *, bool, bool, bool, bool, const void *, size_t, void *, void *, void *),
                   "fmi3InstantiateCoSimulation", "a", given[3], NULL, false, false, false, false, NULL, 0u, NULL,
                   (void *)logged_3, NULL);
        bad += CALL((void *, bool, double, double, bool, double), "fmi3EnterInitializationMode", one, false, 0.0, 0.0, false, 0.0);
        bad += CALL((void *), "fmi3ExitInitializationMode", one);
    }
    for (i = 0; scanf("%lf", &torque) == 1; i++)
    {
        bad += ask(one, fmi, &first, 1u, &torque, true) + step(one, fmi, (double)i * period, period);
        bad += ask(one, fmi, which, (size_t)outputs, values, false);
        for (k = 0; k < outputs; k++)
        {
            memcpy(&word, &values[k], sizeof(word));
            printf("%08lx%08lx ", (unsigned long)(word >> 32), (unsigned long)(word & 0xffffffffu));
        }
        puts("");
    }
    bad += step(one, fmi, (double)i * period, 0.3 * period) == 0;
    (void)((void (*)(void *))FOUND(fmi == 2 ? "fmi2FreeInstance" : "fmi3FreeInstance"))(one);
    return bad;
}
