/* A lag with outputs that have nothing to do with the simulated time: the computing time, and how
 * many steps were taken since the instance was made, whatever was restored meanwhile. */
#include "lag.h"

#include <time.h>

enum { CPU_TIME = LAG_REFERENCES, STEPS, NUMBER };

typedef struct {
    Lag lag;
    double cpu_time, steps;
    int32_t number;
} State;

static Variable find(void *block, Type type, uint32_t reference)
{
    State *state = block;
    if (type == FLOAT64 && reference == CPU_TIME)
        return (Variable){&state->cpu_time, 1, READ_ONLY};
    if (type == FLOAT64 && reference == STEPS)
        return (Variable){&state->steps, 1, READ_ONLY};
    if (type == INT32 && reference == NUMBER)
        return (Variable){&state->number, 1, READ_ONLY};
    return lag_find(block, type, reference);
}

static void calculate(void *block, double time)
{
    State *state = block;
    lag_calculate(block, time);
    state->cpu_time = (double)clock() / CLOCKS_PER_SEC;
}

static Outcome step(void *block, void *hidden, Step *step)
{
    State *state = block;
    int32_t *taken = hidden;
    state->number = ++*taken;
    state->steps = state->number;
    return lag_step(block, hidden, step);
}

const Behaviour behaviour = {.state_size = sizeof(State),
                             .hidden_size = sizeof(int32_t),
                             .start = lag_start,
                             .find = find,
                             .initialized = lag_initialized,
                             .calculate = calculate,
                             .input_derivative = lag_input_derivative,
                             .output_derivative = lag_output_derivative,
                             .step = step};
