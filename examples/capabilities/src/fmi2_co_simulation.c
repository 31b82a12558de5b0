/* FMI 2.0: co-simulation. */
#include "fmi2_front.h"

#include <stddef.h>

const fmi2Type interface_type = fmi2CoSimulation;
const Mode mode_after_initialization = STEP;

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                       const fmi2Integer order[], const fmi2Real value[])
{
    Instance *instance = enter(c, __func__, INSTANTIATED | INITIALIZATION | STEP);
    return instance ? status_of(set_input_derivatives(instance, __func__, vr, nvr, order, value))
                    : fmi2Error;
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                        const fmi2Integer order[], fmi2Real value[])
{
    Instance *instance = enter(c, __func__, STEP | STEP_DISCARDED | TERMINATED | FAILED);
    return instance ? status_of(get_output_derivatives(instance, __func__, vr, nvr, order, value))
                    : fmi2Error;
}

/* A step that ends early is discarded; so is one after which the slave wants to end. */
fmi2Status fmi2DoStep(fmi2Component c, fmi2Real currentCommunicationPoint,
                      fmi2Real communicationStepSize, fmi2Boolean noSetFMUStatePriorToCurrentPoint)
{
    (void)noSetFMUStatePriorToCurrentPoint; /* saved states belong to the caller */
    Instance *instance = enter(c, __func__, STEP);
    if (!instance)
        return fmi2Error;
    Step step = {.t = currentCommunicationPoint, .h = communicationStepSize};
    const Status status = take_step(instance, __func__, &step);
    if (status != OK)
        return status_of(status);
    instance->standing.wants_to_end = step.terminate;
    if (!step.terminate && step.reached >= step.t + step.h)
        return fmi2OK;
    instance->standing.mode = STEP_DISCARDED;
    return status_of(report(instance, DISCARD, __func__, "the step from %.17g to %.17g ends at %.17g: %s",
                            step.t, step.t + step.h, step.reached,
                            step.terminate ? "the simulation is to end" : "it is too long"));
}

fmi2Status fmi2CancelStep(fmi2Component c)
{
    enter(c, __func__, 0); /* fmi2DoStep is never pending */
    return fmi2Error;
}

/* The instance if `kind` is the one status that `function` can tell, else NULL and the status to
 * return. */
static Instance *enter_status(fmi2Component c, const char *function, int kind, int supported,
                              const void *value, fmi2Status *status)
{
    Instance *instance = enter(c, function, STEP | STEP_DISCARDED | TERMINATED | FAILED);
    *status = fmi2Error;
    if (!instance || !value)
        return NULL;
    if (kind != supported) {
        *status = status_of(
            report(instance, DISCARD, function, "status kind %d is not available", kind));
        return NULL;
    }
    *status = fmi2OK;
    return instance;
}

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind s, fmi2Status *value)
{
    fmi2Status status;
    const Instance *instance = enter_status(c, __func__, s, fmi2DoStepStatus, value, &status);
    if (instance)
        *value = instance->standing.mode == STEP_DISCARDED ? fmi2Discard
                 : instance->standing.mode == FAILED       ? fmi2Error
                                                           : fmi2OK;
    return status;
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind s, fmi2Real *value)
{
    fmi2Status status;
    const Instance *instance = enter_status(c, __func__, s, fmi2LastSuccessfulTime, value, &status);
    if (instance)
        *value = instance->standing.time;
    return status;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind s, fmi2Boolean *value)
{
    fmi2Status status;
    const Instance *instance = enter_status(c, __func__, s, fmi2Terminated, value, &status);
    if (instance)
        *value = instance->standing.wants_to_end ? fmi2True : fmi2False;
    return status;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind s, fmi2Integer *value)
{
    fmi2Status status;
    enter_status(c, __func__, s, -1, value, &status);
    return status;
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind s, fmi2String *value)
{
    fmi2Status status;
    enter_status(c, __func__, s, -1, value, &status);
    return status;
}
