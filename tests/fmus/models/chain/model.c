#include "model.h"

/* dx_i/dt = a_(i-1) x_(i-1) - a_i x_i - b_i x_i^2, with u for what the first has before it. */
int model_equations(Model *m)
{
    const double a[5] = {M(a1), M(a2), M(a3), M(a4), M(a5)};
    const double b[5] = {M(b1), M(b2), M(b3), M(b4), M(b5)};
    const double x[5] = {M(x1), M(x2), M(x3), M(x4), M(x5)};
    double *rate[5] = {&M(der_x1), &M(der_x2), &M(der_x3), &M(der_x4), &M(der_x5)};
    for (int i = 0; i < 5; i++)
        *rate[i] = (i ? a[i - 1] * x[i - 1] : M(u)) - a[i] * x[i] - b[i] * x[i] * x[i];
    M(y) = M(a5) * M(x5);
    return OK;
}

double model_partial(Model *m, unsigned unknown, unsigned known)
{
    static const unsigned A[5] = {V_a1, V_a2, V_a3, V_a4, V_a5};
    static const unsigned B[5] = {V_b1, V_b2, V_b3, V_b4, V_b5};
    static const unsigned X[5] = {V_x1, V_x2, V_x3, V_x4, V_x5};
    static const unsigned RATE[5] = {V_der_x1, V_der_x2, V_der_x3, V_der_x4, V_der_x5};
    const double a[5] = {M(a1), M(a2), M(a3), M(a4), M(a5)};
    const double b[5] = {M(b1), M(b2), M(b3), M(b4), M(b5)};
    const double x[5] = {M(x1), M(x2), M(x3), M(x4), M(x5)};
    if (unknown == V_y)
        return known == V_a5 ? x[4] : known == V_x5 ? a[4] : 0.0;
    for (int i = 0; i < 5; i++) {
        if (unknown != RATE[i])
            continue;
        if (known == X[i])
            return -a[i] - 2.0 * b[i] * x[i];
        if (known == A[i])
            return -x[i];
        if (known == B[i])
            return -x[i] * x[i];
        if (i == 0)
            return known == V_u;
        return known == X[i - 1] ? a[i - 1] : known == A[i - 1] ? x[i - 1] : 0.0;
    }
    return 0.0;
}
