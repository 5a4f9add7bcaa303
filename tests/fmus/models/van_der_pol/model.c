#include "model.h"

int model_equations(Model *m)
{
    M(der_x0) = M(x1);
    M(der_x1) = M(mu) * (1.0 - M(x0) * M(x0)) * M(x1) - M(x0) + M(u);
    M(y) = M(x0);
    return OK;
}

double model_partial(Model *m, unsigned unknown, unsigned known)
{
    if (unknown == V_y)
        return known == V_x0;
    if (unknown == V_der_x0)
        return known == V_x1;
    if (unknown != V_der_x1)
        return 0.0;
    switch (known) {
    case V_x0: return -2.0 * M(mu) * M(x0) * M(x1) - 1.0;
    case V_x1: return M(mu) * (1.0 - M(x0) * M(x0));
    case V_mu: return (1.0 - M(x0) * M(x0)) * M(x1);
    case V_u: return 1.0;
    default: return 0.0;
    }
}
