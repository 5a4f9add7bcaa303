/* The virus is cleared from the blood, and nothing produces more of it. */
#include <math.h>

#include "fmi2_model.h"

static const double DAY = 86400.0;

fmi2Status model_equations(Model *m)
{
    M(der_V) = -M(c) * M(V) / DAY;
    M(lgV) = log10(M(V));
    return fmi2OK;
}
