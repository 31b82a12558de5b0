/* FMI 2.0: what co-simulation and model exchange have in common. */
#include "fmi2_front.h"

#include <stdlib.h>
#include <string.h>

enum {
    CAN_GET = ANY_MODE & ~INSTANTIATED,
    CAN_SET = INSTANTIATED | INITIALIZATION | EVENT | STEP | CONTINUOUS_TIME,
    CAN_SAVE = ANY_MODE & ~FAILED
};

/* The logger takes a format, in which '#' marks a variable as '%' marks an argument. Both may
 * stand in a name, so both are doubled; a text too long ends early. */
static void log_message(const Instance *instance, Status status, const char *category,
                        const char *text)
{
    const fmi2CallbackLogger logger = (fmi2CallbackLogger)instance->callback;
    char message[1024];
    size_t n = 0;
    if (!logger)
        return;
    for (; *text && n + 2 < sizeof message; ++text) {
        if (*text == '%' || *text == '#')
            message[n++] = *text;
        message[n++] = *text;
    }
    message[n] = '\0';
    logger(instance->environment, instance->name, (fmi2Status)status, category, message);
}

const char *fmi2GetTypesPlatform(void)
{
    return fmi2TypesPlatform;
}

const char *fmi2GetVersion(void)
{
    return fmi2Version;
}

fmi2Component fmi2Instantiate(fmi2String instanceName, fmi2Type fmuType, fmi2String fmuGUID,
                              fmi2String fmuResourceLocation,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible,
                              fmi2Boolean loggingOn)
{
    (void)visible;
    Instance *instance = instance_new(instanceName ? instanceName : "");
    if (!instance)
        return NULL;
    instance->log = log_message;
    instance->callback = functions ? (void (*)(void))functions->logger : NULL;
    instance->environment = functions ? functions->componentEnvironment : NULL;
    instance->logs_all = loggingOn;
    if (!functions || !instanceName || !*instanceName)
        report(instance, ERROR, __func__, "%s", functions ? "instanceName is empty"
                                                          : "functions is NULL");
    else if (fmuType != interface_type)
        report(instance, ERROR, __func__, "only %s is supported",
               interface_type == fmi2CoSimulation ? "fmi2CoSimulation" : "fmi2ModelExchange");
    else if (instance_open(instance, __func__, fmuGUID, fmuResourceLocation))
        return instance;
    instance_free(instance);
    return NULL;
}

void fmi2FreeInstance(fmi2Component c)
{
    Instance *instance = c;
    if (instance && behaviour.close)
        behaviour.close(instance->hidden);
    instance_free(instance);
}

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean loggingOn, size_t nCategories,
                               const fmi2String categories[])
{
    Instance *instance = enter(c, __func__, ANY_MODE);
    if (!instance)
        return fmi2Error;
    if (nCategories && !categories)
        return status_of(report(instance, ERROR, __func__, "categories is NULL"));
    instance->logs_all = loggingOn;
    return fmi2OK;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean toleranceDefined, fmi2Real tolerance,
                               fmi2Real startTime, fmi2Boolean stopTimeDefined, fmi2Real stopTime)
{
    Instance *instance = enter(c, __func__, INSTANTIATED);
    return instance ? status_of(set_experiment(instance, __func__, toleranceDefined, tolerance,
                                               startTime, stopTimeDefined, stopTime))
                    : fmi2Error;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
    Instance *instance = enter(c, __func__, INSTANTIATED);
    if (!instance)
        return fmi2Error;
    if (!instance->standing.is_set_up)
        return status_of(report(instance, ERROR, __func__, "call fmi2SetupExperiment first"));
    instance->standing.mode = INITIALIZATION;
    return fmi2OK;
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    Instance *instance = enter(c, __func__, INITIALIZATION);
    if (!instance)
        return fmi2Error;
    end_initialization(instance, mode_after_initialization);
    return fmi2OK;
}

fmi2Status fmi2Terminate(fmi2Component c)
{
    return change_mode(c, __func__, EVENT | STEP | STEP_DISCARDED | CONTINUOUS_TIME, TERMINATED);
}

fmi2Status fmi2Reset(fmi2Component c)
{
    Instance *instance = enter(c, __func__, ANY_MODE);
    if (!instance)
        return fmi2Error;
    reset_by_importer(instance);
    return fmi2OK;
}

fmi2Status change_mode(fmi2Component c, const char *function, unsigned from, Mode to)
{
    Instance *instance = enter(c, function, from);
    if (!instance)
        return fmi2Error;
    instance->standing.mode = to;
    return fmi2OK;
}

/* ---- Values -------------------------------------------------------------------------------- */

#define VALUES(NAME, TYPE)                                                                         \
    fmi2Status fmi2Get##NAME(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,           \
                             fmi2##NAME value[])                                                   \
    {                                                                                              \
        Instance *instance = enter(c, __func__, CAN_GET);                                          \
        return instance ? status_of(read_values(instance, __func__, TYPE, vr, nvr, value, nvr))    \
                        : fmi2Error;                                                               \
    }                                                                                              \
    fmi2Status fmi2Set##NAME(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,           \
                             const fmi2##NAME value[])                                             \
    {                                                                                              \
        Instance *instance = enter(c, __func__, CAN_SET);                                          \
        return instance ? status_of(write_values(instance, __func__, TYPE, vr, nvr, value, nvr))   \
                        : fmi2Error;                                                               \
    }

VALUES(Real, FLOAT64)
VALUES(Integer, INT32)

/* An fmi2Boolean is an int, 0 or not. */
fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                          fmi2Boolean value[])
{
    Instance *instance = enter(c, __func__, CAN_GET);
    if (!instance || (nvr && !value))
        return fmi2Error;
    for (size_t i = 0; i < nvr; ++i) {
        bool held;
        if (read_values(instance, __func__, BOOLEAN, &vr[i], 1, &held, 1) != OK)
            return fmi2Error;
        value[i] = held ? fmi2True : fmi2False;
    }
    return fmi2OK;
}

fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                          const fmi2Boolean value[])
{
    Instance *instance = enter(c, __func__, CAN_SET);
    if (!instance || (nvr && !value))
        return fmi2Error;
    for (size_t i = 0; i < nvr; ++i)
        if (!writable(instance, __func__, BOOLEAN, vr[i]).place)
            return fmi2Error;
    for (size_t i = 0; i < nvr; ++i) {
        const bool held = value[i] != fmi2False;
        write_values(instance, __func__, BOOLEAN, &vr[i], 1, &held, 1);
    }
    return fmi2OK;
}

fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                         fmi2String value[])
{
    Instance *instance = enter(c, __func__, CAN_GET);
    return instance ? status_of(read_texts(instance, __func__, vr, nvr, value, nvr)) : fmi2Error;
}

fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                         const fmi2String value[])
{
    Instance *instance = enter(c, __func__, CAN_SET);
    return instance ? status_of(write_texts(instance, __func__, vr, nvr, value, nvr)) : fmi2Error;
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference vUnknown_ref[],
                                        size_t nUnknown, const fmi2ValueReference vKnown_ref[],
                                        size_t nKnown, const fmi2Real dvKnown[],
                                        fmi2Real dvUnknown[])
{
    (void)vUnknown_ref;
    (void)nUnknown;
    (void)vKnown_ref;
    (void)nKnown;
    (void)dvKnown;
    (void)dvUnknown;
    Instance *instance = enter(c, __func__, CAN_GET);
    return instance ? status_of(report(instance, ERROR, __func__,
                                       "directional derivatives are not provided"))
                    : fmi2Error;
}

/* ---- Saved states -------------------------------------------------------------------------- */

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *FMUstate)
{
    Instance *instance = enter(c, __func__, CAN_SAVE);
    if (!instance || !CAN_GET_AND_SET_STATE)
        return status_of(no_saved_states(instance, __func__));
    return status_of(save(instance, __func__, FMUstate));
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate FMUstate)
{
    Instance *instance = enter(c, __func__, ANY_MODE);
    if (!instance || !CAN_GET_AND_SET_STATE)
        return status_of(no_saved_states(instance, __func__));
    return status_of(restore(instance, __func__, FMUstate));
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *FMUstate)
{
    Instance *instance = enter(c, __func__, ANY_MODE);
    if (!instance || !CAN_GET_AND_SET_STATE)
        return status_of(no_saved_states(instance, __func__));
    if (FMUstate) {
        free(*FMUstate);
        *FMUstate = NULL;
    }
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate FMUstate, size_t *size)
{
    Instance *instance = enter(c, __func__, ANY_MODE);
    if (!instance || !CAN_SERIALIZE_STATE)
        return status_of(no_saved_states(instance, __func__));
    if (check_saved(instance, __func__, FMUstate) != OK)
        return fmi2Error;
    *size = saved_size();
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate FMUstate, fmi2Byte serializedState[],
                                 size_t size)
{
    Instance *instance = enter(c, __func__, ANY_MODE);
    if (!instance || !CAN_SERIALIZE_STATE)
        return status_of(no_saved_states(instance, __func__));
    if (check_saved(instance, __func__, FMUstate) != OK)
        return fmi2Error;
    if (size < saved_size())
        return status_of(report(instance, ERROR, __func__, "%zu bytes are too few for %zu", size,
                                saved_size()));
    memcpy(serializedState, FMUstate, saved_size());
    return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte serializedState[], size_t size,
                                   fmi2FMUstate *FMUstate)
{
    Instance *instance = enter(c, __func__, ANY_MODE);
    if (!instance || !CAN_SERIALIZE_STATE)
        return status_of(no_saved_states(instance, __func__));
    return status_of(deserialize(instance, __func__, serializedState, size, FMUstate));
}
