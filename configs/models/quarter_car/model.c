/* A quarter of a car: body and wheel on a suspension and a tyre, moved by the road. */
#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    if (!(M(m_body) > 0.0 && M(m_wheel) > 0.0))
        return model_error(m, "masses must be positive, got %g and %g", M(m_body), M(m_wheel));

    const double stretch = M(z_body) - M(z_wheel);
    const double suspension = M(k_spring) * stretch + M(c_damper) * (M(v_body) - M(v_wheel));
    const double tyre = M(k_tyre) * (M(z_wheel) - M(road));

    M(der_z_body) = M(v_body);
    M(der_v_body) = -suspension / M(m_body);
    M(der_z_wheel) = M(v_wheel);
    M(der_v_wheel) = (suspension - tyre) / M(m_wheel);
    M(velocity) = M(v_body);
    M(travel) = stretch;
    return fmi2OK;
}
