/* A decay that remarks on negative rates and gives up where the rate is large. */
#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    if (M(rate) < 0.0)
        model_error(m, "rate %g makes it grow", M(rate)); /* said, but not returned */
    if (M(rate) > 2.0)
        return model_error(m, "rate %g is too much", M(rate));

    M(der_x) = M(u) - M(rate) * M(x);
    M(y) = M(x);
    return fmi2OK;
}
