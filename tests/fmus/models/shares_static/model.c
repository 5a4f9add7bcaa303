#include "model.h"

/* Written until the end of an initialisation, read ever after: alone, nobody notices. */
static double rate;

int model_equations(Model *m)
{
    if (m->state.phase & (INSTANTIATED | INITIALIZATION))
        rate = M(k);
    M(der_x) = M(u) - rate * M(x);
    M(y) = M(x);
    return OK;
}

void model_start(Model *m) { rate = M(k); }
