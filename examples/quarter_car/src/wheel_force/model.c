/* The wheel between the road and the chassis, which tells the chassis only the force
 *
 *     F     = k_c (x - x_c) + d_c (v - v_c)
 *     m x'' = k_w (z - x) - d_w v - F
 *
 * F contains the inputs x_c and v_c themselves: direct feed-through.
 */
#include "model.h"

enum { x_c, v_c };                  /* inputs: displacement and velocity of the chassis */
enum { x, v };                      /* states, not outputs: displacement and velocity */
enum { F };                         /* output: the force that the wheel exerts on the chassis */
enum { m, k_w, d_w, k_c, d_c, z };  /* parameters: mass, tyre, suspension, height of the road */

static double force(const double p[], const double s[], const double u[])
{
    return p[k_c] * (s[x] - u[x_c]) + p[d_c] * (s[v] - u[v_c]);
}

static void derivatives(const double p[], const double s[], const double u[], double ds[])
{
    ds[x] = s[v];
    ds[v] = (p[k_w] * (p[z] - s[x]) - p[d_w] * s[v] - force(p, s, u)) / p[m];
}

static void output_values(double t, const double p[], const double s[], const double u[],
                          double y[])
{
    (void)t;
    y[F] = force(p, s, u);
}

/* F is linear in states and inputs, so F' is the same form in their derivatives. */
static void output_derivatives(double t, const double p[], const double s[], const double ds[],
                               const double u[], const double du[], double dy[])
{
    (void)t;
    (void)s;
    (void)u;
    dy[F] = force(p, ds, du);
}

const Model model = {
    .identifier = "wheel_force",
    .guid = "{b103f5fd-db76-423c-952f-2647a076f744}",
    .inputs = 2,
    .states = 2,
    .outputs = 1,
    .parameters = 6,
    .is_tunable = {[k_w] = true, [d_w] = true, [k_c] = true, [d_c] = true, [z] = true},
    .states_are_outputs = false,
    .nominal = {1.0, 1.0},
    .parameter_start = {[m] = 40.0,
                        [k_w] = 150000.0,
                        [d_w] = 0.0,
                        [k_c] = 15000.0,
                        [d_c] = 1000.0,
                        [z] = 0.1},
    .derivatives = derivatives,
    .output_values = output_values,
    .output_derivatives = output_derivatives,
};
