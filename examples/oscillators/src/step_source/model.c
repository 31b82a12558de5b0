/* A signal with a jump:
 *
 *     y = before    for t < t_step
 *     y = after     for t >= t_step
 *
 * t is the time of the communication point, compared as it is, without a tolerance.
 */
#include "model.h"

enum { y };                       /* output */
enum { before, after, t_step };   /* parameters: the two values, and the time of the jump [s] */

static void output_values(double t, const double p[], const double s[], const double u[],
                          double out[])
{
    (void)s;
    (void)u;
    out[y] = t >= p[t_step] ? p[after] : p[before];
}

/* On either side of the jump, and at the jump from the right. */
static void output_derivatives(double t, const double p[], const double s[], const double ds[],
                               const double u[], const double du[], double dout[])
{
    (void)t;
    (void)p;
    (void)s;
    (void)ds;
    (void)u;
    (void)du;
    dout[y] = 0.0;
}

const Model model = {
    .identifier = "step_source",
    .guid = "{4767ba31-e628-4c39-8db0-135e8e7311cf}",
    .outputs = 1,
    .parameters = 3,
    .parameter_start = {[before] = 0.0, [after] = 1.0, [t_step] = 1.0},
    .output_values = output_values,
    .output_derivatives = output_derivatives,
};
