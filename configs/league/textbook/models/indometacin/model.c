/* The drug also goes from the blood into the tissue and back. */
#include "fmi2_model.h"

static const double HOUR = 3600.0;

fmi2Status model_equations(Model *m)
{
    const double into_tissue = M(k12) * M(C) - M(k21) * M(C2);

    M(der_C) = (-M(k) * M(C) - into_tissue) / HOUR;
    M(der_C2) = into_tissue / HOUR;
    M(conc) = M(C);
    return fmi2OK;
}
