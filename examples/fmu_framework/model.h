/* What a model must provide to become a co-simulation slave:
 *
 *     x' = f(p, x, u)        its states, two or so, or none
 *     y  = g(t, p, x, u)     outputs that are not states
 *     y' = dg/dt             with the derivatives of x and u
 *
 * and the value references by which modelDescription.xml calls all of them. The time t [s] is that
 * of the communication point at which the slave stands.
 */
#ifndef MODEL_H
#define MODEL_H

#include "dormand_prince.h" /* MAX_STATES */

#include <stdbool.h>

enum { MAX_INPUTS = 4, MAX_OUTPUTS = 1, MAX_PARAMETERS = 6 };

/* Value reference = block + index within the block. */
enum {
    INPUT = 0,
    STATE = 100,
    DERIVATIVE = 200, /* of the state with the same index */
    OUTPUT = 300,     /* outputs that are not states */
    PARAMETER = 400,
    MAX_STEP = 500, /* parameter of every slave: the longest step it takes, 0 for any */
    BLOCK_SIZE = 100
};

typedef struct {
    const char *identifier; /* modelIdentifier of modelDescription.xml */
    const char *guid;       /* guid of modelDescription.xml */
    int inputs, states, outputs, parameters;
    bool is_tunable[MAX_PARAMETERS]; /* parameters that may be set between steps */
    bool states_are_outputs; /* else they are local variables */

    double start[MAX_STATES];
    double nominal[MAX_STATES]; /* of the states, for the absolute tolerance */
    double parameter_start[MAX_PARAMETERS];

    /* NULL where `states` is 0. */
    void (*derivatives)(const double p[], const double x[], const double u[], double dx[]);
    /* Both NULL where `outputs` is 0. `du` is u'. */
    void (*output_values)(double t, const double p[], const double x[], const double u[],
                          double y[]);
    void (*output_derivatives)(double t, const double p[], const double x[], const double dx[],
                               const double u[], const double du[], double dy[]);
} Model;

extern const Model model;

#endif
