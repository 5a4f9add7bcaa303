/* A mass on a spring and a damper with what its plain model lacks; at zero each effect is off. */
#include <math.h>

#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    double slack = fmax(fabs(M(F)) - M(dead), 0.0); /* of the force, nothing acts below `dead` */
    double force = M(F) > 0.0 ? slack : -slack;
    double stiffness = M(k) * (1.0 + M(ageing) * M(time) + M(hardening) * fabs(M(x)));
    double friction = M(dry) * tanh(M(v) / 1e-4);
    double moved = M(x) + M(bend) * M(x) * M(x);

    M(der_x) = M(v);
    M(der_v) = (force - stiffness * M(x) - M(c) * M(v) - friction) / M(m);
    M(der_shown) = M(slow) > 0.0 ? (moved - M(shown)) / M(slow) : 0.0;
    M(y) = M(slow) > 0.0 ? M(shown) : moved;
    return fmi2OK;
}
