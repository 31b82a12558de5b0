/* Inputs and outputs of every type of FMI 3.0, by these rules:
 *
 *     float32_out      = 2 float32_in
 *     float64_out'     = float64_in - float64_out                 (exact, in s)
 *     int8_out ...     = int8_in + 1 ..., after the largest number the smallest
 *     boolean_out      = not boolean_in
 *     string_out       = "got <string_in>"
 *     binary_out       = the bytes of binary_in, last one first
 *     enumeration_out  = the item after enumeration_in; after the last of the 3 the first
 *     matrix_out       = 2 matrix_in                              2 rows, 3 columns
 *     vector_out       = vector_in + 1                            n elements
 *
 * n is a structural parameter, 0 to 16. The clock is declared and never ticks. A value reference is
 * the number of the type, 100 more for outputs.
 */
#include "behaviour.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

enum { OUT = 100, MATRIX = 50, VECTOR = 51, SIZE = 60, ROWS = 2, COLUMNS = 3, LONGEST = 16 };

#define INTEGERS(DO)                                                                               \
    DO(INT8, int8_t, int8)                                                                         \
    DO(UINT8, uint8_t, uint8)                                                                      \
    DO(INT16, int16_t, int16)                                                                      \
    DO(UINT16, uint16_t, uint16)                                                                   \
    DO(INT32, int32_t, int32)                                                                      \
    DO(UINT32, uint32_t, uint32)                                                                   \
    DO(INT64, int64_t, int64)                                                                      \
    DO(UINT64, uint64_t, uint64)

#define MEMBER(TYPE, C_TYPE, NAME) C_TYPE NAME;

typedef struct {
    double float64, matrix[ROWS * COLUMNS], vector[LONGEST];
    INTEGERS(MEMBER)
    int64_t enumeration;
    float float32;
    bool boolean;
    char string[TEXT_SIZE];
    Binary binary;
} Values;

typedef struct {
    Values in, out;
    uint64_t n;
    bool clock;
} State;

static void start(void *block)
{
    State *state = block;
    state->n = 3;
    state->in.enumeration = 1;
}

static Variable find_value(State *state, Values *values, Type type, uint32_t reference,
                           Access access)
{
    if (type == FLOAT64 && reference == MATRIX)
        return (Variable){values->matrix, ROWS * COLUMNS, access};
    if (type == FLOAT64 && reference == VECTOR)
        return (Variable){values->vector, (size_t)state->n, access};
    if (type == INT64 && reference == TYPES)
        return (Variable){&values->enumeration, 1, access};
    if (reference != (uint32_t)type)
        return (Variable){0};
#define CASE(TYPE, C_TYPE, NAME)                                                                   \
    case TYPE:                                                                                     \
        return (Variable){&values->NAME, 1, access};
    switch (type) {
        INTEGERS(CASE)
    case FLOAT32:
        return (Variable){&values->float32, 1, access};
    case FLOAT64:
        return (Variable){&values->float64, 1, access};
    case BOOLEAN:
        return (Variable){&values->boolean, 1, access};
    case STRING:
        return (Variable){values->string, 1, access};
    case BINARY:
        return (Variable){&values->binary, 1, access};
    default:
        return (Variable){0};
    }
}

static Variable find(void *block, Type type, uint32_t reference)
{
    State *state = block;
    if (type == UINT64 && reference == SIZE)
        return (Variable){&state->n, 1, STRUCTURAL};
    if (type == CLOCK && reference == OUT + CLOCK)
        return (Variable){&state->clock, 1, READ_ONLY};
    return reference < OUT
               ? find_value(state, &state->in, type, reference, INPUT_VALUE)
               : find_value(state, &state->out, type, reference - OUT, READ_ONLY);
}

static void calculate(void *block, double time)
{
    State *state = block;
    const Values *in = &state->in;
    Values *out = &state->out;
    (void)time;
    /* By way of unsigned numbers, for which passing the largest one is defined. */
#define SUCCESSOR(TYPE, C_TYPE, NAME) out->NAME = (C_TYPE)((uint64_t)in->NAME + 1u);
    INTEGERS(SUCCESSOR)
    out->float32 = 2.0f * in->float32;
    out->enumeration = in->enumeration % 3 + 1;
    out->boolean = !in->boolean;
    memset(out->string, 0, TEXT_SIZE);
    snprintf(out->string, TEXT_SIZE, "got %.*s", TEXT_SIZE - 5, in->string);
    memset(&out->binary, 0, sizeof out->binary);
    out->binary.size = in->binary.size;
    for (uint32_t i = 0; i < in->binary.size; ++i)
        out->binary.bytes[i] = in->binary.bytes[in->binary.size - 1 - i];
    for (int i = 0; i < ROWS * COLUMNS; ++i)
        out->matrix[i] = 2.0 * in->matrix[i];
    for (uint64_t i = 0; i < state->n; ++i)
        out->vector[i] = in->vector[i] + 1.0;
}

static const char *check(const void *block)
{
    return ((const State *)block)->n <= LONGEST ? NULL : "n is larger than 16";
}

static Outcome take_step(void *block, void *hidden, Step *step)
{
    State *state = block;
    (void)hidden;
    const double u = state->in.float64;
    state->out.float64 = u + (state->out.float64 - u) * exp(-step->h);
    return STEP_TAKEN;
}

const Behaviour behaviour = {.state_size = sizeof(State),
                             .start = start,
                             .find = find,
                             .check_structure = check,
                             .calculate = calculate,
                             .step = take_step};
