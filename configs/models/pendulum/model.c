/* A pendulum driven by a torque at its pivot. */
#include <math.h>

#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    if (!(M(J) > 0.0))
        return model_error(m, "moment of inertia must be positive, got %g", M(J));

    M(der_angle) = M(speed);
    M(der_speed) = (M(torque) - M(G) * sin(M(angle)) - M(b) * M(speed)) / M(J);
    M(y) = M(angle);
    return fmi2OK;
}
