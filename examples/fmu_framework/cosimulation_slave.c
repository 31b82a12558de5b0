#include "cosimulation_slave.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static const double DEFAULT_TOLERANCE = 1e-6;

/* Below it rounding looks like integration error, and the step size would chase noise. */
static const double MIN_TOLERANCE = 1e-14;

/* What is allowed when (FMI 2.0, section 4.2.4). A call that is refused, for its time or for its
 * arguments, has no effect at all: only a step that fails moves the slave to ERROR, from where
 * fmi2SetFMUstate and fmi2Reset lead back. */
enum {
    ANY_MODE = INSTANTIATED | INITIALIZATION_MODE | STEP_COMPLETE | STEP_FAILED | TERMINATED | ERROR,
    CAN_SETUP_EXPERIMENT = INSTANTIATED,
    CAN_ENTER_INITIALIZATION = INSTANTIATED,
    CAN_EXIT_INITIALIZATION = INITIALIZATION_MODE,
    CAN_DO_STEP = STEP_COMPLETE,
    CAN_CANCEL_STEP = 0, /* fmi2DoStep is never pending */
    CAN_TERMINATE = STEP_COMPLETE | STEP_FAILED,
    CAN_RESET = ANY_MODE,
    CAN_SET = INSTANTIATED | INITIALIZATION_MODE | STEP_COMPLETE,
    CAN_SET_START_VALUES = INSTANTIATED | INITIALIZATION_MODE,
    CAN_GET = ANY_MODE & ~INSTANTIATED,
    CAN_GET_OUTPUT_DERIVATIVES = STEP_COMPLETE | STEP_FAILED | TERMINATED | ERROR,
    CAN_GET_STATUS = STEP_COMPLETE | STEP_FAILED | TERMINATED | ERROR
};

/* ---- Logging ------------------------------------------------------------------------------- */

enum { LOG_WARNING, LOG_DISCARD, LOG_ERROR, LOG_CATEGORIES };

static const char *const CATEGORIES[LOG_CATEGORIES] = {"logStatusWarning", "logStatusDiscard",
                                                       "logStatusError"};
static const unsigned ALL_CATEGORIES = (1u << LOG_CATEGORIES) - 1u;

static int category_of(fmi2Status status)
{
    return status == fmi2Warning ? LOG_WARNING : status == fmi2Discard ? LOG_DISCARD : LOG_ERROR;
}

/* The logger takes a format, in which '#' marks a variable as '%' marks an argument. Both may
 * stand in a name, so both are doubled; a text too long ends early. */
static void escape(char *out, size_t size, const char *text)
{
    size_t n = 0;
    for (; *text && n + 2 < size; ++text) {
        if (*text == '%' || *text == '#')
            out[n++] = *text;
        out[n++] = *text;
    }
    out[n] = '\0';
}

static void log_message(const Slave *slave, fmi2Status status, const char *text)
{
    char message[1024];
    if (!slave->logger)
        return;
    escape(message, sizeof message, text);
    slave->logger(slave->environment, slave->name, status, CATEGORIES[category_of(status)],
                  message);
}

fmi2Status report(const Slave *slave, fmi2Status status, const char *function, const char *format,
                  ...)
{
    char text[512];
    va_list arguments;
    if (status != fmi2Error && !(slave->log_categories & 1u << category_of(status)))
        return status;
    const int n = snprintf(text, sizeof text, "%s: ", function);
    va_start(arguments, format);
    vsnprintf(text + n, sizeof text - (size_t)n, format, arguments);
    va_end(arguments);
    log_message(slave, status, text);
    return status;
}

/* ---- Life cycle ---------------------------------------------------------------------------- */

static const char *mode_name(unsigned mode)
{
    switch (mode) {
    case INSTANTIATED:
        return "instantiated";
    case INITIALIZATION_MODE:
        return "initialization mode";
    case STEP_COMPLETE:
        return "step complete";
    case STEP_FAILED:
        return "step failed";
    case TERMINATED:
        return "terminated";
    default:
        return "error";
    }
}

Slave *enter(fmi2Component component, const char *function, unsigned allowed)
{
    Slave *slave = component;
    if (!slave || (unsigned)slave->state.mode & allowed)
        return slave;

    char modes[128] = "never";
    size_t n = 0;
    for (unsigned mode = INSTANTIATED; mode <= ERROR; mode <<= 1)
        if (mode & allowed)
            n += (size_t)snprintf(modes + n, sizeof modes - n, "%s%s", n ? ", " : "",
                                  mode_name(mode));
    report(slave, fmi2Error, function, "called in mode '%s'; allowed in: %s",
           mode_name((unsigned)slave->state.mode), modes);
    return NULL;
}

static void set_start_values(SlaveState *state)
{
    memset(state, 0, sizeof *state);
    state->stop_time = INFINITY;
    state->tolerance = DEFAULT_TOLERANCE;
    memcpy(state->x, model.start, sizeof state->x);
    memcpy(state->p, model.parameter_start, sizeof state->p);
    state->mode = INSTANTIATED;
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
    (void)fmuResourceLocation;
    (void)visible;
    const char *name = instanceName && *instanceName ? instanceName : model.identifier;
    const size_t length = strlen(name) + 1;
    Slave *slave = calloc(1, sizeof *slave + length);
    if (!slave)
        return NULL;
    memcpy(slave->name, name, length);
    if (functions) {
        slave->logger = functions->logger;
        slave->environment = functions->componentEnvironment;
    }
    slave->log_categories = loggingOn ? ALL_CATEGORIES : 0u;
    set_start_values(&slave->state);

    if (!functions)
        report(slave, fmi2Error, __func__, "functions is NULL");
    else if (name != instanceName)
        report(slave, fmi2Error, __func__, "instanceName is empty");
    else if (fmuType != fmi2CoSimulation)
        report(slave, fmi2Error, __func__, "only fmi2CoSimulation is supported");
    else if (!fmuGUID || strcmp(fmuGUID, model.guid) != 0)
        report(slave, fmi2Error, __func__, "the guid is %s, expected %s of model '%s'",
               fmuGUID ? fmuGUID : "NULL", model.guid, model.identifier);
    else
        return slave;
    free(slave);
    return NULL;
}

void fmi2FreeInstance(fmi2Component c)
{
    free(c);
}

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean loggingOn, size_t nCategories,
                               const fmi2String categories[])
{
    Slave *slave = enter(c, __func__, ANY_MODE);
    if (!slave)
        return fmi2Error;
    if (nCategories && !categories)
        return report(slave, fmi2Error, __func__, "categories is NULL");

    unsigned chosen = nCategories ? 0u : ALL_CATEGORIES;
    for (size_t i = 0; i < nCategories; ++i) {
        int found = 0;
        while (found < LOG_CATEGORIES &&
               !(categories[i] && strcmp(categories[i], CATEGORIES[found]) == 0))
            ++found;
        if (found == LOG_CATEGORIES)
            return report(slave, fmi2Error, __func__, "there is no log category '%s'",
                          categories[i] ? categories[i] : "NULL");
        chosen |= 1u << found;
    }
    slave->log_categories = loggingOn ? chosen : 0u;
    return fmi2OK;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean toleranceDefined, fmi2Real tolerance,
                               fmi2Real startTime, fmi2Boolean stopTimeDefined, fmi2Real stopTime)
{
    Slave *slave = enter(c, __func__, CAN_SETUP_EXPERIMENT);
    if (!slave)
        return fmi2Error;
    if (toleranceDefined && !(tolerance > 0.0 && tolerance < 1.0))
        return report(slave, fmi2Error, __func__, "the tolerance is %g, not between 0 and 1",
                      tolerance);
    if (!isfinite(startTime))
        return report(slave, fmi2Error, __func__, "the start time is %g", startTime);
    if (stopTimeDefined && !(stopTime > startTime))
        return report(slave, fmi2Error, __func__, "the stop time %g is not after the start time %g",
                      stopTime, startTime);

    SlaveState *state = &slave->state;
    state->tolerance = toleranceDefined ? fmax(tolerance, MIN_TOLERANCE) : DEFAULT_TOLERANCE;
    state->time = startTime;
    state->stop_time = stopTimeDefined ? stopTime : INFINITY;
    state->experiment_is_set_up = 1;
    if (toleranceDefined && tolerance < MIN_TOLERANCE)
        return report(slave, fmi2Warning, __func__, "the tolerance %g is out of reach, using %g",
                      tolerance, MIN_TOLERANCE);
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
    Slave *slave = enter(c, __func__, CAN_ENTER_INITIALIZATION);
    if (!slave)
        return fmi2Error;
    if (!slave->state.experiment_is_set_up)
        return report(slave, fmi2Error, __func__, "call fmi2SetupExperiment first");
    slave->state.mode = INITIALIZATION_MODE;
    return fmi2OK;
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    Slave *slave = enter(c, __func__, CAN_EXIT_INITIALIZATION);
    if (!slave)
        return fmi2Error;
    slave->state.mode = STEP_COMPLETE;
    return fmi2OK;
}

fmi2Status fmi2Terminate(fmi2Component c)
{
    Slave *slave = enter(c, __func__, CAN_TERMINATE);
    if (!slave)
        return fmi2Error;
    slave->state.mode = TERMINATED;
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component c)
{
    Slave *slave = enter(c, __func__, CAN_RESET);
    if (!slave)
        return fmi2Error;
    set_start_values(&slave->state);
    return fmi2OK;
}

/* ---- Inputs -------------------------------------------------------------------------------- */

/* u(time + tau). With `order` > 0 its derivative. */
static void input_values(const SlaveState *state, int order, double tau, double u[])
{
    for (int i = 0; i < model.inputs; ++i) {
        double value = 0.0;
        for (int j = MAX_INPUT_ORDER; j >= order; --j)
            value = state->u[j][i] + value * tau / (j - order + 1);
        u[i] = value;
    }
}

/* Expand the input polynomials anew at time + tau. */
static void shift_inputs(SlaveState *state, double tau)
{
    for (int order = 0; order <= MAX_INPUT_ORDER; ++order)
        input_values(state, order, tau, state->u[order]);
}

/* ---- Values -------------------------------------------------------------------------------- */

static void right_hand_side(const void *context, double tau, const double x[], double dx[])
{
    const SlaveState *state = context;
    double u[MAX_INPUTS];
    input_values(state, 0, tau, u);
    model.derivatives(state->p, x, u, dx);
}

/* The index of `vr` within `block`, or -1. */
static int index_in(fmi2ValueReference vr, unsigned block, int n)
{
    return vr >= block && vr - block < (unsigned)n ? (int)(vr - block) : -1;
}

/* Where the value of `vr` is stored, NULL if it is calculated or there is no such variable. */
static double *stored(SlaveState *state, fmi2ValueReference vr)
{
    const fmi2ValueReference block = vr - vr % BLOCK_SIZE;
    const unsigned i = vr % BLOCK_SIZE;
    if (block == INPUT && i < (unsigned)model.inputs)
        return &state->u[0][i];
    if (block == STATE && i < (unsigned)model.states)
        return &state->x[i];
    if (block == PARAMETER && i < (unsigned)model.parameters)
        return &state->p[i];
    return vr == MAX_STEP ? &state->max_step : NULL;
}

static fmi2Status check_arguments(const Slave *slave, const char *function, size_t nvr,
                                  const void *vr, const void *value)
{
    if (nvr && (!vr || !value))
        return report(slave, fmi2Error, function, "%s is NULL", vr ? "value" : "vr");
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                       fmi2Real value[])
{
    Slave *slave = enter(c, __func__, CAN_GET);
    if (!slave || check_arguments(slave, __func__, nvr, vr, value) != fmi2OK)
        return fmi2Error;

    SlaveState *state = &slave->state;
    for (size_t i = 0; i < nvr; ++i) {
        const double *held = stored(state, vr[i]);
        const int derivative = index_in(vr[i], DERIVATIVE, model.states);
        const int output = index_in(vr[i], OUTPUT, model.outputs);
        if (held) {
            value[i] = *held;
        } else if (derivative >= 0) {
            double dx[MAX_STATES];
            right_hand_side(state, 0.0, state->x, dx);
            value[i] = dx[derivative];
        } else if (output >= 0) {
            double y[MAX_OUTPUTS];
            model.output_values(state->time, state->p, state->x, state->u[0], y);
            value[i] = y[output];
        } else {
            return report(slave, fmi2Error, __func__, "no Real variable has value reference %u",
                          vr[i]);
        }
    }
    return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                       const fmi2Real value[])
{
    Slave *slave = enter(c, __func__, CAN_SET);
    if (!slave || check_arguments(slave, __func__, nvr, vr, value) != fmi2OK)
        return fmi2Error;

    SlaveState *state = &slave->state;
    for (size_t i = 0; i < nvr; ++i) {
        if (!stored(state, vr[i]))
            return report(slave, fmi2Error, __func__,
                          "no Real variable that can be set has value reference %u", vr[i]);
        const int parameter = index_in(vr[i], PARAMETER, model.parameters);
        const bool is_tunable = parameter >= 0 && model.is_tunable[parameter];
        if (index_in(vr[i], INPUT, model.inputs) < 0 && !is_tunable &&
            !(state->mode & CAN_SET_START_VALUES))
            return report(slave, fmi2Error, __func__,
                          "value reference %u is neither an input nor a tunable parameter: it can "
                          "be set until fmi2ExitInitializationMode",
                          vr[i]);
        if (vr[i] == MAX_STEP && !(value[i] >= 0.0))
            return report(slave, fmi2Error, __func__, "max_step is %g, not 0 or more", value[i]);
    }
    for (size_t i = 0; i < nvr; ++i) {
        const int input = index_in(vr[i], INPUT, model.inputs);
        *stored(state, vr[i]) = value[i];
        for (int order = 1; input >= 0 && order <= MAX_INPUT_ORDER; ++order)
            state->u[order][input] = 0.0;
    }
    return fmi2OK;
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                       const fmi2Integer order[], const fmi2Real value[])
{
    Slave *slave = enter(c, __func__, CAN_SET);
    if (!slave || check_arguments(slave, __func__, nvr, vr, value) != fmi2OK)
        return fmi2Error;
    if (nvr && !order)
        return report(slave, fmi2Error, __func__, "order is NULL");

    for (size_t i = 0; i < nvr; ++i) {
        if (index_in(vr[i], INPUT, model.inputs) < 0)
            return report(slave, fmi2Error, __func__, "no input has value reference %u", vr[i]);
        if (order[i] < 1 || order[i] > MAX_INPUT_ORDER)
            return report(slave, fmi2Error, __func__,
                          "order %d of value reference %u; orders 1 to %d are supported", order[i],
                          vr[i], MAX_INPUT_ORDER);
    }
    for (size_t i = 0; i < nvr; ++i)
        slave->state.u[order[i]][vr[i] - INPUT] = value[i];
    return fmi2OK;
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                        const fmi2Integer order[], fmi2Real value[])
{
    Slave *slave = enter(c, __func__, CAN_GET_OUTPUT_DERIVATIVES);
    if (!slave || check_arguments(slave, __func__, nvr, vr, value) != fmi2OK)
        return fmi2Error;
    if (nvr && !order)
        return report(slave, fmi2Error, __func__, "order is NULL");

    const SlaveState *state = &slave->state;
    double dx[MAX_STATES] = {0.0}, dy[MAX_OUTPUTS];
    if (model.states)
        right_hand_side(state, 0.0, state->x, dx);
    if (model.outputs)
        model.output_derivatives(state->time, state->p, state->x, dx, state->u[0], state->u[1], dy);

    for (size_t i = 0; i < nvr; ++i) {
        const int output = index_in(vr[i], OUTPUT, model.outputs);
        const int x = index_in(vr[i], STATE, model.states_are_outputs ? model.states : 0);
        if (output < 0 && x < 0)
            return report(slave, fmi2Error, __func__, "no output has value reference %u", vr[i]);
        if (order[i] != 1)
            return report(slave, fmi2Error, __func__,
                          "order %d of value reference %u; only order 1 is supported", order[i],
                          vr[i]);
        value[i] = output >= 0 ? dy[output] : dx[x];
    }
    return fmi2OK;
}

/* ---- Stepping ------------------------------------------------------------------------------ */

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real currentCommunicationPoint,
                      fmi2Real communicationStepSize, fmi2Boolean noSetFMUStatePriorToCurrentPoint)
{
    (void)noSetFMUStatePriorToCurrentPoint; /* saved states belong to the caller */
    Slave *slave = enter(c, __func__, CAN_DO_STEP);
    if (!slave)
        return fmi2Error;

    SlaveState *state = &slave->state;
    const double t = currentCommunicationPoint, h = communicationStepSize;
    if (!(t + h > t && isfinite(t + h)))
        return report(slave, fmi2Error, __func__,
                      "communicationStepSize %.17g does not advance the time %.17g", h, t);
    if (t != state->time)
        return report(slave, fmi2Error, __func__,
                      "currentCommunicationPoint is %.17g, but the slave stands at %.17g", t,
                      state->time);
    if (t + h > state->stop_time)
        return report(slave, fmi2Error, __func__,
                      "the step from %.17g to %.17g leads beyond the stop time %.17g", t, t + h,
                      state->stop_time);

    const double reach = state->max_step > 0.0 ? fmin(h, state->max_step) : h;
    const InitialValueProblem problem = {.n = model.states,
                                         .right_hand_side = right_hand_side,
                                         .context = state,
                                         .tolerance = state->tolerance,
                                         .nominal = model.nominal};
    const IntegrationResult result = dormand_prince(&problem, reach, state->x, &state->micro_step);
    if (result != REACHED_END) {
        state->mode = ERROR;
        return report(slave, fmi2Error, __func__, "step from %.17g to %.17g: %s", t, t + reach,
                      result == STEP_UNDERFLOW
                          ? "the integrator's step size underflows; look for inputs, start values "
                            "or parameters that are not finite, or a mass of 0"
                          : "the integrator needs too many steps; the parameters make the model "
                            "too stiff");
    }
    state->time = t + reach;
    shift_inputs(state, reach);
    if (reach < h) {
        state->mode = STEP_FAILED;
        return report(slave, fmi2Discard, __func__,
                      "the step of %.17g from %.17g is longer than max_step and ends at %.17g", h,
                      t, state->time);
    }
    return fmi2OK;
}

fmi2Status fmi2CancelStep(fmi2Component c)
{
    enter(c, __func__, CAN_CANCEL_STEP);
    return fmi2Error;
}

/* The slave if `kind` is the one status that `function` can tell, else NULL and the status to
 * return. */
static Slave *enter_status(fmi2Component c, const char *function, int kind, int supported,
                           const void *value, fmi2Status *status)
{
    Slave *slave = enter(c, function, CAN_GET_STATUS);
    *status = fmi2Error;
    if (!slave)
        return NULL;
    if (!value) {
        report(slave, fmi2Error, function, "value is NULL");
        return NULL;
    }
    if (kind != supported) {
        *status = report(slave, fmi2Discard, function, "status kind %d is not available", kind);
        return NULL;
    }
    *status = fmi2OK;
    return slave;
}

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind s, fmi2Status *value)
{
    fmi2Status status;
    const Slave *slave = enter_status(c, __func__, s, fmi2DoStepStatus, value, &status);
    if (slave)
        *value = slave->state.mode == STEP_FAILED ? fmi2Discard
                 : slave->state.mode == ERROR     ? fmi2Error
                                                  : fmi2OK;
    return status;
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind s, fmi2Real *value)
{
    fmi2Status status;
    const Slave *slave = enter_status(c, __func__, s, fmi2LastSuccessfulTime, value, &status);
    if (slave)
        *value = slave->state.time;
    return status;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind s, fmi2Boolean *value)
{
    fmi2Status status;
    if (enter_status(c, __func__, s, fmi2Terminated, value, &status))
        *value = fmi2False; /* the slave never asks for the end of the simulation */
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

/* ---- What these slaves do not have --------------------------------------------------------- */

static fmi2Status no_variables(fmi2Component c, const char *function, unsigned allowed, size_t nvr,
                               const char *type)
{
    const Slave *slave = enter(c, function, allowed);
    if (!slave)
        return fmi2Error;
    return nvr ? report(slave, fmi2Error, function, "there are no %s variables", type) : fmi2OK;
}

#define NO_VARIABLES(TYPE)                                                                         \
    fmi2Status fmi2Get##TYPE(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,           \
                             fmi2##TYPE value[])                                                   \
    {                                                                                              \
        (void)vr;                                                                                  \
        (void)value;                                                                               \
        return no_variables(c, __func__, CAN_GET, nvr, #TYPE);                                     \
    }                                                                                              \
    fmi2Status fmi2Set##TYPE(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,           \
                             const fmi2##TYPE value[])                                             \
    {                                                                                              \
        (void)vr;                                                                                  \
        (void)value;                                                                               \
        return no_variables(c, __func__, CAN_SET, nvr, #TYPE);                                     \
    }

NO_VARIABLES(Integer)
NO_VARIABLES(Boolean)
NO_VARIABLES(String)

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
    const Slave *slave = enter(c, __func__, CAN_GET);
    return slave ? report(slave, fmi2Error, __func__, "directional derivatives are not provided")
                 : fmi2Error;
}
