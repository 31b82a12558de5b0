/* A lag whose input is a parabola within a step, u + du tau + ddu tau^2 / 2, with the exact solution.
 * USED_ORDER says up to which order the derivatives are made use of; higher ones that the FMU takes
 * are forgotten, as some tools do. */
#include "lag.h"

#include <math.h>

typedef struct {
    Lag lag;
    double ddu; /* 1/s^2 */
    double forgotten;
} State;

static double *input_derivative(void *block, uint32_t reference, int order)
{
    State *state = block;
    if (reference != LAG_U || order < 1 || order > MAX_INPUT_DERIVATIVE_ORDER)
        return NULL;
    if (order > USED_ORDER)
        return &state->forgotten;
    return order == 1 ? &state->lag.du : &state->ddu;
}

static Outcome step(void *block, void *hidden, Step *step)
{
    State *state = block;
    Lag *lag = &state->lag;
    const double h = step->reached - step->t, T = lag->T;
    const double c = 0.5 * state->ddu, b = lag->du - 2.0 * c * T, a = lag->u - T * b;
    (void)hidden;
    lag->x = a + h * (b + h * c) + (lag->x - a) * exp(-h / T);
    lag->u += h * (lag->du + h * c);
    lag->du += h * state->ddu;
    return STEP_TAKEN;
}

const Behaviour behaviour = {.state_size = sizeof(State),
                             .start = lag_start,
                             .find = lag_find,
                             .initialized = lag_initialized,
                             .calculate = lag_calculate,
                             .input_derivative = input_derivative,
                             .output_derivative = lag_output_derivative,
                             .step = step};
