#include "instance.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static const double DEFAULT_TOLERANCE = 1e-6;
static const double MIN_TOLERANCE = 1e-14;

static const size_t SIZES[TYPES] = {[FLOAT32] = 4, [FLOAT64] = 8,
                                    [INT8] = 1,    [UINT8] = 1,
                                    [INT16] = 2,   [UINT16] = 2,
                                    [INT32] = 4,   [UINT32] = 4,
                                    [INT64] = 8,   [UINT64] = 8,
                                    [BOOLEAN] = sizeof(bool), [STRING] = TEXT_SIZE,
                                    [BINARY] = sizeof(Binary), [CLOCK] = sizeof(bool)};

static const char *const TYPE_NAMES[TYPES] = {
    "Float32", "Float64", "Int8",   "UInt8",   "Int16",  "UInt16", "Int32",
    "UInt32",  "Int64",   "UInt64", "Boolean", "String", "Binary", "Clock"};

/* ---- Messages ------------------------------------------------------------------------------ */

static const char *category_of(Status status)
{
    return status == WARNING   ? "logStatusWarning"
           : status == DISCARD ? "logStatusDiscard"
                               : "logStatusError";
}

Status report(const Instance *instance, Status status, const char *function, const char *format,
              ...)
{
    char text[512];
    va_list arguments;
    if (!instance->log || (status == DISCARD && !instance->logs_all))
        return status;
    const int n = snprintf(text, sizeof text, "%s: ", function);
    va_start(arguments, format);
    vsnprintf(text + n, sizeof text - (size_t)n, format, arguments);
    va_end(arguments);
    instance->log(instance, status, category_of(status), text);
    return status;
}

static const char *mode_name(unsigned mode)
{
    switch (mode) {
    case INSTANTIATED:
        return "instantiated";
    case CONFIGURATION:
        return "configuration mode";
    case INITIALIZATION:
        return "initialization mode";
    case EVENT:
        return "event mode";
    case STEP:
        return "step mode";
    case STEP_DISCARDED:
        return "step discarded";
    case INTERMEDIATE_UPDATE:
        return "intermediate update mode";
    case CONTINUOUS_TIME:
        return "continuous-time mode";
    case TERMINATED:
        return "terminated";
    default:
        return "failed";
    }
}

Instance *enter(void *component, const char *function, unsigned allowed)
{
    Instance *instance = component;
    if (!instance)
        return NULL;
    if (instance->standing.mode & allowed) {
        const char *reason = behaviour.enter ? behaviour.enter(function) : NULL;
        if (reason)
            report(instance, ERROR, function, "%s", reason);
        return reason ? NULL : instance;
    }

    char modes[160] = "never";
    size_t n = 0;
    for (unsigned mode = INSTANTIATED; mode <= FAILED; mode <<= 1)
        if (mode & allowed)
            n += (size_t)snprintf(modes + n, sizeof modes - n, "%s%s", n ? ", " : "",
                                  mode_name(mode));
    report(instance, ERROR, function, "called in mode '%s'; allowed in: %s",
           mode_name(instance->standing.mode), modes);
    return NULL;
}

/* ---- Life cycle ---------------------------------------------------------------------------- */

Instance *instance_new(const char *name)
{
    const size_t length = strlen(name) + 1;
    Instance *instance = calloc(1, sizeof *instance + length);
    if (!instance)
        return NULL;
    memcpy(instance->name, name, length);
    instance->state = calloc(1, behaviour.state_size);
    instance->hidden = behaviour.hidden_size ? calloc(1, behaviour.hidden_size) : NULL;
    if (!instance->state || (behaviour.hidden_size && !instance->hidden)) {
        free(instance->state);
        free(instance->hidden);
        free(instance);
        return NULL;
    }
    instance_reset(instance);
    return instance;
}

bool instance_open(Instance *instance, const char *function, const char *guid,
                   const char *resources)
{
    if (!guid || strcmp(guid, FMU_GUID) != 0) {
        report(instance, ERROR, function, "the guid is %s, expected %s", guid ? guid : "NULL",
               FMU_GUID);
        return false;
    }
    const char *reason = behaviour.open ? behaviour.open(instance->hidden, resources) : NULL;
    if (reason)
        report(instance, ERROR, function, "%s", reason);
    return !reason;
}

void instance_free(Instance *instance)
{
    if (!instance)
        return;
    free(instance->front);
    free(instance->state);
    free(instance->hidden);
    free(instance);
}

void instance_reset(Instance *instance)
{
    instance->standing = (Standing){
        .stop_time = INFINITY, .tolerance = DEFAULT_TOLERANCE, .mode = INSTANTIATED};
    memset(instance->state, 0, behaviour.state_size);
    behaviour.start(instance->state);
}

/* How a reset goes wrong. */
enum { RESETS, RESET_KEEPS_STATE, RESET_SPOILS };

#ifndef RESET
#define RESET RESETS
#endif

void reset_by_importer(Instance *instance)
{
    if (RESET != RESET_KEEPS_STATE) {
        instance_reset(instance);
        if (RESET == RESET_SPOILS)
            instance->standing.mode = FAILED;
        return;
    }
    instance->standing = (Standing){
        .stop_time = INFINITY, .tolerance = DEFAULT_TOLERANCE, .mode = INSTANTIATED};
}

/* The most value references that one call of input derivatives may have; some tools count them
 * against the number of inputs, whatever the orders. */
#ifndef MOST_DERIVATIVES
#define MOST_DERIVATIVES SIZE_MAX
#endif

Status set_experiment(Instance *instance, const char *function, bool tolerance_defined,
                      double tolerance, double start, bool stop_defined, double stop)
{
    if (tolerance_defined && !(tolerance > 0.0 && tolerance < 1.0))
        return report(instance, ERROR, function, "the tolerance is %g, not between 0 and 1",
                      tolerance);
    if (!isfinite(start))
        return report(instance, ERROR, function, "the start time is %g", start);
    if (stop_defined && !(stop > start))
        return report(instance, ERROR, function,
                      "the stop time %g is not after the start time %g", stop, start);
    Standing *standing = &instance->standing;
    standing->tolerance = tolerance_defined ? fmax(tolerance, MIN_TOLERANCE) : DEFAULT_TOLERANCE;
    standing->time = start;
    standing->stop_time = stop_defined ? stop : INFINITY;
    standing->is_set_up = 1;
    return OK;
}

void end_initialization(Instance *instance, Mode next)
{
    if (behaviour.initialized)
        behaviour.initialized(instance->state, instance->standing.time);
    instance->standing.mode = next;
}

/* ---- Values -------------------------------------------------------------------------------- */

static Variable find(Instance *instance, const char *function, Type type, uint32_t reference)
{
    if (type == FLOAT64 && reference == TIME_REFERENCE)
        return (Variable){&instance->standing.time, 1, READ_ONLY};
    const Variable variable = behaviour.find(instance->state, type, reference);
    if (!variable.place)
        report(instance, ERROR, function, "no %s variable has value reference %u",
               TYPE_NAMES[type], (unsigned)reference);
    return variable;
}

Variable readable(Instance *instance, const char *function, Type type, uint32_t reference)
{
    const Variable variable = find(instance, function, type, reference);
    if (variable.place && variable.access != STRUCTURAL &&
        instance->standing.mode & (INSTANTIATED | CONFIGURATION)) {
        report(instance, ERROR, function,
               "value reference %u can be read from initialization mode on", (unsigned)reference);
        return (Variable){0};
    }
    return variable;
}

Variable writable(Instance *instance, const char *function, Type type, uint32_t reference)
{
    static const unsigned MODES[] = {
        [READ_ONLY] = 0,
        [START_VALUE] = INSTANTIATED | INITIALIZATION,
        [INPUT_VALUE] = INSTANTIATED | INITIALIZATION | EVENT | STEP | INTERMEDIATE_UPDATE |
                        CONTINUOUS_TIME,
        [STRUCTURAL] = CONFIGURATION};
    static const char *const WHEN[] = {
        [READ_ONLY] = "never",
        [START_VALUE] = "when instantiated and in initialization mode",
        [INPUT_VALUE] = "until the end of initialization mode and between steps",
        [STRUCTURAL] = "in configuration mode"};
    const Variable variable = find(instance, function, type, reference);
    if (variable.place && !(instance->standing.mode & MODES[variable.access])) {
        report(instance, ERROR, function, "value reference %u can be set %s, not in mode '%s'",
               (unsigned)reference, WHEN[variable.access], mode_name(instance->standing.mode));
        return (Variable){0};
    }
    return variable;
}

static void calculate(Instance *instance)
{
    const unsigned whole = ANY_MODE & ~(INSTANTIATED | CONFIGURATION | FAILED);
    if (behaviour.calculate && instance->standing.mode & whole)
        behaviour.calculate(instance->state, instance->standing.time);
}

static Status check_arguments(const Instance *instance, const char *function,
                              const uint32_t reference[], size_t n_references, const void *values)
{
    if (n_references && (!reference || !values))
        return report(instance, ERROR, function, "%s is NULL",
                      reference ? "the array of values" : "the array of value references");
    return OK;
}

/* Does `n` fit the number of all values of the variables? */
static Status check_count(const Instance *instance, const char *function, size_t n,
                          size_t expected)
{
    if (n == expected)
        return OK;
    return report(instance, ERROR, function, "%zu values for variables that have %zu", n,
                  expected);
}

/* How many of the first of these `n` value references, at least one, go to or come from places
 * side by side. */
static size_t run_length(Type type, const uint32_t reference[], size_t n)
{
    size_t most = behaviour.side_by_side ? behaviour.side_by_side(type, reference[0]) : 1;
    most = most < n ? most : n;
    size_t length = 1;
    while (length < most && reference[length] == reference[0] + length)
        ++length;
    return length;
}

Status read_values(Instance *instance, const char *function, Type type, const uint32_t reference[],
                   size_t n_references, void *values, size_t n)
{
    if (check_arguments(instance, function, reference, n_references, values) != OK)
        return ERROR;
    calculate(instance);
    size_t expected = 0, run;
    for (size_t i = 0; i < n_references; i += run) {
        const Variable variable = readable(instance, function, type, reference[i]);
        if (!variable.place)
            return ERROR;
        run = run_length(type, &reference[i], n_references - i);
        expected += run * variable.count;
    }
    if (check_count(instance, function, n, expected) != OK)
        return ERROR;
    unsigned char *to = values;
    for (size_t i = 0; i < n_references; i += run) {
        const Variable variable = find(instance, function, type, reference[i]);
        run = run_length(type, &reference[i], n_references - i);
        memcpy(to, variable.place, run * variable.count * SIZES[type]);
        to += run * variable.count * SIZES[type];
    }
    return OK;
}

/* Inputs that are set become constants: of a run of them the derivatives are zeroed. */
static void clear_derivatives(Instance *instance, uint32_t reference, size_t run)
{
    for (int order = 1; order <= MAX_INPUT_DERIVATIVE_ORDER && behaviour.input_derivative;
         ++order) {
        double *derivative = behaviour.input_derivative(instance->state, reference, order);
        if (derivative)
            memset(derivative, 0, run * sizeof *derivative);
    }
}

Status write_values(Instance *instance, const char *function, Type type,
                    const uint32_t reference[], size_t n_references, const void *values, size_t n)
{
    if (check_arguments(instance, function, reference, n_references, values) != OK)
        return ERROR;
    size_t expected = 0, run;
    for (size_t i = 0; i < n_references; i += run) {
        const Variable variable = writable(instance, function, type, reference[i]);
        if (!variable.place)
            return ERROR;
        run = run_length(type, &reference[i], n_references - i);
        expected += run * variable.count;
    }
    if (check_count(instance, function, n, expected) != OK)
        return ERROR;
    const unsigned char *from = values;
    for (size_t i = 0; i < n_references; i += run) {
        const Variable variable = find(instance, function, type, reference[i]);
        run = run_length(type, &reference[i], n_references - i);
        memcpy(variable.place, from, run * variable.count * SIZES[type]);
        from += run * variable.count * SIZES[type];
        if (type == FLOAT64)
            clear_derivatives(instance, reference[i], run);
    }
    return OK;
}

Status read_texts(Instance *instance, const char *function, const uint32_t reference[],
                  size_t n_references, const char *values[], size_t n)
{
    if (check_arguments(instance, function, reference, n_references, values) != OK ||
        check_count(instance, function, n, n_references) != OK)
        return ERROR;
    calculate(instance);
    for (size_t i = 0; i < n_references; ++i) {
        const Variable variable = readable(instance, function, STRING, reference[i]);
        if (!variable.place)
            return ERROR;
        values[i] = variable.place;
    }
    return OK;
}

Status write_texts(Instance *instance, const char *function, const uint32_t reference[],
                   size_t n_references, const char *const values[], size_t n)
{
    if (check_arguments(instance, function, reference, n_references, values) != OK ||
        check_count(instance, function, n, n_references) != OK)
        return ERROR;
    for (size_t i = 0; i < n_references; ++i) {
        if (!writable(instance, function, STRING, reference[i]).place)
            return ERROR;
        if (!values[i] || strlen(values[i]) >= TEXT_SIZE)
            return report(instance, ERROR, function,
                          "the text for value reference %u is %s; at most %d bytes are supported",
                          (unsigned)reference[i], values[i] ? "too long" : "NULL", TEXT_SIZE - 1);
    }
    for (size_t i = 0; i < n_references; ++i) {
        char *place = find(instance, function, STRING, reference[i]).place;
        memset(place, 0, TEXT_SIZE);
        memcpy(place, values[i], strlen(values[i]));
    }
    return OK;
}

/* ---- Derivatives --------------------------------------------------------------------------- */

/* The same as `run_length` for derivatives of these orders. */
static size_t run_of_one_order(const uint32_t reference[], const int order[], size_t n)
{
    const size_t most = run_length(FLOAT64, reference, n);
    size_t length = 1;
    while (length < most && order[length] == order[0])
        ++length;
    return length;
}

Status set_input_derivatives(Instance *instance, const char *function, const uint32_t reference[],
                             size_t n, const int order[], const double value[])
{
    if (check_arguments(instance, function, reference, n, value) != OK)
        return ERROR;
    if (MAX_INPUT_DERIVATIVE_ORDER == 0 || !behaviour.input_derivative)
        return report(instance, ERROR, function, "derivatives of inputs are not supported");
    if (n > MOST_DERIVATIVES)
        return report(instance, ERROR, function, "invalid nvr = %zu (number of inputs = %zu)", n,
                      (size_t)MOST_DERIVATIVES);
    size_t run;
    for (size_t i = 0; i < n; i += run) {
        if (!order || order[i] < 1 || order[i] > MAX_INPUT_DERIVATIVE_ORDER)
            return report(instance, ERROR, function,
                          "order %d of value reference %u; orders 1 to %d are supported",
                          order ? order[i] : 0, (unsigned)reference[i],
                          MAX_INPUT_DERIVATIVE_ORDER);
        if (!behaviour.input_derivative(instance->state, reference[i], order[i]))
            return report(instance, ERROR, function, "no input has value reference %u",
                          (unsigned)reference[i]);
        run = run_of_one_order(&reference[i], &order[i], n - i);
    }
    for (size_t i = 0; i < n; i += run) {
        run = run_of_one_order(&reference[i], &order[i], n - i);
        memcpy(behaviour.input_derivative(instance->state, reference[i], order[i]), &value[i],
               run * sizeof *value);
    }
    return OK;
}

Status get_output_derivatives(Instance *instance, const char *function, const uint32_t reference[],
                              size_t n, const int order[], double value[])
{
    if (check_arguments(instance, function, reference, n, value) != OK)
        return ERROR;
    if (MAX_OUTPUT_DERIVATIVE_ORDER == 0 || !behaviour.output_derivative)
        return report(instance, ERROR, function, "derivatives of outputs are not supported");
    for (size_t i = 0; i < n; ++i)
        if (!order || order[i] < 1 || order[i] > MAX_OUTPUT_DERIVATIVE_ORDER ||
            !behaviour.output_derivative(instance->state, instance->standing.time, reference[i],
                                         order[i], &value[i]))
            return report(instance, ERROR, function,
                          "no output has value reference %u and a derivative of order %d",
                          (unsigned)reference[i], order ? order[i] : 0);
    return OK;
}

/* ---- Saved states -------------------------------------------------------------------------- */

typedef struct {
    uint32_t magic, version;
    uint64_t size; /* bytes, header and state included */
    char guid[40];
    Standing standing;
} Header; /* the state follows */

static const uint32_t STATE_MAGIC = 0x43415041u; /* "CAPA" */

size_t saved_size(void)
{
    return sizeof(Header) + behaviour.state_size;
}

static Header header_of(const Instance *instance)
{
    Header header;
    memset(&header, 0, sizeof header);
    header.magic = STATE_MAGIC;
    header.version = 1;
    header.size = saved_size();
    strncpy(header.guid, FMU_GUID, sizeof header.guid - 1);
    header.standing = instance->standing;
    return header;
}

Status check_saved(const Instance *instance, const char *function, const void *block)
{
    const Header own = header_of(instance);
    Header other;
    if (!block)
        return report(instance, ERROR, function, "the saved state is NULL");
    memcpy(&other, block, sizeof other);
    if (memcmp(&own, &other, offsetof(Header, standing)) != 0)
        return report(instance, ERROR, function, "this is not a saved state of this FMU");
    for (unsigned mode = INSTANTIATED; mode <= TERMINATED; mode <<= 1)
        if (other.standing.mode == mode)
            return OK;
    return report(instance, ERROR, function, "the saved state is damaged: unknown mode %u",
                  (unsigned)other.standing.mode);
}

Status save(Instance *instance, const char *function, void **block)
{
    if (!block)
        return report(instance, ERROR, function, "there is no place for the saved state");
    if (*block && check_saved(instance, function, *block) != OK)
        return ERROR;
    if (!*block && !(*block = malloc(saved_size())))
        return report(instance, ERROR, function, "out of memory");
    const Header header = header_of(instance);
    memcpy(*block, &header, sizeof header);
    memcpy((unsigned char *)*block + sizeof header, instance->state, behaviour.state_size);
    return OK;
}

Status restore(Instance *instance, const char *function, const void *block)
{
    if (check_saved(instance, function, block) != OK)
        return ERROR;
    const unsigned char *saved = (const unsigned char *)block + sizeof(Header);
    if (behaviour.restore) {
        const char *reason = behaviour.restore(instance->state, instance->hidden, saved);
        if (reason)
            return report(instance, ERROR, function, "%s", reason);
    } else {
        memcpy(instance->state, saved, behaviour.state_size);
    }
    Header header;
    memcpy(&header, block, sizeof header);
    instance->standing = header.standing;
    return OK;
}

Status deserialize(Instance *instance, const char *function, const void *bytes, size_t size,
                   void **block)
{
    if (!bytes || !block)
        return report(instance, ERROR, function, "an argument is NULL");
    if (size != saved_size())
        return report(instance, ERROR, function,
                      "the serialized state has %zu bytes, expected %zu", size, saved_size());
    if (check_saved(instance, function, bytes) != OK)
        return ERROR;
    if (*block && check_saved(instance, function, *block) != OK)
        return ERROR;
    if (!*block && !(*block = malloc(size)))
        return report(instance, ERROR, function, "out of memory");
    memcpy(*block, bytes, size);
    return OK;
}

Status no_saved_states(const Instance *instance, const char *function)
{
    return instance ? report(instance, ERROR, function, "the state cannot be saved") : ERROR;
}

/* ---- Steps --------------------------------------------------------------------------------- */

Status take_step(Instance *instance, const char *function, Step *step)
{
    Standing *standing = &instance->standing;
    const double t = step->t, h = step->h;
    if (!(t + h > t && isfinite(t + h)))
        return report(instance, ERROR, function,
                      "communicationStepSize %.17g does not advance the time %.17g", h, t);
    if (t != standing->time)
        return report(instance, ERROR, function,
                      "currentCommunicationPoint is %.17g, but the slave stands at %.17g", t,
                      standing->time);
    if (t + h > standing->stop_time)
        return report(instance, ERROR, function,
                      "the step from %.17g to %.17g leads beyond the stop time %.17g", t, t + h,
                      standing->stop_time);

    step->tolerance = standing->tolerance;
    step->reached = t + h;
    const Outcome outcome = behaviour.step(instance->state, instance->hidden, step);
    if (outcome == STEP_REFUSED)
        return report(instance, ERROR, function, "step from %.17g to %.17g: %s", t, t + h,
                      step->reason);
    if (outcome == STEP_FAILED) {
        standing->mode = FAILED;
        return report(instance, ERROR, function, "step from %.17g to %.17g: %s", t, t + h,
                      step->reason);
    }
    standing->time = step->reached;
    return step->reason ? report(instance, WARNING, function, "%s", step->reason) : OK;
}
