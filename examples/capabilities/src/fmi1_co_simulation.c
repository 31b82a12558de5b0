/* FMI 1.0: co-simulation, stand-alone. There are no saved states in FMI 1.0. */
#include "instance.h"

#include "fmi1Functions.h"

#if defined _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

/* fmi1DoStep -> <modelIdentifier>_fmiDoStep */
#define JOIN(A, B) A##_fmi##B
#define EXPAND(A, B) JOIN(A, B)
#define FMI(NAME) EXPORT fmi1##NAME##TYPE EXPAND(FMU_IDENTIFIER, NAME)
#define fmi1(NAME) EXPAND(FMU_IDENTIFIER, NAME)

FMI(GetTypesPlatform);
FMI(GetVersion);
FMI(InstantiateSlave);
FMI(InitializeSlave);
FMI(TerminateSlave);
FMI(ResetSlave);
FMI(FreeSlaveInstance);
FMI(SetDebugLogging);
FMI(SetReal);
FMI(SetInteger);
FMI(SetBoolean);
FMI(SetString);
FMI(GetReal);
FMI(GetInteger);
FMI(GetBoolean);
FMI(GetString);
FMI(SetRealInputDerivatives);
FMI(GetRealOutputDerivatives);
FMI(DoStep);
FMI(CancelStep);
FMI(GetStatus);
FMI(GetRealStatus);
FMI(GetIntegerStatus);
FMI(GetBooleanStatus);
FMI(GetStringStatus);

enum {
    CAN_GET = STEP | STEP_DISCARDED | TERMINATED | FAILED,
    CAN_SET = INSTANTIATED | STEP
};

static fmi1Status status_of(Status status)
{
    return (fmi1Status)status; /* the same numbers */
}

/* The logger takes a format, in which '#' marks a variable as '%' marks an argument. */
static void log_message(const Instance *instance, Status status, const char *category,
                        const char *text)
{
    const fmi1CallbackLogger logger = (fmi1CallbackLogger)instance->callback;
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
    logger((fmi1Component)instance, instance->name, (fmi1Status)status, category, message);
}

const char *fmi1(GetTypesPlatform)(void)
{
    return "standard32";
}

const char *fmi1(GetVersion)(void)
{
    return "1.0";
}

fmi1Component fmi1(InstantiateSlave)(fmi1String instanceName, fmi1String fmuGUID,
                                     fmi1String fmuLocation, fmi1String mimeType, fmi1Real timeout,
                                     fmi1Boolean visible, fmi1Boolean interactive,
                                     fmi1CallbackFunctions functions, fmi1Boolean loggingOn)
{
    (void)mimeType;
    (void)timeout;
    (void)visible;
    (void)interactive;
    Instance *instance = instance_new(instanceName ? instanceName : "");
    if (!instance)
        return NULL;
    instance->log = log_message;
    instance->callback = (void (*)(void))functions.logger;
    instance->logs_all = loggingOn;
    if (!instanceName || !*instanceName)
        report(instance, ERROR, __func__, "instanceName is empty");
    else if (instance_open(instance, __func__, fmuGUID, fmuLocation))
        return instance;
    instance_free(instance);
    return NULL;
}

fmi1Status fmi1(InitializeSlave)(fmi1Component c, fmi1Real tStart, fmi1Boolean StopTimeDefined,
                                 fmi1Real tStop)
{
    Instance *instance = enter(c, __func__, INSTANTIATED);
    if (!instance || set_experiment(instance, __func__, false, 0.0, tStart, StopTimeDefined,
                                    tStop) != OK)
        return fmi1Error;
    end_initialization(instance, STEP);
    return fmi1OK;
}

fmi1Status fmi1(TerminateSlave)(fmi1Component c)
{
    Instance *instance = enter(c, __func__, STEP | STEP_DISCARDED);
    if (!instance)
        return fmi1Error;
    instance->standing.mode = TERMINATED;
    return fmi1OK;
}

fmi1Status fmi1(ResetSlave)(fmi1Component c)
{
    Instance *instance = enter(c, __func__, STEP | STEP_DISCARDED | TERMINATED | FAILED);
    if (!instance)
        return fmi1Error;
    reset_by_importer(instance);
    return fmi1OK;
}

void fmi1(FreeSlaveInstance)(fmi1Component c)
{
    Instance *instance = c;
    if (instance && behaviour.close)
        behaviour.close(instance->hidden);
    instance_free(instance);
}

fmi1Status fmi1(SetDebugLogging)(fmi1Component c, fmi1Boolean loggingOn)
{
    Instance *instance = enter(c, __func__, ANY_MODE);
    if (!instance)
        return fmi1Error;
    instance->logs_all = loggingOn;
    return fmi1OK;
}

/* ---- Values -------------------------------------------------------------------------------- */

#define VALUES(NAME, TYPE)                                                                         \
    fmi1Status fmi1(Get##NAME)(fmi1Component c, const fmi1ValueReference vr[], size_t nvr,         \
                               fmi1##NAME value[])                                                 \
    {                                                                                              \
        Instance *instance = enter(c, __func__, CAN_GET);                                          \
        return instance ? status_of(read_values(instance, __func__, TYPE, vr, nvr, value, nvr))    \
                        : fmi1Error;                                                               \
    }                                                                                              \
    fmi1Status fmi1(Set##NAME)(fmi1Component c, const fmi1ValueReference vr[], size_t nvr,         \
                               const fmi1##NAME value[])                                           \
    {                                                                                              \
        Instance *instance = enter(c, __func__, CAN_SET);                                          \
        return instance ? status_of(write_values(instance, __func__, TYPE, vr, nvr, value, nvr))   \
                        : fmi1Error;                                                               \
    }

VALUES(Real, FLOAT64)
VALUES(Integer, INT32)
VALUES(Boolean, BOOLEAN) /* an fmi1Boolean is a char of 0 or 1, and so is a bool */

fmi1Status fmi1(GetString)(fmi1Component c, const fmi1ValueReference vr[], size_t nvr,
                           fmi1String value[])
{
    Instance *instance = enter(c, __func__, CAN_GET);
    return instance ? status_of(read_texts(instance, __func__, vr, nvr, value, nvr)) : fmi1Error;
}

fmi1Status fmi1(SetString)(fmi1Component c, const fmi1ValueReference vr[], size_t nvr,
                           const fmi1String value[])
{
    Instance *instance = enter(c, __func__, CAN_SET);
    return instance ? status_of(write_texts(instance, __func__, vr, nvr, value, nvr)) : fmi1Error;
}

fmi1Status fmi1(SetRealInputDerivatives)(fmi1Component c, const fmi1ValueReference vr[],
                                         size_t nvr, const fmi1Integer order[],
                                         const fmi1Real value[])
{
    Instance *instance = enter(c, __func__, CAN_SET);
    return instance ? status_of(set_input_derivatives(instance, __func__, vr, nvr, order, value))
                    : fmi1Error;
}

fmi1Status fmi1(GetRealOutputDerivatives)(fmi1Component c, const fmi1ValueReference vr[],
                                          size_t nvr, const fmi1Integer order[], fmi1Real value[])
{
    Instance *instance = enter(c, __func__, CAN_GET);
    return instance ? status_of(get_output_derivatives(instance, __func__, vr, nvr, order, value))
                    : fmi1Error;
}

/* ---- Steps --------------------------------------------------------------------------------- */

/* canRejectSteps is false: `newStep` must be true, a step is not taken twice. */
fmi1Status fmi1(DoStep)(fmi1Component c, fmi1Real currentCommunicationPoint,
                        fmi1Real communicationStepSize, fmi1Boolean newStep)
{
    Instance *instance = enter(c, __func__, STEP);
    if (!instance)
        return fmi1Error;
    if (!newStep)
        return status_of(report(instance, ERROR, __func__,
                                "newStep is false, but steps cannot be rejected"));
    Step step = {.t = currentCommunicationPoint, .h = communicationStepSize};
    const Status status = take_step(instance, __func__, &step);
    if (status != OK || step.reached >= step.t + step.h)
        return status_of(status);
    instance->standing.mode = STEP_DISCARDED;
    return status_of(report(instance, DISCARD, __func__, "the step ends at %.17g", step.reached));
}

fmi1Status fmi1(CancelStep)(fmi1Component c)
{
    enter(c, __func__, 0); /* fmiDoStep is never pending */
    return fmi1Error;
}

fmi1Status fmi1(GetStatus)(fmi1Component c, const fmi1StatusKind s, fmi1Status *value)
{
    const Instance *instance = enter(c, __func__, CAN_GET);
    if (!instance || s != fmi1DoStepStatus)
        return instance ? fmi1Discard : fmi1Error;
    *value = instance->standing.mode == STEP_DISCARDED ? fmi1Discard
             : instance->standing.mode == FAILED       ? fmi1Error
                                                       : fmi1OK;
    return fmi1OK;
}

fmi1Status fmi1(GetRealStatus)(fmi1Component c, const fmi1StatusKind s, fmi1Real *value)
{
    const Instance *instance = enter(c, __func__, CAN_GET);
    if (!instance || s != fmi1LastSuccessfulTime)
        return instance ? fmi1Discard : fmi1Error;
    *value = instance->standing.time;
    return fmi1OK;
}

/* No status of these types is available. */
#define NO_STATUS(NAME)                                                                            \
    fmi1Status fmi1(Get##NAME##Status)(fmi1Component c, const fmi1StatusKind s, fmi1##NAME *value) \
    {                                                                                              \
        (void)s;                                                                                   \
        (void)value;                                                                               \
        return enter(c, __func__, CAN_GET) ? fmi1Discard : fmi1Error;                              \
    }

NO_STATUS(Integer)
NO_STATUS(Boolean)
NO_STATUS(String)
