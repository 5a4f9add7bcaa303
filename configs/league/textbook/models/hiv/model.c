/* Before the treatment as much virus is produced as is cleared. Cells infected by then go on. */
#include <math.h>

#include "fmi2_model.h"

static const double DAY = 86400.0;

fmi2Status model_equations(Model *m)
{
    M(der_VI) = -M(c) * M(VI) / DAY;
    M(der_Q) = M(delta) * (M(VI) - M(Q)) / DAY;
    M(der_VN) = M(c) * (M(Q) - M(VN)) / DAY;
    M(lgV) = log10(M(VI) + M(VN));
    return fmi2OK;
}
