/* Direct feed-through and nothing else:
 *
 *     y = a u + b + c sin(u)
 *
 * Two of them that feed each other are an algebraic loop, linear with c = 0 as by default. */
#include "behaviour.h"

#include <math.h>

enum { U, Y, A, B, C, VALUES }; /* value references */

typedef struct {
    double value[VALUES];
    double du;
} State;

static void start(void *block)
{
    State *state = block;
    state->value[A] = START_A;
    state->value[B] = START_B;
}

static Variable find(void *block, Type type, uint32_t reference)
{
    State *state = block;
    if (type != FLOAT64 || reference >= VALUES)
        return (Variable){0};
    return (Variable){&state->value[reference], 1,
                      reference == U   ? INPUT_VALUE
                      : reference == Y ? READ_ONLY
                                       : START_VALUE};
}

static void calculate(void *block, double time)
{
    State *state = block;
    double *v = state->value;
    (void)time;
    v[Y] = v[A] * v[U] + v[B] + v[C] * sin(v[U]);
}

static double *input_derivative(void *block, uint32_t reference, int order)
{
    State *state = block;
    return reference == U && order == 1 ? &state->du : NULL;
}

static bool output_derivative(void *block, double time, uint32_t reference, int order,
                              double *value)
{
    const State *state = block;
    (void)time;
    *value = (state->value[A] + state->value[C] * cos(state->value[U])) * state->du;
    return reference == Y && order == 1;
}

static Outcome step_on(void *block, void *hidden, Step *step)
{
    State *state = block;
    (void)hidden;
    state->value[U] += state->du * step->h;
    return STEP_TAKEN;
}

const Behaviour behaviour = {.state_size = sizeof(State),
                             .start = start,
                             .find = find,
                             .calculate = calculate,
                             .input_derivative = input_derivative,
                             .output_derivative = output_derivative,
                             .step = step_on};
