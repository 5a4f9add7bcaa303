/* The carriage of an electro-mechanical positioning system, in its control loop. */
#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    double volts;

    if (!(M(M) > 0.0))
        return model_error(m, "mass must be positive, got %g", M(M));
    if (!(M(lag_speed) > 0.0))
        return model_error(m, "lag_speed must be positive, got %g", M(lag_speed));
    if (!(M(lag_drive) > 0.0))
        return model_error(m, "lag_drive must be positive, got %g", M(lag_drive));

    volts = M(kv) * (M(kp) * (M(qg) - M(q)) - M(speed)) + M(pulses);
    M(der_q) = M(v);
    M(der_v) = (M(gtau) * M(u) - M(Fv) * M(v) - M(offset)) / M(M);
    M(der_speed) = (M(v) - M(speed)) / M(lag_speed);
    M(der_u) = (volts - M(u)) / M(lag_drive);
    M(force) = M(gtau) * volts;
    M(position) = M(q);
    return fmi2OK;
}
