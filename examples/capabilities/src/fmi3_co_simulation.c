/* FMI 3.0: co-simulation. */
#include "fmi3_front.h"

#include <stdlib.h>

/* Beside the instance. Nothing of it changes after instantiation but `end`. */
typedef struct {
    fmi3IntermediateUpdateCallback intermediate_update;
    bool event_mode_used, early_return_allowed;
    double end;     /* s, where the current step ends: an early return moves it */
    size_t n_required;
    fmi3ValueReference required[]; /* variables that the importer sets and gets in between */
} Front;

fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath,
    fmi3Boolean visible, fmi3Boolean loggingOn, fmi3Boolean eventModeUsed,
    fmi3Boolean earlyReturnAllowed, const fmi3ValueReference requiredIntermediateVariables[],
    size_t nRequiredIntermediateVariables, fmi3InstanceEnvironment instanceEnvironment,
    fmi3LogMessageCallback logMessage, fmi3IntermediateUpdateCallback intermediateUpdate)
{
    (void)visible;
    Instance *instance = instantiate(__func__, instanceName, instantiationToken, resourcePath,
                                     loggingOn, instanceEnvironment, logMessage);
    if (!instance)
        return NULL;
    const size_t n = nRequiredIntermediateVariables;
    Front *front = calloc(1, sizeof *front + n * sizeof(fmi3ValueReference));
    instance->front = front;
    if (front && !(eventModeUsed && !HAS_EVENT_MODE) &&
        !(n && !(PROVIDES_INTERMEDIATE_UPDATE && intermediateUpdate &&
                 requiredIntermediateVariables))) {
        front->intermediate_update = PROVIDES_INTERMEDIATE_UPDATE ? intermediateUpdate : NULL;
        front->event_mode_used = eventModeUsed;
        front->early_return_allowed = earlyReturnAllowed;
        front->n_required = n;
        for (size_t i = 0; i < n; ++i)
            front->required[i] = requiredIntermediateVariables[i];
        return instance;
    }
    report(instance, ERROR, __func__,
           !front          ? "out of memory"
           : eventModeUsed ? "eventModeUsed, but this FMU has no event mode"
                           : "intermediate variables without an intermediate update");
    fmi3FreeInstance(instance);
    return NULL;
}

Mode mode_after_initialization(const Instance *instance)
{
    const Front *front = instance->front;
    return front->event_mode_used ? EVENT : STEP;
}

bool may_be_set(const Instance *instance, const char *function,
                const fmi3ValueReference reference[], size_t n)
{
    if (instance->standing.mode != INTERMEDIATE_UPDATE)
        return true;
    const Front *front = instance->front;
    for (size_t i = 0; i < n; ++i) {
        size_t j = 0;
        while (j < front->n_required && front->required[j] != reference[i])
            ++j;
        if (j == front->n_required) {
            report(instance, ERROR, function,
                   "value reference %u is not among the required intermediate variables",
                   (unsigned)reference[i]);
            return false;
        }
    }
    return true;
}

/* ---- Modes --------------------------------------------------------------------------------- */

fmi3Status fmi3EnterStepMode(fmi3Instance c)
{
    return change_mode(c, __func__, EVENT, STEP);
}

fmi3Status fmi3EnterEventMode(fmi3Instance c)
{
    Instance *instance = enter(c, __func__, STEP);
    if (!instance)
        return fmi3Error;
    const Front *front = instance->front;
    if (!front->event_mode_used)
        return status_of(report(instance, ERROR, __func__, "instantiated without event mode"));
    instance->standing.mode = EVENT;
    return fmi3OK;
}

/* ---- Steps --------------------------------------------------------------------------------- */

/* Calls the importer back at `time`, and returns where the step has to end. */
static double call_back(const Step *step, double time, bool set_requested, bool finished)
{
    Instance *instance = step->importer;
    Front *front = instance->front;
    const Standing standing = instance->standing;
    const bool can_return = finished && CAN_RETURN_EARLY_AFTER_INTERMEDIATE_UPDATE &&
                            front->early_return_allowed;
    fmi3Boolean requested = false;
    fmi3Float64 at = 0.0;
    instance->standing.mode = INTERMEDIATE_UPDATE;
    instance->standing.time = time;
    front->intermediate_update(instance->environment, time, set_requested, finished, finished,
                               can_return, &requested, &at);
    instance->standing = standing;
    if (can_return && requested)
        front->end = fmax(time, fmin(front->end, at));
    return front->end;
}

static void request_inputs(const Step *step, double time)
{
    call_back(step, time, true, false);
}

static double finish_internal_step(const Step *step, double time)
{
    return call_back(step, time, false, true);
}

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 currentCommunicationPoint,
                      fmi3Float64 communicationStepSize,
                      fmi3Boolean noSetFMUStatePriorToCurrentPoint,
                      fmi3Boolean *eventHandlingNeeded, fmi3Boolean *terminateSimulation,
                      fmi3Boolean *earlyReturn, fmi3Float64 *lastSuccessfulTime)
{
    (void)noSetFMUStatePriorToCurrentPoint; /* saved states belong to the caller */
    Instance *instance = enter(c, __func__, STEP);
    if (!instance)
        return fmi3Error;
    if (!eventHandlingNeeded || !terminateSimulation || !earlyReturn || !lastSuccessfulTime)
        return status_of(report(instance, ERROR, __func__, "an argument is NULL"));
    Front *front = instance->front;
    const bool calls_back = front->intermediate_update != NULL;
    const double end = currentCommunicationPoint + communicationStepSize;
    front->end = end;
    Step step = {.t = currentCommunicationPoint,
                 .h = communicationStepSize,
                 .stop_at_events = front->event_mode_used && front->early_return_allowed,
                 .importer = instance,
                 .request_inputs = calls_back ? request_inputs : NULL,
                 .finish_internal_step = calls_back ? finish_internal_step : NULL};
    const Status status = take_step(instance, __func__, &step);
    if (status == OK && step.terminate)
        instance->standing.mode = STEP_DISCARDED; /* no further step */
    *eventHandlingNeeded = status == OK && step.event;
    *terminateSimulation = status == OK && step.terminate;
    *earlyReturn = status == OK && step.reached != end;
    *lastSuccessfulTime = instance->standing.time;
    return status_of(status);
}

fmi3Status fmi3GetOutputDerivatives(fmi3Instance c, const fmi3ValueReference valueReferences[],
                                    size_t nValueReferences, const fmi3Int32 orders[],
                                    fmi3Float64 values[], size_t nValues)
{
    Instance *instance =
        enter(c, __func__, STEP | STEP_DISCARDED | INTERMEDIATE_UPDATE | TERMINATED);
    if (!instance)
        return fmi3Error;
    if (nValues != nValueReferences)
        return status_of(report(instance, ERROR, __func__, "%zu values for %zu variables", nValues,
                                nValueReferences));
    return status_of(get_output_derivatives(instance, __func__, valueReferences, nValueReferences,
                                            orders, values));
}
