/* A decay that gives up after a second where its rate is large. */
#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    if (M(rate) > 2.0 && M(time) > 1.0)
        return model_error(m, "rate %g is too much after a second", M(rate));

    M(der_x) = M(u) - M(rate) * M(x);
    M(y) = M(x);
    return fmi2OK;
}
