/* Two tanks, one above the other: a pump fills the upper one, which empties into the lower. */
#include <math.h>

#include "fmi2_model.h"

/* An empty tank has no outflow. Written so that a level that is not a number stays one. */
static double root_of_level(double level) { return level < 0.0 ? 0.0 : sqrt(level); }

fmi2Status model_equations(Model *m)
{
    const double upper_outflow = M(k1) * root_of_level(M(h1));
    const double lower_outflow = M(k2) * root_of_level(M(h2));

    M(der_h1) = M(kp) * M(u) - upper_outflow;
    M(der_h2) = upper_outflow - lower_outflow;
    M(y) = M(h2);
    return fmi2OK;
}
