/* FMI 3.0: functions that no FMU of this collection supports, and those of the interfaces that this
 * FMU does not have. They are exported all the same, as importers look for them, and refuse with a
 * message. */
#include "fmi3_front.h"

#if defined __GNUC__
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif

static fmi3Status refuse(fmi3Instance instance, const char *function)
{
    if (instance)
        report(instance, ERROR, function, "this FMU does not support it");
    return fmi3Error;
}

#define REFUSED(NAME, ...)                                                                         \
    fmi3Status NAME(fmi3Instance instance, __VA_ARGS__)                                            \
    {                                                                                              \
        return refuse(instance, #NAME);                                                            \
    }
#define REFUSED_PLAIN(NAME)                                                                        \
    fmi3Status NAME(fmi3Instance instance)                                                         \
    {                                                                                              \
        return refuse(instance, #NAME);                                                            \
    }

static fmi3Instance no_interface(const char *function, fmi3InstanceEnvironment environment,
                                 fmi3LogMessageCallback logger)
{
    if (logger)
        logger(environment, fmi3Error, "logStatusError", function);
    return NULL;
}

#ifndef MODEL_EXCHANGE
fmi3Instance fmi3InstantiateModelExchange(fmi3String instanceName, fmi3String instantiationToken,
                                          fmi3String resourcePath, fmi3Boolean visible,
                                          fmi3Boolean loggingOn,
                                          fmi3InstanceEnvironment instanceEnvironment,
                                          fmi3LogMessageCallback logMessage)
{
    return no_interface("fmi3InstantiateModelExchange: this FMU is for co-simulation",
                        instanceEnvironment, logMessage);
}
REFUSED_PLAIN(fmi3EnterContinuousTimeMode)
REFUSED(fmi3CompletedIntegratorStep, fmi3Boolean noSetFMUStatePriorToCurrentPoint,
        fmi3Boolean *enterEventMode, fmi3Boolean *terminateSimulation)
REFUSED(fmi3SetTime, fmi3Float64 time)
REFUSED(fmi3SetContinuousStates, const fmi3Float64 continuousStates[], size_t nContinuousStates)
REFUSED(fmi3GetContinuousStates, fmi3Float64 continuousStates[], size_t nContinuousStates)
REFUSED(fmi3GetContinuousStateDerivatives, fmi3Float64 derivatives[], size_t nContinuousStates)
REFUSED(fmi3GetEventIndicators, fmi3Float64 eventIndicators[], size_t nEventIndicators)
REFUSED(fmi3GetNominalsOfContinuousStates, fmi3Float64 nominals[], size_t nContinuousStates)
REFUSED(fmi3GetNumberOfContinuousStates, size_t *nContinuousStates)
REFUSED(fmi3GetNumberOfEventIndicators, size_t *nEventIndicators)
#else
fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath,
    fmi3Boolean visible, fmi3Boolean loggingOn, fmi3Boolean eventModeUsed,
    fmi3Boolean earlyReturnAllowed, const fmi3ValueReference requiredIntermediateVariables[],
    size_t nRequiredIntermediateVariables, fmi3InstanceEnvironment instanceEnvironment,
    fmi3LogMessageCallback logMessage, fmi3IntermediateUpdateCallback intermediateUpdate)
{
    return no_interface("fmi3InstantiateCoSimulation: this FMU is for model exchange",
                        instanceEnvironment, logMessage);
}
REFUSED_PLAIN(fmi3EnterStepMode)
REFUSED(fmi3GetOutputDerivatives, const fmi3ValueReference valueReferences[],
        size_t nValueReferences, const fmi3Int32 orders[], fmi3Float64 values[], size_t nValues)
REFUSED(fmi3DoStep, fmi3Float64 currentCommunicationPoint, fmi3Float64 communicationStepSize,
        fmi3Boolean noSetFMUStatePriorToCurrentPoint, fmi3Boolean *eventHandlingNeeded,
        fmi3Boolean *terminateSimulation, fmi3Boolean *earlyReturn,
        fmi3Float64 *lastSuccessfulTime)
#endif

fmi3Instance fmi3InstantiateScheduledExecution(
    fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath,
    fmi3Boolean visible, fmi3Boolean loggingOn, fmi3InstanceEnvironment instanceEnvironment,
    fmi3LogMessageCallback logMessage, fmi3ClockUpdateCallback clockUpdate,
    fmi3LockPreemptionCallback lockPreemption, fmi3UnlockPreemptionCallback unlockPreemption)
{
    return no_interface("fmi3InstantiateScheduledExecution: this FMU has no model partitions",
                        instanceEnvironment, logMessage);
}

REFUSED(fmi3SetClock, const fmi3ValueReference valueReferences[], size_t nValueReferences,
        const fmi3Clock values[])
REFUSED(fmi3GetNumberOfVariableDependencies, fmi3ValueReference valueReference,
        size_t *nDependencies)
REFUSED(fmi3GetVariableDependencies, fmi3ValueReference dependent,
        size_t elementIndicesOfDependent[], fmi3ValueReference independents[],
        size_t elementIndicesOfIndependents[], fmi3DependencyKind dependencyKinds[],
        size_t nDependencies)
REFUSED(fmi3GetDirectionalDerivative, const fmi3ValueReference unknowns[], size_t nUnknowns,
        const fmi3ValueReference knowns[], size_t nKnowns, const fmi3Float64 seed[], size_t nSeed,
        fmi3Float64 sensitivity[], size_t nSensitivity)
REFUSED(fmi3GetAdjointDerivative, const fmi3ValueReference unknowns[], size_t nUnknowns,
        const fmi3ValueReference knowns[], size_t nKnowns, const fmi3Float64 seed[], size_t nSeed,
        fmi3Float64 sensitivity[], size_t nSensitivity)
REFUSED(fmi3GetIntervalDecimal, const fmi3ValueReference valueReferences[],
        size_t nValueReferences, fmi3Float64 intervals[], fmi3IntervalQualifier qualifiers[])
REFUSED(fmi3GetIntervalFraction, const fmi3ValueReference valueReferences[],
        size_t nValueReferences, fmi3UInt64 counters[], fmi3UInt64 resolutions[],
        fmi3IntervalQualifier qualifiers[])
REFUSED(fmi3GetShiftDecimal, const fmi3ValueReference valueReferences[], size_t nValueReferences,
        fmi3Float64 shifts[])
REFUSED(fmi3GetShiftFraction, const fmi3ValueReference valueReferences[], size_t nValueReferences,
        fmi3UInt64 counters[], fmi3UInt64 resolutions[])
REFUSED(fmi3SetIntervalDecimal, const fmi3ValueReference valueReferences[],
        size_t nValueReferences, const fmi3Float64 intervals[])
REFUSED(fmi3SetIntervalFraction, const fmi3ValueReference valueReferences[],
        size_t nValueReferences, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])
REFUSED(fmi3SetShiftDecimal, const fmi3ValueReference valueReferences[], size_t nValueReferences,
        const fmi3Float64 shifts[])
REFUSED(fmi3SetShiftFraction, const fmi3ValueReference valueReferences[], size_t nValueReferences,
        const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])

REFUSED_PLAIN(fmi3EvaluateDiscreteStates)
REFUSED(fmi3ActivateModelPartition, fmi3ValueReference clockReference, fmi3Float64 activationTime)
