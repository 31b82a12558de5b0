/* A staircase and a lag that follows it: the level (Int32, discrete) rises by 1 at every multiple
 * of 0.35 s, and x' = (level - x) / T with the exact solution. With event mode a step ends at the
 * next of these times; without, it passes over them and the level rises on the way. With
 * ROUNDS_EVENTS a step that ends some roundings before an event returns early at the event. With
 * LOSES_INDICATORS saved states lack the sign of the event indicator: after a restore from an event
 * the first step returns early after an internal step of 1 ms, for nothing.
 */
#include "lag.h"

#include <math.h>

enum { LEVEL = LAG_REFERENCES };

static const double INTERVAL = 0.35; /* s */

typedef struct {
    Lag lag;
    int32_t level;
    int32_t event_is_due; /* the last step ended at an event */
} State;

static Variable find(void *block, Type type, uint32_t reference)
{
    State *state = block;
    if (type == INT32 && reference == LEVEL)
        return (Variable){&state->level, 1, READ_ONLY};
    return reference == LAG_U ? (Variable){0} : lag_find(block, type, reference);
}

static double next_event(const State *state)
{
    return INTERVAL * (state->level + 1);
}

static void rise(State *state)
{
    state->level += 1;
    state->lag.u = state->level;
    state->event_is_due = 0;
}

static Outcome step_up(void *block, void *hidden, Step *step)
{
    State *state = block;
    (void)hidden;
    if (state->event_is_due) {
        step->reason = "the event at this time is to be handled in event mode first";
        return STEP_REFUSED;
    }
    double now = step->t;
#ifdef LOSES_INDICATORS
    int32_t *passed = hidden; /* the level whose end the last step has reached, and 1 */
    const bool seems_to_change = *passed == state->level + 1;
    *passed = 0;
    if (seems_to_change && step->stop_at_events && now + 1e-3 < step->reached) {
        lag_advance(&state->lag, 1e-3);
        step->event = true;
        step->reached = now + 1e-3;
        return STEP_TAKEN;
    }
#endif
#ifdef ROUNDS_EVENTS
    if (fabs(next_event(state) - step->reached) < 1e-14 * step->reached)
        step->reached = next_event(state);
#endif
    while (next_event(state) <= step->reached) {
        const double event = fmax(now, next_event(state));
        lag_advance(&state->lag, event - now);
        now = event;
        if (step->stop_at_events) {
            state->event_is_due = 1;
            step->event = true;
#ifdef LOSES_INDICATORS
            *passed = state->level + 1;
#endif
            step->reached = event;
            return STEP_TAKEN;
        }
        rise(state);
    }
    lag_advance(&state->lag, step->reached - now);
    return STEP_TAKEN;
}

static bool update(void *block, double time, double *next)
{
    State *state = block;
    if (next_event(state) <= time)
        rise(state);
    *next = next_event(state);
    return false; /* x does not jump */
}

const Behaviour behaviour = {.state_size = sizeof(State),
                             .hidden_size = sizeof(int32_t),
                             .start = lag_start,
                             .find = find,
                             .initialized = lag_initialized,
                             .calculate = lag_calculate,
                             .step = step_up,
                             .update = update};
