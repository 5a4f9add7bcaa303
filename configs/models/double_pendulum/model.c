/* Two pendulums, the second at the end of the first; point masses, no friction. */
#include <math.h>

#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    if (!(M(m1) > 0.0 && M(l1) > 0.0 && M(l2) > 0.0))
        return model_error(m, "m1, l1 and l2 must be positive, got %g, %g and %g", M(m1), M(l1),
                           M(l2));

    const double between = M(angle1) - M(angle2);
    const double c = cos(between), s = sin(between);
    const double both = M(m1) + M(m2);
    /* mass matrix [both l1, m2 l2 c; l1 c, l2] times the accelerations */
    const double first = -M(m2) * M(l2) * M(speed2) * M(speed2) * s - both * M(g) * sin(M(angle1));
    const double second = M(l1) * M(speed1) * M(speed1) * s - M(g) * sin(M(angle2));
    const double determinant = M(l1) * M(l2) * (both - M(m2) * c * c);

    M(der_angle1) = M(speed1);
    M(der_angle2) = M(speed2);
    M(der_speed1) = (M(l2) * first - M(m2) * M(l2) * c * second) / determinant;
    M(der_speed2) = (both * M(l1) * second - M(l1) * c * first) / determinant;
    M(y1) = M(angle1);
    M(y2) = M(angle2);
    return fmi2OK;
}
