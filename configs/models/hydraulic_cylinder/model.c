/* A hydraulic cylinder with a servo valve that moves a mass against a spring. */
#include "fmi2_model.h"

#include <math.h>

fmi2Status model_equations(Model *m)
{
    if (!(M(mass) > 0.0))
        return model_error(m, "the mass must be positive, got %g", M(mass));

    const double drop = M(p_supply) - (M(u) >= 0.0 ? M(p) : -M(p));
    const double flow = M(q) * M(u) * sqrt(drop > 0.0 ? drop : 0.0);
    const double force = 1e6 * M(area) * M(p); /* MPa to Pa */

    M(der_x) = M(v);
    M(der_v) = (force - M(b) * M(v) - M(k) * M(x) - M(F_load)) / M(mass);
    M(der_p) = M(E) * (flow - M(area) * M(v));
    M(position) = M(x);
    M(pressure) = M(p);
    return fmi2OK;
}
