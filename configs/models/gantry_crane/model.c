/* A gantry crane: a trolley on a rail with a load on a rope, pushed by a motor. */
#include "fmi2_model.h"

#include <math.h>

static const double GRAVITY = 9.81; /* m/s2 */

fmi2Status model_equations(Model *m)
{
    if (!(M(m_trolley) > 0.0 && M(m_load) > 0.0 && M(l_rope) > 0.0))
        return model_error(m, "masses and length must be positive, got %g, %g and %g",
                           M(m_trolley), M(m_load), M(l_rope));

    const double s = sin(M(phi)), c = cos(M(phi)), l = M(l_rope), load = M(m_load);
    const double pull = load * s * (l * M(w) * M(w) + GRAVITY * c) + M(d_pivot) * M(w) * c / l;
    const double push = M(F) - M(b_trolley) * M(v);
    const double acceleration = (push + pull) / (M(m_trolley) + load * s * s);

    M(der_x) = M(v);
    M(der_v) = acceleration;
    M(der_phi) = M(w);
    M(der_w) = -(acceleration * c + GRAVITY * s) / l - M(d_pivot) * M(w) / (load * l * l);
    M(position) = M(x);
    M(angle) = M(phi);
    return fmi2OK;
}
