/* A lag in series with another one whose state no saved state holds: a restore sets it back to 0.
 * The same steps from a restored state repeat to the bit, and have nothing to do with those that
 * were not interrupted. */
#include "lag.h"

#include <math.h>

static Outcome step_both(void *state, void *hidden, Step *step)
{
    Lag *lag = state;
    double *z = hidden;
    const double decay = exp(-step->h / lag->T);
    lag_step(state, hidden, step);
    lag->x -= *z;
    *z += (1.0 - *z) * (1.0 - decay);
    lag->x += *z;
    return STEP_TAKEN;
}

static const char *restore(void *state, void *hidden, const void *saved)
{
    *(Lag *)state = *(const Lag *)saved;
    *(double *)hidden = 0.0;
    return NULL;
}

const Behaviour behaviour = {.state_size = sizeof(Lag),
                             .hidden_size = sizeof(double),
                             LAG_BEHAVIOUR,
                             .step = step_both,
                             .restore = restore};
