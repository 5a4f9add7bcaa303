/* A decay that takes its process with it where its rate is large. */
#include <stdlib.h>

#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    if (M(rate) > 2.0 && M(time) > 1.0)
        abort();

    M(der_x) = M(u) - M(rate) * M(x);
    M(y) = M(x);
    return fmi2OK;
}
