/* A ball that falls, h' = v, v' = -g, and bounces where h = 0: v jumps to -e v. What jumps with less
 * than 0.1 m/s stays on the ground. The event indicator is h, and 1 on the ground. */
#include "behaviour.h"

#include <float.h>

enum { H, V, DER_H, DER_V, G, E, INDICATOR, VALUES, BOUNCES = VALUES }; /* value references */

static const double LEAST_SPEED = 0.1; /* m/s */

typedef struct {
    double value[VALUES];
    int32_t bounces;
    int32_t is_at_rest;
} State;

static void start(void *block)
{
    State *state = block;
    state->value[H] = 1.0;
    state->value[G] = 9.81;
    state->value[E] = 0.7;
}

static Variable find(void *block, Type type, uint32_t reference)
{
    State *state = block;
    if (type == INT32 && reference == BOUNCES)
        return (Variable){&state->bounces, 1, READ_ONLY};
    if (type != FLOAT64 || reference >= VALUES)
        return (Variable){0};
    const bool is_calculated = reference == DER_H || reference == DER_V || reference == INDICATOR;
    return (Variable){&state->value[reference], 1, is_calculated ? READ_ONLY : START_VALUE};
}

static void calculate(void *block, double time)
{
    State *state = block;
    double *value = state->value;
    (void)time;
    value[DER_H] = state->is_at_rest ? 0.0 : value[V];
    value[DER_V] = state->is_at_rest ? 0.0 : -value[G];
    value[INDICATOR] = state->is_at_rest ? 1.0 : value[H];
}

static double *continuous_state(void *block)
{
    return &((State *)block)->value[H];
}

static void derivatives(void *block, double time, double dx[])
{
    calculate(block, time);
    dx[0] = ((State *)block)->value[DER_H];
    dx[1] = ((State *)block)->value[DER_V];
}

static void indicators(void *block, double time, double z[])
{
    calculate(block, time);
    z[0] = ((State *)block)->value[INDICATOR];
}

static bool update(void *block, double time, double *next)
{
    State *state = block;
    double *value = state->value;
    (void)time;
    (void)next; /* no time events */
    if (state->is_at_rest || value[H] > 0.0 || value[V] >= 0.0)
        return false;
    value[H] = DBL_MIN; /* above the ground, so that going up is no crossing */
    value[V] *= -value[E];
    state->bounces += 1;
    if (value[V] < LEAST_SPEED) {
        value[H] = 0.0;
        value[V] = 0.0;
        state->is_at_rest = 1;
    }
    return true;
}

static const double NOMINALS[] = {1.0, 1.0};

const Behaviour behaviour = {.state_size = sizeof(State),
                             .start = start,
                             .find = find,
                             .calculate = calculate,
                             .continuous_states = 2,
                             .event_indicators = 1,
                             .continuous_state = continuous_state,
                             .nominals = NOMINALS,
                             .derivatives = derivatives,
                             .indicators = indicators,
                             .update = update};
