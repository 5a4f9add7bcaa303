#include "decay.h"

#include <signal.h>

void model_start(Model *m)
{
    if (M(k) > 2.5)
        raise(SIGSEGV);
}
