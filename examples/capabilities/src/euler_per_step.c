/* A lag whose communication step is one step of the explicit Euler method, however long it is. */
#include "lag.h"

static Outcome euler_step(void *state, void *hidden, Step *step)
{
    Lag *lag = state;
    (void)hidden;
    lag->x += step->h * (lag->u - lag->x) / lag->T;
    return STEP_TAKEN;
}

const Behaviour behaviour = {.state_size = sizeof(Lag), LAG_BEHAVIOUR, .step = euler_step};
