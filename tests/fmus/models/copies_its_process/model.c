#define _POSIX_C_SOURCE 200112L
#include <unistd.h>

#include "decay.h"

void model_start(Model *m)
{
    (void)m;
    if (fork() < 0)
        return;
}
