/* A lag that cannot be loaded: its binary needs a shared library that nobody has. */
#include "lag.h"

int doublestep_absent(void);

static const char *open_library(void *hidden, const char *resources)
{
    (void)hidden;
    (void)resources;
    return doublestep_absent() == 0 ? NULL : "the library is of no use";
}

const Behaviour behaviour = {
    .state_size = sizeof(Lag), LAG_BEHAVIOUR, .step = lag_step, .open = open_library};
