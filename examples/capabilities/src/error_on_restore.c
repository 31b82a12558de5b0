/* Saves its state, but cannot restore it and says so. */
#include "lag.h"

static const char *restore(void *state, void *hidden, const void *saved)
{
    (void)state;
    (void)hidden;
    (void)saved;
    return "the solver cannot be set back";
}

const Behaviour behaviour = {
    .state_size = sizeof(Lag), LAG_BEHAVIOUR, .step = lag_step, .restore = restore};
