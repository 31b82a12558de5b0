/* The equations of a `model` of the FMU framework as a behaviour, with the same value references.
 *
 * Co-simulation integrates them with Dormand-Prince, one step of this program the same bits as one
 * of the framework's. With INTERNAL_STEP defined it is the classical Runge-Kutta method instead,
 * with equal internal steps of at most INTERNAL_STEP [s], which asks for the inputs at the times of
 * all its stages: with inputs that are exact there the error falls with the fourth power of the
 * internal step.
 */
#include "behaviour.h"
#include "model.h"

#include <math.h>
#include <string.h>

enum { INPUT_ORDERS = MAX_INPUT_DERIVATIVE_ORDER + 1 };

typedef struct {
    double micro_step; /* s, what the integrator tries next, 0: it has not run yet */
    double x[MAX_STATES];
    double dx[MAX_STATES];
    /* Row j is the j-th derivative, so u(time + tau) = sum_j u[j] tau^j / j!. */
    double u[INPUT_ORDERS][MAX_INPUTS];
    double p[MAX_PARAMETERS];
} State;

static void start(void *block)
{
    State *state = block;
    memcpy(state->x, model.start, sizeof state->x);
    memcpy(state->p, model.parameter_start, sizeof state->p);
}

static Variable find(void *block, Type type, uint32_t reference)
{
    State *state = block;
    const uint32_t group = reference - reference % BLOCK_SIZE;
    const int i = (int)(reference % BLOCK_SIZE);
    if (type == FLOAT64 && group == INPUT && i < model.inputs)
        return (Variable){&state->u[0][i], 1, INPUT_VALUE};
    if (type == FLOAT64 && group == STATE && i < model.states)
        return (Variable){&state->x[i], 1, START_VALUE};
    if (type == FLOAT64 && group == DERIVATIVE && i < model.states)
        return (Variable){&state->dx[i], 1, READ_ONLY};
    if (type == FLOAT64 && group == PARAMETER && i < model.parameters)
        return (Variable){&state->p[i], 1, START_VALUE};
    return (Variable){0};
}

/* u(time + tau). With `order` > 0 its derivative. */
static void input_values(const State *state, int order, double tau, double u[])
{
    for (int i = 0; i < model.inputs; ++i) {
        double value = 0.0;
        for (int j = INPUT_ORDERS - 1; j >= order; --j)
            value = state->u[j][i] + value * tau / (j - order + 1);
        u[i] = value;
    }
}

static void right_hand_side(const void *block, double tau, const double x[], double dx[])
{
    const State *state = block;
    double u[MAX_INPUTS];
    input_values(state, 0, tau, u);
    model.derivatives(state->p, x, u, dx);
}

static void calculate(void *block, double time)
{
    State *state = block;
    (void)time;
    right_hand_side(state, 0.0, state->x, state->dx);
}

static double *input_derivative(void *block, uint32_t reference, int order)
{
    State *state = block;
    return reference < (uint32_t)model.inputs && order < INPUT_ORDERS
               ? &state->u[order][reference]
               : NULL;
}

static bool output_derivative(void *block, double time, uint32_t reference, int order,
                              double *value)
{
    State *state = block;
    if (reference < STATE || reference >= STATE + (uint32_t)model.states || order != 1)
        return false;
    calculate(state, time);
    *value = state->dx[reference - STATE];
    return true;
}

#ifdef INTERNAL_STEP

/* One Runge-Kutta step, its inputs asked for as it goes along. */
static void runge_kutta(State *state, const Step *step, double now, double next)
{
    static const double NODE[4] = {0.0, 0.5, 0.5, 1.0};
    static const double WEIGHT[4] = {1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0};
    const double h = next - now;
    double x[MAX_STATES], sum[MAX_STATES] = {0.0}, k[MAX_STATES] = {0.0};
    for (int stage = 0; stage < 4; ++stage) {
        for (int i = 0; i < model.states; ++i)
            x[i] = state->x[i] + NODE[stage] * h * k[i];
        if (step->request_inputs && stage != 2) /* at the same time as stage 1 */
            step->request_inputs(step, stage == 0 ? now : stage == 3 ? next : now + 0.5 * h);
        model.derivatives(state->p, x, state->u[0], k);
        for (int i = 0; i < model.states; ++i)
            sum[i] += WEIGHT[stage] * k[i];
    }
    for (int i = 0; i < model.states; ++i)
        state->x[i] += h * sum[i];
}

static bool is_finite(const State *state)
{
    for (int i = 0; i < model.states; ++i)
        if (!isfinite(state->x[i]))
            return false;
    return true;
}

static Outcome take(void *block, void *hidden, Step *step)
{
    State *state = block;
    (void)hidden;
    const double count = fmax(1.0, ceil(step->h / INTERNAL_STEP * (1.0 - 1e-12)));
    double end = step->reached, now = step->t;
    for (double i = 1.0; now < end; i += 1.0) {
        const double next = i < count ? fmin(end, step->t + i * (step->h / count)) : end;
        runge_kutta(state, step, now, next);
        if (!is_finite(state)) {
            step->reason = "the states are not finite";
            return STEP_FAILED;
        }
        now = next;
        if (step->finish_internal_step)
            end = step->finish_internal_step(step, now);
    }
    step->reached = now;
    return STEP_TAKEN;
}

#else

static Outcome take(void *block, void *hidden, Step *step)
{
    State *state = block;
    (void)hidden;
    const InitialValueProblem problem = {.n = model.states,
                                         .right_hand_side = right_hand_side,
                                         .context = state,
                                         .tolerance = step->tolerance,
                                         .nominal = model.nominal};
    if (dormand_prince(&problem, step->h, state->x, &state->micro_step) != REACHED_END) {
        step->reason = "the integrator cannot go on; look for values that are not finite, a mass "
                       "of 0, or parameters that make the model too stiff";
        return STEP_FAILED;
    }
    for (int order = 0; order < INPUT_ORDERS; ++order)
        input_values(state, order, step->h, state->u[order]);
    return STEP_TAKEN;
}

#endif

static double *continuous_state(void *block)
{
    State *state = block;
    return state->x;
}

static void derivatives(void *block, double time, double dx[])
{
    State *state = block;
    calculate(state, time);
    memcpy(dx, state->dx, (size_t)model.states * sizeof(double));
}

const Behaviour behaviour = {
    .state_size = sizeof(State),
    .start = start,
    .find = find,
    .calculate = calculate,
    .step = take,
    .input_derivative = input_derivative,
    .output_derivative = output_derivative,
    .continuous_states = 2, /* as the halves of the quarter car have */
    .continuous_state = continuous_state,
    .nominals = model.nominal,
    .derivatives = derivatives,
};
