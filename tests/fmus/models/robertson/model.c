#include "model.h"

int model_equations(Model *m)
{
    const double first = M(k1) * M(A), second = M(k2) * M(B) * M(B), third = M(k3) * M(B) * M(C);
    M(der_A) = third - first;
    M(der_B) = first - third - second;
    M(der_C) = second;
    M(y1) = M(A);
    M(y2) = M(B);
    M(y3) = M(C);
    return OK;
}

double model_partial(Model *m, unsigned unknown, unsigned known)
{
    const double first = known == V_A ? M(k1) : known == V_k1 ? M(A) : 0.0;
    const double second = known == V_B ? 2.0 * M(k2) * M(B) : known == V_k2 ? M(B) * M(B) : 0.0;
    const double third = known == V_B ? M(k3) * M(C) : known == V_C ? M(k3) * M(B)
                         : known == V_k3 ? M(B) * M(C) : 0.0;
    switch (unknown) {
    case V_der_A: return third - first;
    case V_der_B: return first - third - second;
    case V_der_C: return second;
    case V_y1: return known == V_A;
    case V_y2: return known == V_B;
    case V_y3: return known == V_C;
    default: return 0.0;
    }
}
