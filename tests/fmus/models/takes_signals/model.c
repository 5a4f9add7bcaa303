#include <signal.h>

#include "decay.h"

int model_accept(Model *m)
{
    (void)m;
    signal(SIGTERM, SIG_IGN);
    return OK;
}

void model_start(Model *m)
{
    (void)m;
    signal(SIGINT, SIG_IGN);
}
