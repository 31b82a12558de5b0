/* The step that leads over t = 0.25 s never ends. */
#include "lag.h"

static Outcome endless_step(void *state, void *hidden, Step *step)
{
    const volatile bool is_endless = step->t + step->h > 0.25;
    while (is_endless) {
    }
    return lag_step(state, hidden, step);
}

const Behaviour behaviour = {.state_size = sizeof(Lag), LAG_BEHAVIOUR, .step = endless_step};
