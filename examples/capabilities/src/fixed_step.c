/* A lag with a solver of fixed step size, 10 ms. With ANY_MULTIPLE the communication step can be a
 * multiple of it, but the same one in every step; without, it must be 10 ms. Rounding of the times
 * is forgiven. */
#include "lag.h"

#include <math.h>

static const double FIXED_STEP_SIZE = 0.01; /* s */

typedef struct {
    Lag lag;
    double multiple; /* of all steps, 0 before the first one */
} State;

static Outcome fixed_step(void *block, void *hidden, Step *step)
{
    State *state = block;
    const double multiple = fmax(1.0, round(step->h / FIXED_STEP_SIZE));
    const double expected = multiple * FIXED_STEP_SIZE;
    const double largest = fmax(fabs(step->t), expected);
    if (fabs(step->h - expected) > 4.0 * (nextafter(largest, INFINITY) - largest)) {
        step->reason = "the communication step size is not a multiple of 0.01";
        return STEP_REFUSED;
    }
#ifdef ANY_MULTIPLE
    const double required = state->multiple;
#else
    const double required = 1.0;
#endif
    if (required > 0.0 && multiple != required) {
        step->reason = "the communication step size is not the fixed one";
        return STEP_REFUSED;
    }
    state->multiple = multiple;
    return lag_step(block, hidden, step);
}

const Behaviour behaviour = {.state_size = sizeof(State), LAG_BEHAVIOUR, .step = fixed_step};
