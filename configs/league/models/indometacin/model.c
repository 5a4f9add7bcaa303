/* The whole body is one compartment, from which the drug is eliminated. */
#include "fmi2_model.h"

static const double HOUR = 3600.0;

fmi2Status model_equations(Model *m)
{
    M(der_C) = -M(k) * M(C) / HOUR;
    M(conc) = M(C);
    return fmi2OK;
}
