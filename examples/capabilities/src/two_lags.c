/* Two lags side by side, the second one at rest at SECOND_START; the value references of the second one come after those of the first. */
#include "lag.h"

typedef struct {
    Lag lag[2];
} State;

static void start(void *block)
{
    State *state = block;
    lag_start(&state->lag[0]);
    lag_start(&state->lag[1]);
    state->lag[1].u = state->lag[1].x_start = SECOND_START;
}

/* The lag to which a value reference belongs, in a state that has it. */
static Lag *lag_of(State *state, uint32_t reference)
{
    return &state->lag[reference < LAG_REFERENCES ? 0 : 1];
}

static uint32_t own_reference(uint32_t reference)
{
    return reference < LAG_REFERENCES ? reference : reference - LAG_REFERENCES;
}

static Variable find(void *block, Type type, uint32_t reference)
{
    return lag_find(lag_of(block, reference), type, own_reference(reference));
}

static void initialized(void *block, double time)
{
    State *state = block;
    lag_initialized(&state->lag[0], time);
    lag_initialized(&state->lag[1], time);
}

static void calculate(void *block, double time)
{
    State *state = block;
    lag_calculate(&state->lag[0], time);
    lag_calculate(&state->lag[1], time);
}

static double *input_derivative(void *block, uint32_t reference, int order)
{
    return lag_input_derivative(lag_of(block, reference), own_reference(reference), order);
}

static bool output_derivative(void *block, double time, uint32_t reference, int order,
                              double *value)
{
    return lag_output_derivative(lag_of(block, reference), time, own_reference(reference), order,
                                 value);
}

static Outcome step_both(void *block, void *hidden, Step *step)
{
    State *state = block;
    lag_step(&state->lag[0], hidden, step);
    return lag_step(&state->lag[1], hidden, step);
}

const Behaviour behaviour = {.state_size = sizeof(State),
                             .start = start,
                             .find = find,
                             .initialized = initialized,
                             .calculate = calculate,
                             .input_derivative = input_derivative,
                             .output_derivative = output_derivative,
                             .step = step_both};
