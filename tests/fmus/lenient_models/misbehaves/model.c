/* A decay that misbehaves at some of its rates: at how many of them, and how, parameters say.
   It appends a byte to the file that SIMULATIONS_COUNTED_IN names for each simulation. */
#include <fcntl.h>
#include <signal.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "fmi2_model.h"

enum { CRASHES = 1, ABORTS, EXITS, HANGS, EATS_MEMORY };

/* A number from 0 to 1 that neighbouring rates do not share. */
static double chance(double rate)
{
    uint64_t bits;
    memcpy(&bits, &rate, sizeof bits);
    bits = (bits ^ (bits >> 31)) * 0x7fb5d329728ea185u;
    bits = (bits ^ (bits >> 27)) * 0x81dadef4bc2dd44du;
    return (double)((bits ^ (bits >> 33)) >> 11) / 9007199254740992.0;
}

/* Where the last block is, so that no compiler leaves it out. */
static void *volatile taken;

static void take(double megabytes)
{
    size_t size = (size_t)(megabytes * 1048576.0);
    void *block = size > 0 ? malloc(size) : NULL;
    if (block != NULL)
        memset(block, 1, size);
    taken = block;
}

static void count(void)
{
    const char *name = getenv("SIMULATIONS_COUNTED_IN");
    int file = name != NULL ? open(name, O_WRONLY | O_APPEND | O_CREAT, 0600) : -1;
    if (file >= 0) {
        if (write(file, "x", 1) != 1)
            abort();
        close(file);
    }
}

fmi2Status model_equations(Model *m)
{
    static double before = 1e300;
    if (M(time) == 0.0 && before > 0.0) { /* once a simulation, which begins at 0 */
        count();
        take(M(leak));
    }
    before = M(time);

    if (M(time) > 0.5 && chance(M(rate)) < M(share)) {
        if (M(kind) == CRASHES)
            raise(SIGSEGV);
        if (M(kind) == ABORTS)
            abort();
        if (M(kind) == EXITS)
            exit(3);
        while (M(kind) == HANGS)
            pause();
        while (M(kind) == EATS_MEMORY)
            take(16.0);
    }
    M(der_x) = M(u) - M(rate) * M(x);
    M(y) = M(x);
    return fmi2OK;
}
