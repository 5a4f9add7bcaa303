/* One compartment, which the dose reaches at once. */
#include "fmi2_model.h"

static const double HOUR = 3600.0;

fmi2Status model_equations(Model *m)
{
    if (!(M(V) > 0.0))
        return model_error(m, "the volume must be positive, got %g", M(V));

    M(der_A) = -M(k) * M(A) / HOUR;
    M(conc) = M(A) / M(V);
    return fmi2OK;
}
