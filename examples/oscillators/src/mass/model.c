/* A point mass between a left and a right neighbour, each behind a spring and a damper:
 *
 *     m x'' = c_left (x_left - x) + d_left (v_left - v)
 *           + c_right (x_right - x) + d_right (v_right - v)
 *
 * A neighbour that is not connected rests at 0: a wall.
 */
#include "model.h"

enum { x_left, v_left, x_right, v_right };  /* inputs: displacements [m], velocities [m/s] */
enum { x, v };                              /* states and outputs: displacement, velocity */
enum { m, c_left, d_left, c_right, d_right };  /* parameters: mass, springs, dampers */

static void derivatives(const double p[], const double s[], const double u[], double ds[])
{
    ds[x] = s[v];
    ds[v] = (p[c_left] * (u[x_left] - s[x]) + p[d_left] * (u[v_left] - s[v]) +
             p[c_right] * (u[x_right] - s[x]) + p[d_right] * (u[v_right] - s[v])) /
            p[m];
}

const Model model = {
    .identifier = "mass",
    .guid = "{0212dd64-ddae-48bc-9ff8-4349ebf0f6ad}",
    .inputs = 4,
    .states = 2,
    .parameters = 5,
    .states_are_outputs = true,
    .nominal = {1.0, 1.0},
    .parameter_start = {[m] = 1.0,
                        [c_left] = 1.0,
                        [d_left] = 0.0,
                        [c_right] = 1.0,
                        [d_right] = 0.0},
    .derivatives = derivatives,
};
