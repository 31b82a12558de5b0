/* A van der Pol oscillator that a spring and a damper tie to another one:
 *
 *     x'' = mu (1 - x^2) x' - x + c (x_other - x) + d (v_other - v)
 *
 * All quantities but the time [s] are without a unit.
 */
#include "model.h"

enum { x_other, v_other };  /* inputs: displacement and velocity of the other oscillator */
enum { x, v };              /* states and outputs: displacement and velocity */
enum { mu, c, d };          /* parameters: nonlinearity, spring, damper */

static void derivatives(const double p[], const double s[], const double u[], double ds[])
{
    ds[x] = s[v];
    ds[v] = p[mu] * (1.0 - s[x] * s[x]) * s[v] - s[x] + p[c] * (u[x_other] - s[x]) +
            p[d] * (u[v_other] - s[v]);
}

const Model model = {
    .identifier = "van_der_pol",
    .guid = "{d182e789-4e49-4244-80cb-d383fbdc8d73}",
    .inputs = 2,
    .states = 2,
    .parameters = 3,
    .states_are_outputs = true,
    .start = {[x] = 2.0},
    .nominal = {1.0, 1.0},
    .parameter_start = {[mu] = 1.0, [c] = 0.0, [d] = 0.0},
    .derivatives = derivatives,
};
