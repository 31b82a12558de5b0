/* 131 072 lags (1 MiB of state) of one input, with time constants from T to 2 T. The output is the
 * mean of the first, the middle and the last of them. */
#include "lag.h"

#include <math.h>

enum { CELLS = 131072 };

typedef struct {
    Lag lag; /* its x is not used */
    double x[CELLS];
} State;

static double mean(const State *state)
{
    return (state->x[0] + state->x[CELLS / 2] + state->x[CELLS - 1]) / 3.0;
}

static double time_constant(const State *state, int i)
{
    return state->lag.T * (1.0 + i / (CELLS - 1.0));
}

static void initialized(void *block, double time)
{
    State *state = block;
    lag_initialized(block, time);
    for (int i = 0; i < CELLS; ++i)
        state->x[i] = state->lag.x_start;
}

static void calculate(void *block, double time)
{
    State *state = block;
    lag_calculate(block, time);
    if (state->lag.initialized != 0.0)
        state->lag.y = mean(state);
}

static bool output_derivative(void *block, double time, uint32_t reference, int order,
                              double *value)
{
    const State *state = block;
    const int cells[] = {0, CELLS / 2, CELLS - 1};
    (void)time;
    *value = 0.0;
    for (int i = 0; i < 3; ++i)
        *value += (state->lag.u - state->x[cells[i]]) / time_constant(state, cells[i]) / 3.0;
    return reference == LAG_Y && order == 1;
}

static Outcome step_all(void *block, void *hidden, Step *step)
{
    State *state = block;
    (void)hidden;
    const double h = step->reached - step->t, u = state->lag.u, slope = state->lag.du;
    for (int i = 0; i < CELLS; ++i) {
        const double T = time_constant(state, i);
        state->x[i] = u + slope * (h - T) + (state->x[i] - u + slope * T) * exp(-h / T);
    }
    state->lag.u += slope * h;
    return STEP_TAKEN;
}

const Behaviour behaviour = {.state_size = sizeof(State),
                             .start = lag_start,
                             .find = lag_find,
                             .initialized = initialized,
                             .calculate = calculate,
                             .input_derivative = lag_input_derivative,
                             .output_derivative = output_derivative,
                             .step = step_all};
