#include <float.h>

#include "model.h"

int model_equations(Model *m)
{
    M(der_h) = M(stopped) ? 0.0 : M(v);
    M(der_v) = M(stopped) ? 0.0 : -M(g);
    M(above_floor) = M(h);
    M(height) = M(h);
    M(velocity) = M(v);
    return OK;
}

void model_event(Model *m, Event *event)
{
    if (M(h) > 0.0 || M(v) >= 0.0 || M(stopped))
        return;
    M(h) = DBL_MIN; /* just above the floor, so that this is no second event */
    M(v) = -M(e) * M(v);
    M(bounces)++;
    if (M(v) < M(v_min)) {
        M(stopped) = true;
        M(v) = 0.0;
    }
    event->states_changed = true;
}
