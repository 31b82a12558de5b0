/* Adds a little noise to each step, drawn by a counter that no saved state brings back: after a
 * restored state the same step ends elsewhere, by up to a millionth. */
#include "lag.h"

static Outcome noisy_step(void *state, void *hidden, Step *step)
{
    Lag *lag = state;
    uint32_t *counter = hidden;
    lag_step(state, hidden, step);
    *counter = *counter * 1664525u + 1013904223u; /* Numerical Recipes, section 7.1 */
    lag->x += 1e-6 * (*counter / 4294967296.0 - 0.5);
    return STEP_TAKEN;
}

static const char *restore(void *state, void *hidden, const void *saved)
{
    (void)hidden; /* the counter goes on */
    *(Lag *)state = *(const Lag *)saved;
    return NULL;
}

const Behaviour behaviour = {.state_size = sizeof(Lag),
                             .hidden_size = sizeof(uint32_t),
                             LAG_BEHAVIOUR,
                             .step = noisy_step,
                             .restore = restore};
