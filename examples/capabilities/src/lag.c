#include "lag.h"

#include <math.h>

void lag_start(void *state)
{
    Lag *lag = state;
    lag->T = 0.5;
    lag->x_start = 1.0;
}

Variable lag_find(void *state, Type type, uint32_t reference)
{
    Lag *lag = state;
    if (type != FLOAT64)
        return (Variable){0};
    switch (reference) {
    case LAG_U:
        return (Variable){&lag->u, 1, INPUT_VALUE};
    case LAG_Y:
        return (Variable){&lag->y, 1, READ_ONLY};
    case LAG_T:
        return (Variable){&lag->T, 1, START_VALUE};
    case LAG_X_START:
        return (Variable){&lag->x_start, 1, START_VALUE};
    default:
        return (Variable){0};
    }
}

void lag_initialized(void *state, double time)
{
    Lag *lag = state;
    (void)time;
    if (lag->initialized == 0.0) /* else a reset has kept x */
        lag->x = lag->x_start;
    lag->initialized = 1.0;
}

void lag_calculate(void *state, double time)
{
    Lag *lag = state;
    (void)time;
    lag->y = lag->initialized != 0.0 ? lag->x : lag->x_start;
}

double *lag_input_derivative(void *state, uint32_t reference, int order)
{
    Lag *lag = state;
    return reference == LAG_U && order == 1 ? &lag->du : NULL;
}

bool lag_output_derivative(void *state, double time, uint32_t reference, int order, double *value)
{
    const Lag *lag = state;
    (void)time;
    *value = (lag->u - lag->x) / lag->T;
    return reference == LAG_Y && order == 1;
}

void lag_advance(Lag *lag, double h)
{
    const double slope = lag->du;
    lag->x = lag->u + slope * (h - lag->T) + (lag->x - lag->u + slope * lag->T) * exp(-h / lag->T);
    lag->u += slope * h;
}

Outcome lag_step(void *state, void *hidden, Step *step)
{
    (void)hidden;
    lag_advance(state, step->reached - step->t);
    return STEP_TAKEN;
}
