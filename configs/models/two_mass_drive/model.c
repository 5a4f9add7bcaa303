/* A motor and a load on the two ends of an elastic shaft. */
#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    if (!(M(J_motor) > 0.0 && M(J_load) > 0.0))
        return model_error(m, "inertias must be positive, got %g and %g", M(J_motor), M(J_load));

    const double slip = M(w_motor) - M(w_load);
    const double shaft = M(k_shaft) * M(twist) + M(d_shaft) * slip;

    M(der_twist) = slip;
    M(der_w_motor) = (M(torque) - shaft - M(b_motor) * M(w_motor)) / M(J_motor);
    M(der_w_load) = (shaft - M(b_load) * M(w_load)) / M(J_load);
    M(motor_speed) = M(w_motor);
    M(load_speed) = M(w_load);
    return fmi2OK;
}
