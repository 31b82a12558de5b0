/* A lag whose output derivatives are not what they should be; SLOPE says in which way. Beside y there
 * is the constant `c`. */
#include "lag.h"

#include <math.h>
#include <time.h>

enum {
    NAN_AT_FIRST,      /* NaN before the first step */
    NAN_ALWAYS,        /* NaN at any time */
    INFINITE_CONSTANT, /* that of c is infinite, as 0 / 0 may be */
    THOUSANDFOLD,      /* of the wrong unit */
    DIFFERENCE,        /* what y has changed in the last step, over its size */
    WITH_NOISE         /* others each time they are read */
};

enum { CONSTANT = LAG_REFERENCES };

typedef struct {
    Lag lag;
    double x_before, h; /* of the last step; h = 0: there was none */
    double c;
} State;

static void start(void *block)
{
    lag_start(block);
    ((State *)block)->c = 3.0;
}

static Variable find(void *block, Type type, uint32_t reference)
{
    State *state = block;
    if (type == FLOAT64 && reference == CONSTANT)
        return (Variable){&state->c, 1, READ_ONLY};
    return lag_find(block, type, reference);
}

static Outcome step(void *block, void *hidden, Step *step)
{
    State *state = block;
    state->x_before = state->lag.x;
    state->h = step->h;
    return lag_step(block, hidden, step);
}

static double noise(void)
{
    return 1e-6 * (double)(clock() % 1000);
}

static bool output_derivative(void *block, double time, uint32_t reference, int order,
                              double *value)
{
    const State *state = block;
    if (reference == CONSTANT && order == 1) {
        *value = SLOPE == INFINITE_CONSTANT ? INFINITY : 0.0;
        return true;
    }
    if (!lag_output_derivative(block, time, reference, order, value))
        return false;
    if (SLOPE == NAN_ALWAYS || (SLOPE == NAN_AT_FIRST && state->h == 0.0))
        *value = NAN;
    else if (SLOPE == THOUSANDFOLD)
        *value *= 1000.0;
    else if (SLOPE == DIFFERENCE)
        *value = (state->lag.x - state->x_before) / state->h; /* NaN before the first step */
    else if (SLOPE == WITH_NOISE)
        *value *= 1.0 + noise();
    return true;
}

const Behaviour behaviour = {.state_size = sizeof(State),
                             .start = start,
                             .find = find,
                             .initialized = lag_initialized,
                             .calculate = lag_calculate,
                             .input_derivative = lag_input_derivative,
                             .output_derivative = output_derivative,
                             .step = step};
