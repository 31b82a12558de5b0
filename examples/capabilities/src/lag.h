/* A first order lag, from which most FMUs of this collection are made:
 *
 *     T x' = u - x,   y = x
 *
 * with u(t + tau) = u + du tau. A behaviour whose state begins with a Lag can use the functions
 * as they are.
 */
#ifndef LAG_H
#define LAG_H

#include "behaviour.h"

/* Value references. */
enum { LAG_U = 0, LAG_Y = 1, LAG_T = 2, LAG_X_START = 3, LAG_REFERENCES = 10 };

typedef struct {
    double u, du;       /* input and its derivative [1/s] */
    double T;           /* s, time constant, default 0.5 */
    double x_start;     /* default 1 */
    double x, y;
    double initialized; /* not 0: x is no longer x_start */
} Lag;

void lag_start(void *state);
Variable lag_find(void *state, Type type, uint32_t reference);
void lag_initialized(void *state, double time);
void lag_calculate(void *state, double time);
double *lag_input_derivative(void *state, uint32_t reference, int order);
bool lag_output_derivative(void *state, double time, uint32_t reference, int order, double *value);

/* The exact solution after a time h [s], with the input along its line. */
void lag_advance(Lag *lag, double h);

/* A whole communication step of it. */
Outcome lag_step(void *state, void *hidden, Step *step);

/* What every lag is, for the initializer of a behaviour. */
#define LAG_BEHAVIOUR                                                                              \
    .start = lag_start, .find = lag_find, .initialized = lag_initialized,                          \
    .calculate = lag_calculate, .input_derivative = lag_input_derivative,                          \
    .output_derivative = lag_output_derivative

#endif
