/* A two-step method (Adams-Bashforth) whose memory of the step before is not part of the saved
 * state. After a restored state it starts anew with a one-step method (Heun), so that it repeats
 * itself bit for bit, but not the run that was never interrupted: that differs in late digits.
 *
 * It takes internal steps of at most 0.1 ms, equal ones within a communication step.
 */
#include "lag.h"

#include <math.h>

static const double INTERNAL_STEP_SIZE = 1e-4; /* s */

typedef struct {
    bool is_known;
    double h, slope; /* of the internal step before */
} Memory;

static double slope_of(const Lag *lag, double tau, double x)
{
    return (lag->u + lag->du * tau - x) / lag->T;
}

static Outcome step_by_step(void *state, void *hidden, Step *step)
{
    Lag *lag = state;
    Memory *memory = hidden;
    const double total = step->reached - step->t;
    const double count = fmax(1.0, ceil(total / INTERNAL_STEP_SIZE * (1.0 - 1e-9)));
    const double h = total / count;
    for (double i = 0.0; i < count; i += 1.0) {
        const double slope = slope_of(lag, i * h, lag->x);
        if (memory->is_known) {
            const double ratio = 0.5 * h / memory->h;
            lag->x += h * ((1.0 + ratio) * slope - ratio * memory->slope);
        } else {
            const double next = slope_of(lag, (i + 1.0) * h, lag->x + h * slope);
            lag->x += 0.5 * h * (slope + next);
        }
        *memory = (Memory){true, h, slope};
    }
    lag->u += lag->du * total;
    return STEP_TAKEN;
}

static const char *restore(void *state, void *hidden, const void *saved)
{
    *(Lag *)state = *(const Lag *)saved;
    ((Memory *)hidden)->is_known = false;
    return NULL;
}

const Behaviour behaviour = {.state_size = sizeof(Lag),
                             .hidden_size = sizeof(Memory),
                             LAG_BEHAVIOUR,
                             .step = step_by_step,
                             .restore = restore};
