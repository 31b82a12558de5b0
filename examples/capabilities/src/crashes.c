/* The step that leads over t = 0.25 s writes to address 0: the process that holds it dies. */
#include "lag.h"

static Outcome crashing_step(void *state, void *hidden, Step *step)
{
    if (step->t + step->h > 0.25) {
        volatile int *volatile nowhere = NULL;
        *nowhere = 1;
    }
    return lag_step(state, hidden, step);
}

const Behaviour behaviour = {.state_size = sizeof(Lag), LAG_BEHAVIOUR, .step = crashing_step};
