/* A lag that moves by its own clock, whatever the communication steps are: at every multiple of
 * 10 ms that lies within a step, its end included, x takes an explicit Euler step of 10 ms with the
 * input of the communication step. In between it stays. */
#include "lag.h"

#include <math.h>

static const double PERIOD = 0.01; /* s */

static Outcome tick(void *state, void *hidden, Step *step)
{
    Lag *lag = state;
    (void)hidden;
    const double rounding = 1e-9; /* of a period: a step to a tick on paper reaches it */
    const double last = floor(step->reached / PERIOD + rounding);
    for (double i = floor(step->t / PERIOD + rounding); i < last; i += 1.0)
        lag->x += PERIOD * (lag->u - lag->x) / lag->T;
    return STEP_TAKEN;
}

const Behaviour behaviour = {.state_size = sizeof(Lag), LAG_BEHAVIOUR, .step = tick};
