#include "model.h"

int model_equations(Model *m)
{
    M(der_x) = M(u) - M(k) * M(x);
    M(y) = M(c) * M(x);
    return OK;
}

double model_partial(Model *m, unsigned unknown, unsigned known)
{
    if (known == V_k || known == V_c)
        return NAN;
    if (unknown == V_y)
        return known == V_x ? M(c) : 0.0;
    if (unknown != V_der_x)
        return 0.0;
    return known == V_x ? -M(k) : known == V_u;
}
