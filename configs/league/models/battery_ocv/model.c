/* A voltage that falls straight with the charge drawn, a resistance and one RC branch. */
#include "fmi2_model.h"

static const double HOUR = 3600.0;

fmi2Status model_equations(Model *m)
{
    if (!(M(tau1) > 0.0))
        return model_error(m, "the time constant must be positive, got %g", M(tau1));

    M(der_q) = M(I) / HOUR;
    M(der_v1) = (M(R1) * M(I) - M(v1)) / M(tau1);
    M(V) = M(E0) - M(s) * M(q) - M(R0) * M(I) - M(v1);
    return fmi2OK;
}
