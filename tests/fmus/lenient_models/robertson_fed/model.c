/* a -> b, b + b -> c + b and b + c -> a + c, whose rates span nine orders of magnitude. */
#include "fmi2_model.h"

fmi2Status model_equations(Model *m)
{
    double first = M(k1) * M(a);
    double second = M(k2) * M(b) * M(b);
    double third = M(k3) * M(b) * M(c);
    M(der_a) = M(feed) - M(drain) * M(a) - first + third;
    M(der_b) = first - second - third - M(drain) * M(b);
    M(der_c) = second - M(drain) * M(c);
    M(y_a) = M(a);
    M(y_b) = M(b);
    return fmi2OK;
}
