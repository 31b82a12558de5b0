/* A lag that wants the simulation to end at t = 0.5 s: a step that reaches it says so. In FMI 2.0
 * such a step is discarded and ends there; in FMI 3.0 it is taken to its end. */
#include "lag.h"

#include <math.h>

static Outcome step_to_the_end(void *state, void *hidden, Step *step)
{
    const double end = 0.5; /* s */
    step->terminate = step->reached >= end;
#ifdef SHORTENS
    step->reached = fmin(step->reached, fmax(step->t, end));
#endif
    return lag_step(state, hidden, step);
}

const Behaviour behaviour = {.state_size = sizeof(Lag), LAG_BEHAVIOUR, .step = step_to_the_end};
