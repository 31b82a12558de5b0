/* A lag that is not sure of itself from t = 0.5 s on: each step from there on is taken with a
 * warning. */
#include "lag.h"

static Outcome step_with_warning(void *state, void *hidden, Step *step)
{
    if (step->t >= 0.5)
        step->reason = "its table ends at 0.5 s";
    return lag_step(state, hidden, step);
}

const Behaviour behaviour = {.state_size = sizeof(Lag), LAG_BEHAVIOUR, .step = step_with_warning};
