#include "model.h"

int model_equations(Model *m)
{
    if (!isfinite(m->state.stop))
        return error(m, "this model needs a stop time");
    if (M(multiple) > 0.0 && fmod(m->state.stop, M(multiple)) != 0.0)
        return error(m, "the stop time %g is no multiple of %g", m->state.stop, M(multiple));
    M(der_x) = M(u) - M(k) * M(x);
    M(y) = M(x);
    return OK;
}
