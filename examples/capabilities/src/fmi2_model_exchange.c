/* FMI 2.0: model exchange. */
#include "fmi2_front.h"

#include <math.h>
#include <string.h>

const fmi2Type interface_type = fmi2ModelExchange;
const Mode mode_after_initialization = EVENT;

fmi2Status fmi2EnterEventMode(fmi2Component c)
{
    return change_mode(c, __func__, CONTINUOUS_TIME, EVENT);
}

fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c)
{
    return change_mode(c, __func__, EVENT, CONTINUOUS_TIME);
}

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *eventInfo)
{
    Instance *instance = enter(c, __func__, EVENT);
    if (!instance || !eventInfo)
        return fmi2Error;
    double next = INFINITY;
    const bool jumped = behaviour.update && behaviour.update(instance->state,
                                                             instance->standing.time, &next);
    memset(eventInfo, 0, sizeof *eventInfo); /* one update is enough */
    eventInfo->valuesOfContinuousStatesChanged = jumped;
    eventInfo->nextEventTimeDefined = isfinite(next);
    eventInfo->nextEventTime = isfinite(next) ? next : 0.0;
    return fmi2OK;
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component c,
                                       fmi2Boolean noSetFMUStatePriorToCurrentPoint,
                                       fmi2Boolean *enterEventMode,
                                       fmi2Boolean *terminateSimulation)
{
    (void)noSetFMUStatePriorToCurrentPoint;
    if (!enter(c, __func__, CONTINUOUS_TIME))
        return fmi2Error;
    *enterEventMode = fmi2False;
    *terminateSimulation = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time)
{
    Instance *instance = enter(c, __func__, CONTINUOUS_TIME | EVENT);
    if (!instance)
        return fmi2Error;
    if (!isfinite(time))
        return status_of(report(instance, ERROR, __func__, "the time is %g", time));
    if (time > instance->standing.stop_time)
        return status_of(report(instance, ERROR, __func__, "%.17g is beyond the stop time %.17g",
                                time, instance->standing.stop_time));
    instance->standing.time = time;
    return fmi2OK;
}

/* The instance if the call is allowed and `n` is the right number of values, else NULL. */
static Instance *enter_vector(fmi2Component c, const char *function, unsigned allowed, size_t n,
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

fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t nx)
{
    Instance *instance =
        enter_vector(c, __func__, CONTINUOUS_TIME, nx, behaviour.continuous_states);
    if (!instance)
        return fmi2Error;
    memcpy(behaviour.continuous_state(instance->state), x, nx * sizeof(double));
    return fmi2OK;
}

fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t nx)
{
    Instance *instance = enter_vector(c, __func__, EVALUATES, nx, behaviour.continuous_states);
    if (!instance)
        return fmi2Error;
    memcpy(x, behaviour.continuous_state(instance->state), nx * sizeof(double));
    return fmi2OK;
}

fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real derivatives[], size_t nx)
{
    Instance *instance = enter_vector(c, __func__, EVALUATES, nx, behaviour.continuous_states);
    if (!instance)
        return fmi2Error;
    behaviour.derivatives(instance->state, instance->standing.time, derivatives);
    return fmi2OK;
}

fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real eventIndicators[], size_t ni)
{
    Instance *instance = enter_vector(c, __func__, EVALUATES, ni, behaviour.event_indicators);
    if (!instance)
        return fmi2Error;
    if (behaviour.indicators)
        behaviour.indicators(instance->state, instance->standing.time, eventIndicators);
    return fmi2OK;
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x_nominal[], size_t nx)
{
    if (!enter_vector(c, __func__, EVALUATES | INSTANTIATED, nx, behaviour.continuous_states))
        return fmi2Error;
    memcpy(x_nominal, behaviour.nominals, nx * sizeof(double));
    return fmi2OK;
}
