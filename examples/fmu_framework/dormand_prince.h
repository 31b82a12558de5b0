/* Dormand-Prince 5(4) with step size control, for small systems x' = f(tau, x).
 *
 * The integrator knows nothing of FMI. All that it remembers from one call to the next is the
 * step size it would try next, and that belongs to the caller: who saves (x, step) and comes back
 * with them gets the same bits again. It uses only + - * / and sqrt, which IEEE 754 rounds in one
 * way, so the bits do not depend on the platform's mathematical library either.
 *
 * Hairer, Nørsett, Wanner: Solving Ordinary Differential Equations I, sections II.4 and II.5.
 */
#ifndef DORMAND_PRINCE_H
#define DORMAND_PRINCE_H

enum { MAX_STATES = 4 };

typedef struct {
    int n; /* number of states, at most MAX_STATES; with 0 the end is reached at once */
    void (*right_hand_side)(const void *context, double tau, const double x[], double dx[]);
    const void *context;
    double tolerance;      /* relative; times `nominal` it is also the absolute tolerance */
    const double *nominal; /* n values, units of x */
} InitialValueProblem;

typedef enum {
    REACHED_END,
    STEP_UNDERFLOW, /* the step became too small to move tau: x' is not finite, or jumps */
    TOO_MANY_STEPS  /* far too stiff for an explicit method */
} IntegrationResult;

/* Integrate from tau = 0 to tau = `end` > 0.
 *
 * `x`     in: x(0); out: x(end). Left alone unless the result is REACHED_END.
 * `step`  in: the step to try first, 0 if unknown; out: the step to try first next time.
 */
IntegrationResult dormand_prince(const InitialValueProblem *problem, double end, double x[],
                                 double *step);

#endif
