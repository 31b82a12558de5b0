/* A drive with variables of every causality, for what is set and recorded besides the coupling.
 *
 *     y' = flow = gain mode u     y is an output, flow is local
 *     s' = y                      s is a local state
 *     total = n gain              a calculated parameter
 *     ratio = 1 / u               local; infinite where u is 0
 *     is_moving = flow != 0, label: the item of mode in words        both local
 *
 * `gain` and `mode` are tunable. Steps are exact for inputs that are held.
 */
#include "behaviour.h"

#include <stdio.h>
#include <string.h>

enum { U, GAIN, Y, FLOW, S, DER_S, TOTAL, RATIO, VALUES };     /* value references */
enum { MODE = 10, N = 11, IS_MOVING = 12, LABEL = 13 };

#ifndef MODE_TYPE /* of an enumeration */
#define MODE_TYPE INT32
#define MODE_C int32_t
#endif

typedef struct {
    double value[VALUES];
    MODE_C mode;
    int32_t n;
    bool is_moving;
    char label[TEXT_SIZE];
} State;

static void start(void *block)
{
    State *state = block;
    state->value[GAIN] = 1.0;
    state->mode = 1;
    state->n = 3;
}

static Variable find(void *block, Type type, uint32_t reference)
{
    State *state = block;
    if (type == FLOAT64 && reference < VALUES)
        return (Variable){&state->value[reference], 1,
                          reference == U || reference == GAIN  ? INPUT_VALUE
                          : reference == Y || reference == S ? START_VALUE
                                                             : READ_ONLY};
    if (type == MODE_TYPE && reference == MODE)
        return (Variable){&state->mode, 1, INPUT_VALUE};
    if (type == INT32 && reference == N)
        return (Variable){&state->n, 1, START_VALUE};
    if (type == BOOLEAN && reference == IS_MOVING)
        return (Variable){&state->is_moving, 1, READ_ONLY};
    if (type == STRING && reference == LABEL)
        return (Variable){state->label, 1, READ_ONLY};
    return (Variable){0};
}

static void calculate(void *block, double time)
{
    State *state = block;
    double *value = state->value;
    (void)time;
    value[FLOW] = value[GAIN] * (double)state->mode * value[U];
    value[DER_S] = value[Y];
    value[TOTAL] = state->n * value[GAIN];
    value[RATIO] = 1.0 / value[U];
    state->is_moving = value[FLOW] != 0.0;
    memset(state->label, 0, TEXT_SIZE);
    snprintf(state->label, TEXT_SIZE, "%s",
             state->mode < 0    ? "reverse"
             : state->mode == 0 ? "neutral"
             : state->mode == 1 ? "forward"
                                : "fast");
}

static Outcome take_step(void *block, void *hidden, Step *step)
{
    double *value = ((State *)block)->value;
    (void)hidden;
    calculate(block, step->t);
    value[S] += value[Y] * step->h + 0.5 * value[FLOW] * step->h * step->h;
    value[Y] += value[FLOW] * step->h;
    return STEP_TAKEN;
}

const Behaviour behaviour = {.state_size = sizeof(State),
                             .start = start,
                             .find = find,
                             .calculate = calculate,
                             .step = take_step};
