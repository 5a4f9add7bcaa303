#include <stdlib.h>
#include <string.h>

#include "decay.h"

/* Where the last block is, so that no compiler leaves it out. */
static void *volatile taken;

static void leak(void)
{
    const size_t megabyte = 1048576;
    taken = malloc(megabyte);
    if (taken != NULL)
        memset(taken, 1, megabyte);
}

void model_reset(Model *m, const Values *before)
{
    (void)m, (void)before;
    leak();
}
