#include "decay.h"

double model_partial(Model *m, unsigned unknown, unsigned known)
{
    if (unknown == V_y)
        return 2.0 * (known == V_x);
    if (unknown != V_der_x)
        return 0.0;
    switch (known) {
    case V_x: return -2.0 * M(k);
    case V_k: return -2.0 * M(x);
    case V_u: return 2.0;
    default: return 0.0;
    }
}
