/* The equations of the models that behave badly: a decay with an input. */
#ifndef DECAY_H
#define DECAY_H

#include "model.h"

int model_equations(Model *m)
{
    M(der_x) = M(u) - M(k) * M(x);
    M(y) = M(x);
    return OK;
}

#endif
