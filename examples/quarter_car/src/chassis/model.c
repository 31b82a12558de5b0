/* The chassis, hung on the wheel by a spring and a damper:
 *
 *     m x'' = k (x_w - x) + d (v_w - v)
 */
#include "model.h"

enum { x_w, v_w };  /* inputs: displacement [m] and velocity [m/s] of the wheel */
enum { x, v };      /* states and outputs: displacement [m] and velocity [m/s] */
enum { m, k, d };   /* parameters: mass [kg], spring [N/m], damper [N.s/m] */

static void derivatives(const double p[], const double s[], const double u[], double ds[])
{
    ds[x] = s[v];
    ds[v] = (p[k] * (u[x_w] - s[x]) + p[d] * (u[v_w] - s[v])) / p[m];
}

const Model model = {
    .identifier = "chassis",
    .guid = "{b0cdc0f8-87ab-4f9a-9a27-a1eeea1b98b8}",
    .inputs = 2,
    .states = 2,
    .parameters = 3,
    .is_tunable = {[k] = true, [d] = true},
    .states_are_outputs = true,
    .nominal = {1.0, 1.0},
    .parameter_start = {[m] = 400.0, [k] = 15000.0, [d] = 1000.0},
    .derivatives = derivatives,
};
