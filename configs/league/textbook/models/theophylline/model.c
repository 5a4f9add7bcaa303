/* The dose lies in the gut, from which the blood absorbs it. */
#include "fmi2_model.h"

static const double HOUR = 3600.0;

fmi2Status model_equations(Model *m)
{
    if (!(M(V) > 0.0))
        return model_error(m, "the volume must be positive, got %g", M(V));

    const double absorbed = M(ka) * M(G);

    M(der_G) = -absorbed / HOUR;
    M(der_A) = (absorbed - M(k) * M(A)) / HOUR;
    M(conc) = M(A) / M(V);
    return fmi2OK;
}
