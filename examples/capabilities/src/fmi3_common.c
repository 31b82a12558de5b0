/* FMI 3.0: what co-simulation and model exchange have in common. */
#include "fmi3_front.h"

#include <stdlib.h>
#include <string.h>

/* Between steps, and whatever stands for it in model exchange. */
enum {
    CAN_GET = ANY_MODE & ~CONFIGURATION,
    CAN_SET = INSTANTIATED | CONFIGURATION | INITIALIZATION | EVENT | STEP | INTERMEDIATE_UPDATE |
              CONTINUOUS_TIME,
    CAN_SAVE = ANY_MODE & ~(FAILED | INTERMEDIATE_UPDATE),
    CAN_RESTORE = ANY_MODE & ~INTERMEDIATE_UPDATE
};

static void log_message(const Instance *instance, Status status, const char *category,
                        const char *text)
{
    const fmi3LogMessageCallback logger = (fmi3LogMessageCallback)instance->callback;
    if (logger)
        logger(instance->environment, (fmi3Status)status, category, text);
}

Instance *instantiate(const char *function, fmi3String name, fmi3String token,
                      fmi3String resources, bool logging_on, fmi3InstanceEnvironment environment,
                      fmi3LogMessageCallback logger)
{
    Instance *instance = instance_new(name ? name : "");
    if (!instance)
        return NULL;
    instance->log = log_message;
    instance->callback = (void (*)(void))logger;
    instance->environment = environment;
    instance->logs_all = logging_on;
    if (name && *name) {
        if (instance_open(instance, function, token, resources))
            return instance;
    } else {
        report(instance, ERROR, function, "instanceName is empty");
    }
    instance_free(instance);
    return NULL;
}

void fmi3FreeInstance(fmi3Instance c)
{
    Instance *instance = c;
    if (instance && behaviour.close)
        behaviour.close(instance->hidden);
    instance_free(instance);
}

const char *fmi3GetVersion(void)
{
    return fmi3Version;
}

fmi3Status fmi3SetDebugLogging(fmi3Instance c, fmi3Boolean loggingOn, size_t nCategories,
                               const fmi3String categories[])
{
    Instance *instance = enter(c, __func__, ANY_MODE);
    if (!instance)
        return fmi3Error;
    if (nCategories && !categories)
        return status_of(report(instance, ERROR, __func__, "categories is NULL"));
    instance->logs_all = loggingOn;
    return fmi3OK;
}

fmi3Status fmi3EnterConfigurationMode(fmi3Instance c)
{
    return change_mode(c, __func__, INSTANTIATED, CONFIGURATION);
}

fmi3Status fmi3ExitConfigurationMode(fmi3Instance c)
{
    Instance *instance = enter(c, __func__, CONFIGURATION);
    if (!instance)
        return fmi3Error;
    const char *reason =
        behaviour.check_structure ? behaviour.check_structure(instance->state) : NULL;
    if (reason)
        return status_of(report(instance, ERROR, __func__, "%s", reason));
    instance->standing.mode = INSTANTIATED;
    return fmi3OK;
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean toleranceDefined,
                                       fmi3Float64 tolerance, fmi3Float64 startTime,
                                       fmi3Boolean stopTimeDefined, fmi3Float64 stopTime)
{
    Instance *instance = enter(c, __func__, INSTANTIATED);
    if (!instance || set_experiment(instance, __func__, toleranceDefined, tolerance, startTime,
                                    stopTimeDefined, stopTime) != OK)
        return fmi3Error;
    instance->standing.mode = INITIALIZATION;
    return fmi3OK;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance c)
{
    Instance *instance = enter(c, __func__, INITIALIZATION);
    if (!instance)
        return fmi3Error;
    end_initialization(instance, mode_after_initialization(instance));
    return fmi3OK;
}

fmi3Status fmi3Terminate(fmi3Instance c)
{
    return change_mode(c, __func__, EVENT | STEP | STEP_DISCARDED | CONTINUOUS_TIME, TERMINATED);
}

fmi3Status fmi3Reset(fmi3Instance c)
{
    Instance *instance = enter(c, __func__, ANY_MODE & ~INTERMEDIATE_UPDATE);
    if (!instance)
        return fmi3Error;
    reset_by_importer(instance);
    return fmi3OK;
}

fmi3Status change_mode(fmi3Instance c, const char *function, unsigned from, Mode to)
{
    Instance *instance = enter(c, function, from);
    if (!instance)
        return fmi3Error;
    instance->standing.mode = to;
    return fmi3OK;
}

/* ---- Values -------------------------------------------------------------------------------- */

#define VALUES(NAME, TYPE)                                                                         \
    fmi3Status fmi3Get##NAME(fmi3Instance c, const fmi3ValueReference valueReferences[],           \
                             size_t nValueReferences, fmi3##NAME values[], size_t nValues)         \
    {                                                                                              \
        Instance *instance = enter(c, __func__, CAN_GET);                                          \
        if (!instance)                                                                             \
            return fmi3Error;                                                                      \
        return status_of(read_values(instance, __func__, TYPE, valueReferences, nValueReferences,  \
                                     values, nValues));                                            \
    }                                                                                              \
    fmi3Status fmi3Set##NAME(fmi3Instance c, const fmi3ValueReference valueReferences[],           \
                             size_t nValueReferences, const fmi3##NAME values[], size_t nValues)   \
    {                                                                                              \
        Instance *instance = enter(c, __func__, CAN_SET);                                          \
        if (!instance || !may_be_set(instance, __func__, valueReferences, nValueReferences))       \
            return fmi3Error;                                                                      \
        return status_of(write_values(instance, __func__, TYPE, valueReferences, nValueReferences, \
                                      values, nValues));                                           \
    }

VALUES(Float32, FLOAT32)
VALUES(Float64, FLOAT64)
VALUES(Int8, INT8)
VALUES(UInt8, UINT8)
VALUES(Int16, INT16)
VALUES(UInt16, UINT16)
VALUES(Int32, INT32)
VALUES(UInt32, UINT32)
VALUES(Int64, INT64)
VALUES(UInt64, UINT64)
VALUES(Boolean, BOOLEAN)

fmi3Status fmi3GetString(fmi3Instance c, const fmi3ValueReference valueReferences[],
                         size_t nValueReferences, fmi3String values[], size_t nValues)
{
    Instance *instance = enter(c, __func__, CAN_GET);
    return instance ? status_of(read_texts(instance, __func__, valueReferences, nValueReferences,
                                           values, nValues))
                    : fmi3Error;
}

fmi3Status fmi3SetString(fmi3Instance c, const fmi3ValueReference valueReferences[],
                         size_t nValueReferences, const fmi3String values[], size_t nValues)
{
    Instance *instance = enter(c, __func__, CAN_SET);
    if (!instance || !may_be_set(instance, __func__, valueReferences, nValueReferences))
        return fmi3Error;
    return status_of(write_texts(instance, __func__, valueReferences, nValueReferences, values,
                                 nValues));
}

static bool binaries_fit(Instance *instance, const char *function,
                         const fmi3ValueReference reference[], size_t expected,
                         const size_t sizes[], const fmi3Binary values[], size_t n)
{
    if (n != expected)
        report(instance, ERROR, function, "%zu values for %zu scalar variables", n, expected);
    else if (n && !(reference && sizes && values))
        report(instance, ERROR, function, "an argument is NULL");
    else
        return true;
    return false;
}

fmi3Status fmi3GetBinary(fmi3Instance c, const fmi3ValueReference valueReferences[],
                         size_t nValueReferences, size_t valueSizes[], fmi3Binary values[],
                         size_t nValues)
{
    Instance *instance = enter(c, __func__, CAN_GET);
    if (!instance || !binaries_fit(instance, __func__, valueReferences, nValueReferences,
                                   valueSizes, values, nValues))
        return fmi3Error;
    if (behaviour.calculate && instance->standing.mode != INSTANTIATED)
        behaviour.calculate(instance->state, instance->standing.time);
    for (size_t i = 0; i < nValueReferences; ++i) {
        const Variable variable = readable(instance, __func__, BINARY, valueReferences[i]);
        if (!variable.place)
            return fmi3Error;
        const Binary *binary = variable.place;
        valueSizes[i] = binary->size;
        values[i] = binary->bytes;
    }
    return fmi3OK;
}

fmi3Status fmi3SetBinary(fmi3Instance c, const fmi3ValueReference valueReferences[],
                         size_t nValueReferences, const size_t valueSizes[],
                         const fmi3Binary values[], size_t nValues)
{
    Instance *instance = enter(c, __func__, CAN_SET);
    if (!instance ||
        !binaries_fit(instance, __func__, valueReferences, nValueReferences, valueSizes, values,
                      nValues) ||
        !may_be_set(instance, __func__, valueReferences, nValueReferences))
        return fmi3Error;
    for (size_t i = 0; i < nValueReferences; ++i) {
        if (!writable(instance, __func__, BINARY, valueReferences[i]).place)
            return fmi3Error;
        if (valueSizes[i] > BINARY_SIZE)
            return status_of(report(instance, ERROR, __func__, "%zu bytes; at most %d fit",
                                    valueSizes[i], BINARY_SIZE));
    }
    for (size_t i = 0; i < nValueReferences; ++i) {
        Binary *binary = writable(instance, __func__, BINARY, valueReferences[i]).place;
        memset(binary, 0, sizeof *binary);
        binary->size = (uint32_t)valueSizes[i];
        memcpy(binary->bytes, values[i], valueSizes[i]);
    }
    return fmi3OK;
}

fmi3Status fmi3GetClock(fmi3Instance c, const fmi3ValueReference valueReferences[],
                        size_t nValueReferences, fmi3Clock values[])
{
    Instance *instance = enter(c, __func__, EVENT | INITIALIZATION);
    return instance ? status_of(read_values(instance, __func__, CLOCK, valueReferences,
                                            nValueReferences, values, nValueReferences))
                    : fmi3Error;
}

/* ---- Saved states -------------------------------------------------------------------------- */

fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *FMUState)
{
    Instance *instance = enter(c, __func__, CAN_SAVE);
    if (!instance || !CAN_GET_AND_SET_STATE)
        return status_of(no_saved_states(instance, __func__));
    return status_of(save(instance, __func__, FMUState));
}

fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState FMUState)
{
    Instance *instance = enter(c, __func__, CAN_RESTORE);
    if (!instance || !CAN_GET_AND_SET_STATE)
        return status_of(no_saved_states(instance, __func__));
    return status_of(restore(instance, __func__, FMUState));
}

fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *FMUState)
{
    Instance *instance = enter(c, __func__, CAN_RESTORE);
    if (!instance || !CAN_GET_AND_SET_STATE)
        return status_of(no_saved_states(instance, __func__));
    if (FMUState) {
        free(*FMUState);
        *FMUState = NULL;
    }
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance c, fmi3FMUState FMUState, size_t *size)
{
    Instance *instance = enter(c, __func__, CAN_RESTORE);
    if (!instance || !CAN_SERIALIZE_STATE)
        return status_of(no_saved_states(instance, __func__));
    if (check_saved(instance, __func__, FMUState) != OK)
        return fmi3Error;
    *size = saved_size();
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState FMUState,
                                 fmi3Byte serializedState[], size_t size)
{
    Instance *instance = enter(c, __func__, CAN_RESTORE);
    if (!instance || !CAN_SERIALIZE_STATE)
        return status_of(no_saved_states(instance, __func__));
    if (check_saved(instance, __func__, FMUState) != OK)
        return fmi3Error;
    if (size < saved_size())
        return status_of(report(instance, ERROR, __func__, "%zu bytes are too few for %zu", size,
                                saved_size()));
    memcpy(serializedState, FMUState, saved_size());
    return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte serializedState[], size_t size,
                                   fmi3FMUState *FMUState)
{
    Instance *instance = enter(c, __func__, CAN_RESTORE);
    if (!instance || !CAN_SERIALIZE_STATE)
        return status_of(no_saved_states(instance, __func__));
    return status_of(deserialize(instance, __func__, serializedState, size, FMUState));
}

/* ---- Events -------------------------------------------------------------------------------- */

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *discreteStatesNeedUpdate,
                                    fmi3Boolean *terminateSimulation,
                                    fmi3Boolean *nominalsOfContinuousStatesChanged,
                                    fmi3Boolean *valuesOfContinuousStatesChanged,
                                    fmi3Boolean *nextEventTimeDefined, fmi3Float64 *nextEventTime)
{
    Instance *instance = enter(c, __func__, EVENT);
    if (!instance)
        return fmi3Error;
    double next = NO_EVENT;
    const bool jumped = behaviour.update && behaviour.update(instance->state,
                                                             instance->standing.time, &next);
    *discreteStatesNeedUpdate = false; /* one update is enough */
    *terminateSimulation = false;
    *nominalsOfContinuousStatesChanged = false;
    *valuesOfContinuousStatesChanged = jumped;
    *nextEventTimeDefined = next < NO_EVENT;
    *nextEventTime = *nextEventTimeDefined ? next : 0.0;
    return fmi3OK;
}
