/* A point mass on a rod that stands on a cart; the angle is zero upright. */
#include <math.h>

#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    if (!(M(m_cart) > 0.0 && M(m_rod) > 0.0 && M(l) > 0.0))
        return model_error(m, "m_cart, m_rod and l must be positive, got %g, %g and %g",
                           M(m_cart), M(m_rod), M(l));

    const double c = cos(M(angle)), s = sin(M(angle));
    /* [m_cart + m_rod, m_rod l c; c, l] times the accelerations */
    const double first =
        M(F) - M(b) * M(velocity) + M(m_rod) * M(l) * M(speed) * M(speed) * s;
    const double second = M(g) * s - M(d) * M(speed) / (M(m_rod) * M(l));
    const double determinant = M(l) * (M(m_cart) + M(m_rod) * s * s);

    M(der_position) = M(velocity);
    M(der_angle) = M(speed);
    M(der_velocity) = (M(l) * first - M(m_rod) * M(l) * c * second) / determinant;
    M(der_speed) = ((M(m_cart) + M(m_rod)) * second - c * first) / determinant;
    M(y1) = M(position);
    M(y2) = M(angle);
    return fmi2OK;
}
