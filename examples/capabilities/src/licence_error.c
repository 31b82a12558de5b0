/* A lag that there is only an instance of where the environment names a licence file. */
#include "lag.h"

#include <stdlib.h>

static const char *look_for_licence(void *hidden, const char *resources)
{
    (void)hidden;
    (void)resources;
    return getenv("LICENCE_FILE") ? NULL : "licence not found: LICENCE_FILE is not set";
}

const Behaviour behaviour = {
    .state_size = sizeof(Lag), LAG_BEHAVIOUR, .step = lag_step, .open = look_for_licence};
