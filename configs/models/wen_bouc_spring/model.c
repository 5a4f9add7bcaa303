/* A spring with hysteresis, the normalised Bouc-Wen model, moved by a sine wave. */
#include <math.h>

#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    if (!(M(n) > 0.0))
        return model_error(m, "n must be positive, got %g", M(n));

    const double displacement = M(Amp) * sin(M(omega) * M(time));
    const double velocity = M(Amp) * M(omega) * cos(M(omega) * M(time));
    const double power = pow(fabs(M(W)), M(n));

    /* |W|^(n-1) W is |W|^n with the sign of W: finite at W = 0 for n below 1 too. */
    M(der_W) = M(rho) * (velocity - M(sigma) * fabs(velocity) * copysign(power, M(W)) +
                         (M(sigma) - 1.0) * velocity * power);
    M(Displacement) = displacement;
    M(Force) = M(k_x) * displacement + M(k_w) * M(W);
    return fmi2OK;
}
