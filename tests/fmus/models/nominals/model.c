#include "model.h"

int model_equations(Model *m)
{
    M(der_x) = M(rate) * M(x);
    M(under_limit) = 1.0 - M(x) / (10.0 * M(nominal));
    M(y) = M(x);
    return OK;
}

double model_nominal(Model *m, size_t state) { (void)state; return M(nominal); }

void model_event(Model *m, Event *event)
{
    if (M(under_limit) > 0.0)
        return;
    M(nominal) *= 10.0;
    event->nominals_changed = true;
}
