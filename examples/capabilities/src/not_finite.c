/* Beyond t = 0.25 s its output is infinite, and no status says so. */
#include "lag.h"

#include <math.h>

static Outcome overflowing_step(void *state, void *hidden, Step *step)
{
    const Outcome outcome = lag_step(state, hidden, step);
    if (step->reached > 0.25)
        ((Lag *)state)->x = INFINITY;
    return outcome;
}

const Behaviour behaviour = {.state_size = sizeof(Lag), LAG_BEHAVIOUR, .step = overflowing_step};
