/* A lag whose functions meet with an accident: ACCIDENT="fmi2Terminate hang" in the environment.
 *
 * An accident is "error", "crash", "hang", or a number: so many seconds the function takes longer.
 */
#define _POSIX_C_SOURCE 199309L
#include "lag.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

static void wait_for(double seconds)
{
    const double whole = (double)(time_t)seconds;
    const struct timespec span = {(time_t)whole, (long)((seconds - whole) * 1e9)};
    nanosleep(&span, NULL);
}

static const char *meet_with_accident(const char *function)
{
    const char *accident = getenv("ACCIDENT");
    char where[64], what[16];
    if (!accident || sscanf(accident, "%63s %15s", where, what) != 2 || strcmp(where, function))
        return NULL;
    if (strcmp(what, "error") == 0)
        return "an accident";
    if (strcmp(what, "crash") == 0)
        *(volatile int *)NULL = 0;
    while (strcmp(what, "hang") == 0)
        wait_for(1.0);
    wait_for(strtod(what, NULL));
    return NULL;
}

static const char *open_lag(void *hidden, const char *resources)
{
    (void)hidden;
    (void)resources;
    return meet_with_accident("fmi2Instantiate");
}

static void close_lag(void *hidden)
{
    (void)hidden;
    meet_with_accident("fmi2FreeInstance");
}

const Behaviour behaviour = {.state_size = sizeof(Lag),
                             LAG_BEHAVIOUR,
                             .step = lag_step,
                             .open = open_lag,
                             .close = close_lag,
                             .enter = meet_with_accident};
