/* FMI 3.0: model exchange. */
#include "fmi3_front.h"

#include <string.h>

fmi3Instance fmi3InstantiateModelExchange(fmi3String instanceName, fmi3String instantiationToken,
                                          fmi3String resourcePath, fmi3Boolean visible,
                                          fmi3Boolean loggingOn,
                                          fmi3InstanceEnvironment instanceEnvironment,
                                          fmi3LogMessageCallback logMessage)
{
    (void)visible;
    return instantiate(__func__, instanceName, instantiationToken, resourcePath, loggingOn,
                       instanceEnvironment, logMessage);
}

Mode mode_after_initialization(const Instance *instance)
{
    (void)instance;
    return EVENT;
}

/* Nothing beyond what the mode says. */
bool may_be_set(const Instance *instance, const char *function,
                const fmi3ValueReference reference[], size_t n)
{
    (void)instance;
    (void)function;
    (void)reference;
    (void)n;
    return true;
}

fmi3Status fmi3EnterEventMode(fmi3Instance c)
{
    return change_mode(c, __func__, CONTINUOUS_TIME, EVENT);
}

fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c)
{
    return change_mode(c, __func__, EVENT, CONTINUOUS_TIME);
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c,
                                       fmi3Boolean noSetFMUStatePriorToCurrentPoint,
                                       fmi3Boolean *enterEventMode,
                                       fmi3Boolean *terminateSimulation)
{
    (void)noSetFMUStatePriorToCurrentPoint;
    if (!enter(c, __func__, CONTINUOUS_TIME))
        return fmi3Error;
    *enterEventMode = false;
    *terminateSimulation = false;
    return fmi3OK;
}

fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 time)
{
    Instance *instance = enter(c, __func__, CONTINUOUS_TIME);
    if (!instance)
        return fmi3Error;
    if (!isfinite(time))
        return status_of(report(instance, ERROR, __func__, "the time is %g", time));
    if (time > instance->standing.stop_time)
        return status_of(report(instance, ERROR, __func__, "%.17g is beyond the stop time %.17g",
                                time, instance->standing.stop_time));
    instance->standing.time = time;
    return fmi3OK;
}

/* The instance if the call is allowed and `n` is the right number of values, else NULL. */
static Instance *enter_vector(fmi3Instance c, const char *function, unsigned allowed, size_t n,
                              int expected)
{
    Instance *instance = enter(c, function, allowed);
    if (instance && n != (size_t)expected) {
        report(instance, ERROR, function, "%zu values, expected %d", n, expected);
        return NULL;
    }
    return instance;
}

enum { EVALUATES = INITIALIZATION | EVENT | CONTINUOUS_TIME | TERMINATED };

fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 continuousStates[],
                                   size_t nContinuousStates)
{
    Instance *instance = enter_vector(c, __func__, CONTINUOUS_TIME, nContinuousStates,
                                      behaviour.continuous_states);
    if (!instance)
        return fmi3Error;
    memcpy(behaviour.continuous_state(instance->state), continuousStates,
           nContinuousStates * sizeof(double));
    return fmi3OK;
}

fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 continuousStates[],
                                   size_t nContinuousStates)
{
    Instance *instance = enter_vector(c, __func__, EVALUATES, nContinuousStates,
                                      behaviour.continuous_states);
    if (!instance)
        return fmi3Error;
    memcpy(continuousStates, behaviour.continuous_state(instance->state),
           nContinuousStates * sizeof(double));
    return fmi3OK;
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 derivatives[],
                                             size_t nContinuousStates)
{
    Instance *instance = enter_vector(c, __func__, EVALUATES, nContinuousStates,
                                      behaviour.continuous_states);
    if (!instance)
        return fmi3Error;
    behaviour.derivatives(instance->state, instance->standing.time, derivatives);
    return fmi3OK;
}

fmi3Status fmi3GetEventIndicators(fmi3Instance c, fmi3Float64 eventIndicators[],
                                  size_t nEventIndicators)
{
    Instance *instance = enter_vector(c, __func__, EVALUATES, nEventIndicators,
                                      behaviour.event_indicators);
    if (!instance)
        return fmi3Error;
    if (behaviour.indicators)
        behaviour.indicators(instance->state, instance->standing.time, eventIndicators);
    return fmi3OK;
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64 nominals[],
                                             size_t nContinuousStates)
{
    if (!enter_vector(c, __func__, EVALUATES, nContinuousStates, behaviour.continuous_states))
        return fmi3Error;
    memcpy(nominals, behaviour.nominals, nContinuousStates * sizeof(double));
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *nContinuousStates)
{
    if (!enter(c, __func__, ANY_MODE & ~CONFIGURATION))
        return fmi3Error;
    *nContinuousStates = (size_t)behaviour.continuous_states;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *nEventIndicators)
{
    if (!enter(c, __func__, ANY_MODE & ~CONFIGURATION))
        return fmi3Error;
    *nEventIndicators = (size_t)behaviour.event_indicators;
    return fmi3OK;
}
