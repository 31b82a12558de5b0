/* A controller that takes one explicit Euler step in each communication step: T x' = K u - x with an
 * output within +-1, beyond which x is not led. With steps that are not small against T its output
 * is at a limit, or there at once, whatever the size of the step. */
#include "lag.h"

#include <math.h>

enum { GAIN = LAG_REFERENCES };

typedef struct {
    Lag lag;
    double gain; /* default 10 */
} State;

static void start(void *block)
{
    State *state = block;
    lag_start(block);
    state->lag.T = 2e-3;
    state->lag.x_start = 0.0;
    state->gain = 10.0;
}

static Variable find(void *block, Type type, uint32_t reference)
{
    State *state = block;
    if (type == FLOAT64 && reference == GAIN)
        return (Variable){&state->gain, 1, START_VALUE};
    return lag_find(block, type, reference);
}

static Outcome step(void *block, void *hidden, Step *step)
{
    State *state = block;
    Lag *lag = &state->lag;
    (void)hidden;
    lag->x += fmin(step->h / lag->T, 1.0) * (state->gain * lag->u - lag->x);
    lag->x = fmax(-1.0, fmin(1.0, lag->x));
    return STEP_TAKEN;
}

const Behaviour behaviour = {.state_size = sizeof(State),
                             .start = start,
                             .find = find,
                             .initialized = lag_initialized,
                             .calculate = lag_calculate,
                             .step = step};
