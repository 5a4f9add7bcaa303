#include "model.h"

bool model_is_lazy(void) { return true; }

int model_equations(Model *m)
{
    M(above) = M(u) - M(threshold);
    M(y) = M(on) ? 1.0 : 0.0;
    return OK;
}

void model_event(Model *m, Event *event)
{
    (void)event;
    M(on) = M(above) > 0.0;
}
