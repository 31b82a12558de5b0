/* VARIABLES lags side by side, y[i]' = u[i] - y[i], in s, each input along a line. */
#include "behaviour.h"

#include <math.h>
#include <string.h>

enum { FIRST_OUTPUT = 10000 }; /* value references: inputs from 0 on, outputs from here on */

typedef struct {
    double u[VARIABLES], du[VARIABLES], y[VARIABLES];
} State;

static void start(void *block)
{
    (void)block;
}

static Variable find(void *block, Type type, uint32_t reference)
{
    State *state = block;
    if (type == FLOAT64 && reference < VARIABLES)
        return (Variable){&state->u[reference], 1, INPUT_VALUE};
    if (type == FLOAT64 && reference >= FIRST_OUTPUT && reference < FIRST_OUTPUT + VARIABLES)
        return (Variable){&state->y[reference - FIRST_OUTPUT], 1, START_VALUE};
    return (Variable){0};
}

static size_t side_by_side(Type type, uint32_t reference)
{
    if (type == FLOAT64 && reference < VARIABLES)
        return VARIABLES - reference;
    if (type == FLOAT64 && reference >= FIRST_OUTPUT && reference < FIRST_OUTPUT + VARIABLES)
        return FIRST_OUTPUT + VARIABLES - reference;
    return 1;
}

static double *input_derivative(void *block, uint32_t reference, int order)
{
    State *state = block;
    return reference < VARIABLES && order == 1 ? &state->du[reference] : NULL;
}

static bool output_derivative(void *block, double time, uint32_t reference, int order,
                              double *value)
{
    const State *state = block;
    (void)time;
    if (reference < FIRST_OUTPUT || reference >= FIRST_OUTPUT + VARIABLES || order != 1)
        return false;
    *value = state->u[reference - FIRST_OUTPUT] - state->y[reference - FIRST_OUTPUT];
    return true;
}

static Outcome step_all(void *block, void *hidden, Step *step)
{
    State *state = block;
    (void)hidden;
    const double h = step->h, decay = exp(-h);
    for (int i = 0; i < VARIABLES; ++i) {
        const double u = state->u[i], slope = state->du[i];
        state->y[i] = u + slope * (h - 1.0) + (state->y[i] - u + slope) * decay;
        state->u[i] += slope * h;
    }
    return STEP_TAKEN;
}

const Behaviour behaviour = {.state_size = sizeof(State),
                             .start = start,
                             .find = find,
                             .side_by_side = side_by_side,
                             .input_derivative = input_derivative,
                             .output_derivative = output_derivative,
                             .step = step_all};
