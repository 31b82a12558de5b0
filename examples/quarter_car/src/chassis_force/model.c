/* The chassis as a free mass, moved by the force that the wheel sends:
 *
 *     m x'' = F
 */
#include "model.h"

enum { F };     /* input: force [N] */
enum { x, v };  /* states and outputs: displacement [m] and velocity [m/s] */
enum { m };     /* parameter: mass [kg] */

static void derivatives(const double p[], const double s[], const double u[], double ds[])
{
    ds[x] = s[v];
    ds[v] = u[F] / p[m];
}

const Model model = {
    .identifier = "chassis_force",
    .guid = "{d1f97329-1856-4b6c-a41d-ebc555a34ba6}",
    .inputs = 1,
    .states = 2,
    .parameters = 1,
    .states_are_outputs = true,
    .nominal = {1.0, 1.0},
    .parameter_start = {[m] = 400.0},
    .derivatives = derivatives,
};
