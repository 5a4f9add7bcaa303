#include "model.h"

int model_equations(Model *m)
{
    M(der_x) = M(u) - M(k) * M(x);
    M(y) = (1.0 + 0.5 * M(spoiled)) * M(x);
    return OK;
}

double model_partial(Model *m, unsigned unknown, unsigned known)
{
    if (unknown == V_y)
        return known == V_x ? 1.0 + 0.5 * M(spoiled) : 0.0;
    if (unknown != V_der_x)
        return 0.0;
    if (known == V_k)
        return -M(x);
    return known == V_x ? -M(k) : known == V_u;
}

void model_reset(Model *m, const Values *before)
{
    (void)before;
    M(spoiled) = 1.0;
}
