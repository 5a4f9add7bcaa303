/* A pendulum on a rotating arm, with viscous and dry friction. All is divided by mass, gravity and length. */
#include <math.h>

#include "fmi2_model.h"

static const double WIDTH = 0.05; /* rad/s, of the change of sign of a dry friction */

static double direction(double speed) { return tanh(speed / WIDTH); }

fmi2Status model_equations(Model *m)
{
    const double sine = sin(M(theta)), cosine = cos(M(theta));
    /* both accelerations at once: [of_arm, both; both, b] [der(w); der(u)] = [on_arm; on_u] */
    const double of_arm = M(a) + M(b) * sine * sine;
    const double both = -M(c) * cosine;
    const double determinant = of_arm * M(b) - both * both;
    const double on_arm =
        -2.0 * M(b) * sine * cosine * M(w) * M(u) - M(c) * sine * M(u) * M(u) - M(f1) * M(w)
        - M(F1) * direction(M(w));
    const double on_u = M(b) * sine * cosine * M(w) * M(w) + sine - M(f2) * M(u)
        - M(F2) * direction(M(u));

    if (!(determinant > 0.0))
        return model_error(m, "a b must be more than c^2 where the pendulum is upright");

    M(der_phi) = M(w);
    M(der_w) = (M(b) * on_arm - both * on_u) / determinant;
    M(der_theta) = M(u);
    M(der_u) = (of_arm * on_u - both * on_arm) / determinant;
    M(arm) = M(phi);
    M(pendulum) = M(theta);
    return fmi2OK;
}
