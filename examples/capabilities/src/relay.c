/* A relay with hysteresis: on below `low`, off above `high`, and at the limits themselves what it
 * was. The event indicators are u - low and u - high. There are no continuous states. */
#include "behaviour.h"

enum { U, LOW, HIGH, Z_LOW, Z_HIGH, VALUES, IS_ON = VALUES, CHANGES }; /* value references */

typedef struct {
    double value[VALUES];
    bool is_on;
    int32_t changes;
} State;

static void start(void *block)
{
    State *state = block;
    state->value[U] = 293.15;
    state->value[LOW] = 292.15;
    state->value[HIGH] = 294.15;
}

static Variable find(void *block, Type type, uint32_t reference)
{
    State *state = block;
    if (type == BOOLEAN && reference == IS_ON)
        return (Variable){&state->is_on, 1, READ_ONLY};
    if (type == INT32 && reference == CHANGES)
        return (Variable){&state->changes, 1, READ_ONLY};
    if (type != FLOAT64 || reference >= VALUES)
        return (Variable){0};
    const Access access = reference == U                          ? INPUT_VALUE
                          : reference == LOW || reference == HIGH ? START_VALUE
                                                                  : READ_ONLY;
    return (Variable){&state->value[reference], 1, access};
}

static void calculate(void *block, double time)
{
    double *value = ((State *)block)->value;
    (void)time;
    value[Z_LOW] = value[U] - value[LOW];
    value[Z_HIGH] = value[U] - value[HIGH];
}

static void indicators(void *block, double time, double z[])
{
    calculate(block, time);
    z[0] = ((State *)block)->value[Z_LOW];
    z[1] = ((State *)block)->value[Z_HIGH];
}

static bool update(void *block, double time, double *next)
{
    State *state = block;
    const double *value = state->value;
    const bool was_on = state->is_on;
    (void)time;
    (void)next; /* no time events */
    state->is_on = was_on ? value[U] <= value[HIGH] : value[U] < value[LOW];
    state->changes += state->is_on != was_on;
    return false;
}

const Behaviour behaviour = {.state_size = sizeof(State),
                             .start = start,
                             .find = find,
                             .calculate = calculate,
                             .event_indicators = 2,
                             .indicators = indicators,
                             .update = update};
