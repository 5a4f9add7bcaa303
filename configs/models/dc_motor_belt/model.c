/* A DC motor that drives a load through an elastic belt. */
#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    if (!(M(L) > 0.0))
        return model_error(m, "inductance must be positive, got %g", M(L));
    if (!(M(J_motor) > 0.0 && M(J_load) > 0.0))
        return model_error(m, "inertias must be positive, got %g and %g", M(J_motor), M(J_load));

    const double slip = M(w_motor) - M(w_load);
    const double belt = M(k_belt) * M(twist) + M(d_belt) * slip;

    M(der_i) = (M(V) - M(R) * M(i) - M(K) * M(w_motor)) / M(L);
    M(der_w_motor) = (M(K) * M(i) - M(b_motor) * M(w_motor) - belt) / M(J_motor);
    M(der_twist) = slip;
    M(der_w_load) = (belt - M(b_load) * M(w_load) - M(T_load)) / M(J_load);

    M(current) = M(i);
    M(speed) = M(w_motor);
    M(load_speed) = M(w_load);
    return fmi2OK;
}
