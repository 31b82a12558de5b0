/* The wheel between the road and the chassis:
 *
 *     m x'' = k_w (z - x) - d_w v - k_c (x - x_c) - d_c (v - v_c)
 *
 * The road's height z does not change, so its damper sees the wheel's velocity alone.
 */
#include "model.h"

enum { x_c, v_c };                  /* inputs: displacement and velocity of the chassis */
enum { x, v };                      /* states and outputs: displacement and velocity */
enum { m, k_w, d_w, k_c, d_c, z };  /* parameters: mass, tyre, suspension, height of the road */

static void derivatives(const double p[], const double s[], const double u[], double ds[])
{
    ds[x] = s[v];
    ds[v] = (p[k_w] * (p[z] - s[x]) - p[d_w] * s[v] - p[k_c] * (s[x] - u[x_c]) -
             p[d_c] * (s[v] - u[v_c])) /
            p[m];
}

const Model model = {
    .identifier = "wheel",
    .guid = "{d2dc374c-7884-41dc-bf93-ef59e0f73a1a}",
    .inputs = 2,
    .states = 2,
    .parameters = 6,
    .is_tunable = {[k_w] = true, [d_w] = true, [k_c] = true, [d_c] = true, [z] = true},
    .states_are_outputs = true,
    .nominal = {1.0, 1.0},
    .parameter_start = {[m] = 40.0,
                        [k_w] = 150000.0,
                        [d_w] = 0.0,
                        [k_c] = 15000.0,
                        [d_c] = 1000.0,
                        [z] = 0.1},
    .derivatives = derivatives,
};
