#include <signal.h>

#include "decay.h"

void model_start(Model *m)
{
    (void)m;
    raise(SIGSEGV);
}
