#include "dormand_prince.h"

#include <math.h>
#include <stdbool.h>
#include <string.h>

enum { STAGES = 7 };

static const double SAFETY = 0.9;
static const double MIN_FACTOR = 0.2;
static const double MAX_FACTOR = 5.0;

/* A few seconds of work: a call that would take longer reports instead of seeming to hang. */
static const long MAX_STEPS = 10000000;

/* The last row is also the fifth order solution, so the last stage of an accepted step is the
 * first stage of the next one. */
static const double A[STAGES][STAGES - 1] = {
    {0.0},
    {1.0 / 5.0},
    {3.0 / 40.0, 9.0 / 40.0},
    {44.0 / 45.0, -56.0 / 15.0, 32.0 / 9.0},
    {19372.0 / 6561.0, -25360.0 / 2187.0, 64448.0 / 6561.0, -212.0 / 729.0},
    {9017.0 / 3168.0, -355.0 / 33.0, 46732.0 / 5247.0, 49.0 / 176.0, -5103.0 / 18656.0},
    {35.0 / 384.0, 0.0, 500.0 / 1113.0, 125.0 / 192.0, -2187.0 / 6784.0, 11.0 / 84.0},
};
static const double C[STAGES] = {0.0, 1.0 / 5.0, 3.0 / 10.0, 4.0 / 5.0, 8.0 / 9.0, 1.0, 1.0};

/* Fifth order weights minus fourth order weights. */
static const double E[STAGES] = {71.0 / 57600.0,      0.0,          -71.0 / 16695.0, 71.0 / 1920.0,
                                 -17253.0 / 339200.0, 22.0 / 525.0, -1.0 / 40.0};

/* Newton's method from above: it falls until rounding stops it. */
static double fifth_root(double a)
{
    double y = a > 1.0 ? a : 1.0;
    for (;;) {
        const double y2 = y * y;
        const double next = (4.0 * y + a / (y2 * y2)) / 5.0;
        if (!(next < y))
            return y;
        y = next;
    }
}

/* Root mean square of v_i / (tolerance * (nominal_i + |x_i|)). */
static double weighted_norm(const InitialValueProblem *problem, const double v[], const double x[])
{
    double sum = 0.0;
    for (int i = 0; i < problem->n; ++i) {
        const double ratio = v[i] / (problem->tolerance * (problem->nominal[i] + fabs(x[i])));
        sum += ratio * ratio;
    }
    return sqrt(sum / problem->n);
}

/* The starting step size of Hairer, Nørsett, Wanner, II.4; `f` is x'(0). */
static double first_step(const InitialValueProblem *problem, double end, const double x[],
                         const double f[])
{
    const double d0 = weighted_norm(problem, x, x);
    const double d1 = weighted_norm(problem, f, x);
    const double h0 = fmin(end, d0 < 1e-5 || d1 < 1e-5 ? 1e-6 : 0.01 * d0 / d1);

    double moved[MAX_STATES], df[MAX_STATES];
    for (int i = 0; i < problem->n; ++i)
        moved[i] = x[i] + h0 * f[i];
    problem->right_hand_side(problem->context, h0, moved, df);
    for (int i = 0; i < problem->n; ++i)
        df[i] = (df[i] - f[i]) / h0;

    const double d = fmax(d1, weighted_norm(problem, df, x));
    const double h1 = d <= 1e-15 ? fmax(1e-6, 1e-3 * h0) : fifth_root(0.01 / d);
    const double h = fmin(100.0 * h0, h1);
    return isfinite(h) && h > 0.0 ? h : end;
}

/* One trial step of size h. Returns the error relative to the tolerance: at most 1 is good. */
static double attempt(const InitialValueProblem *problem, double tau, double h, const double x[],
                      double k[STAGES][MAX_STATES], double x_new[])
{
    double error[MAX_STATES], scale[MAX_STATES];
    const int n = problem->n;

    for (int stage = 1; stage < STAGES; ++stage) {
        for (int i = 0; i < n; ++i) {
            double slope = 0.0;
            for (int j = 0; j < stage; ++j)
                slope += A[stage][j] * k[j][i];
            x_new[i] = x[i] + h * slope;
        }
        problem->right_hand_side(problem->context, tau + C[stage] * h, x_new, k[stage]);
    }
    for (int i = 0; i < n; ++i) {
        double slope = 0.0;
        for (int j = 0; j < STAGES; ++j)
            slope += E[j] * k[j][i];
        error[i] = h * slope;
        scale[i] = fmax(fabs(x[i]), fabs(x_new[i]));
        if (!isfinite(x_new[i]))
            return INFINITY;
    }
    return weighted_norm(problem, error, scale);
}

/* SAFETY * error^(-1/5) within its bounds. An error that is not finite shrinks the step. */
static double step_factor(double error)
{
    const double least = SAFETY / MAX_FACTOR; /* fifth root of the error that gives MAX_FACTOR */
    if (error <= least * least * least * least * least)
        return MAX_FACTOR;
    return isfinite(error) ? fmax(MIN_FACTOR, SAFETY / fifth_root(error)) : MIN_FACTOR;
}

IntegrationResult dormand_prince(const InitialValueProblem *problem, double end, double x[],
                                 double *step)
{
    if (problem->n == 0)
        return REACHED_END;
    const size_t size = (size_t)problem->n * sizeof(double);
    double now[MAX_STATES], next[MAX_STATES], k[STAGES][MAX_STATES];
    memcpy(now, x, size);
    problem->right_hand_side(problem->context, 0.0, now, k[0]);

    double proposed = *step > 0.0 ? *step : first_step(problem, end, now, k[0]);
    double tau = 0.0;
    bool rejected = false;
    for (long count = 0; tau < end; ++count) {
        /* The end is set, not approached: the last step is what remains, the last but one half
         * of what remains, so that no sliver is left over. */
        const double remaining = end - tau;
        const bool last = proposed >= remaining;
        const double h = last ? remaining : fmin(proposed, 0.5 * remaining);
        if (!last && !(tau + h > tau))
            return STEP_UNDERFLOW;
        if (count == MAX_STEPS)
            return TOO_MANY_STEPS;

        const double error = attempt(problem, tau, h, now, k, next);
        double factor = step_factor(error);
        if (error <= 1.0) {
            if (rejected)
                factor = fmin(factor, 1.0);
            /* A step cut short at the end, with an error so small that the factor is at its
             * bound, says nothing against the larger step proposed before. */
            proposed = factor == MAX_FACTOR ? fmax(proposed, factor * h) : factor * h;
            tau = last ? end : tau + h;
            memcpy(now, next, size);
            memcpy(k[0], k[STAGES - 1], size);
            rejected = false;
        } else {
            proposed = factor * h;
            rejected = true;
        }
    }
    memcpy(x, now, size);
    *step = proposed;
    return REACHED_END;
}
