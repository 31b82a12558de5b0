/* Inputs and outputs of every type of FMI 2.0; an output has the value reference of its input
 * plus 100.
 *
 *     real_continuous_out'  = real_continuous_in - real_continuous_out   (exact, in s)
 *     real_discrete_out     = 2 real_discrete_in
 *     integer_out           = integer_in + 1
 *     boolean_out           = not boolean_in
 *     string_out            = "got <string_in>"
 *     enumeration_out       = the item after enumeration_in; after the last of the 3 the first
 *     counter_out           = number of multiples of 0.25 s in (0, t]
 *     toggle_out            = counter_out is odd
 */
#include "behaviour.h"

#include <limits.h>
#include <math.h>
#include <stdio.h>
#include <string.h>

enum {
    REAL_CONTINUOUS = 0,
    REAL_DISCRETE = 1,
    INTEGER = 2,
    BOOLEAN_ = 3,
    STRING_ = 4,
    ENUMERATION = 5,
    OUT = 100, /* offset of the outputs */
    COUNTER = 106,
    TOGGLE = 107
};

typedef struct {
    double real_in[2], real_out[2];
    int32_t integer_in, integer_out, enumeration_in, enumeration_out, counter;
    bool boolean_in, boolean_out, toggle;
    char string_in[TEXT_SIZE], string_out[TEXT_SIZE];
} State;

static void start(void *block)
{
    State *state = block;
    state->enumeration_in = 1;
}

static Variable find_input(State *state, Type type, uint32_t reference)
{
    if (type == FLOAT64 && reference <= REAL_DISCRETE)
        return (Variable){&state->real_in[reference], 1, INPUT_VALUE};
    if (type == INT32 && reference == INTEGER)
        return (Variable){&state->integer_in, 1, INPUT_VALUE};
    if (type == INT32 && reference == ENUMERATION)
        return (Variable){&state->enumeration_in, 1, INPUT_VALUE};
    if (type == BOOLEAN && reference == BOOLEAN_)
        return (Variable){&state->boolean_in, 1, INPUT_VALUE};
    if (type == STRING && reference == STRING_)
        return (Variable){state->string_in, 1, INPUT_VALUE};
    return (Variable){0};
}

static Variable find(void *block, Type type, uint32_t reference)
{
    State *state = block;
    if (reference < OUT)
        return find_input(state, type, reference);
    if (type == FLOAT64 && reference <= OUT + REAL_DISCRETE)
        return (Variable){&state->real_out[reference - OUT], 1, READ_ONLY};
    if (type == INT32 && reference == OUT + INTEGER)
        return (Variable){&state->integer_out, 1, READ_ONLY};
    if (type == INT32 && reference == OUT + ENUMERATION)
        return (Variable){&state->enumeration_out, 1, READ_ONLY};
    if (type == INT32 && reference == COUNTER)
        return (Variable){&state->counter, 1, READ_ONLY};
    if (type == BOOLEAN && reference == OUT + BOOLEAN_)
        return (Variable){&state->boolean_out, 1, READ_ONLY};
    if (type == BOOLEAN && reference == TOGGLE)
        return (Variable){&state->toggle, 1, READ_ONLY};
    if (type == STRING && reference == OUT + STRING_)
        return (Variable){state->string_out, 1, READ_ONLY};
    return (Variable){0};
}

static void calculate(void *block, double time)
{
    State *state = block;
    state->real_out[REAL_DISCRETE] = 2.0 * state->real_in[REAL_DISCRETE];
    state->integer_out = state->integer_in < INT32_MAX ? state->integer_in + 1 : INT32_MIN;
    state->enumeration_out = state->enumeration_in % 3 + 1;
    state->boolean_out = !state->boolean_in;
    memset(state->string_out, 0, TEXT_SIZE);
    snprintf(state->string_out, TEXT_SIZE, "got %.*s", TEXT_SIZE - 5, state->string_in);
    state->counter = (int32_t)floor(time / 0.25 + 1e-9);
    state->toggle = state->counter % 2 != 0;
}

static Outcome take_step(void *block, void *hidden, Step *step)
{
    State *state = block;
    (void)hidden;
    const double u = state->real_in[REAL_CONTINUOUS];
    double *x = &state->real_out[REAL_CONTINUOUS];
    *x = u + (*x - u) * exp(-step->h);
    return STEP_TAKEN;
}

const Behaviour behaviour = {.state_size = sizeof(State),
                             .start = start,
                             .find = find,
                             .calculate = calculate,
                             .step = take_step};
