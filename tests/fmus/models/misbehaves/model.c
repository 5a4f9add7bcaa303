#define _GNU_SOURCE
#include <fcntl.h>
#include <fenv.h>
#include <locale.h>
#include <pthread.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <sys/time.h>
#include <unistd.h>
#include <xmmintrin.h>

#include "model.h"

static volatile int sink;
static long calls;
static double kept;
static volatile int *volatile nowhere;

/* Between 0 and 1, the same for the same rate, and as good as independent of it. */
static double chance(double rate)
{
    uint64_t bits;
    memcpy(&bits, &rate, sizeof bits);
    bits = (bits ^ (bits >> 30)) * 0xbf58476d1ce4e5b9u;
    bits = (bits ^ (bits >> 27)) * 0x94d049bb133111ebu;
    return (double)((bits ^ (bits >> 31)) >> 11) / 9007199254740992.0;
}

static int endless(int depth)
{
    volatile char frame[4096];
    frame[0] = (char)depth;
    return depth < 0 ? 0 : endless(depth + 1) + frame[0];
}

static void *busy(void *unused)
{
    for (;;)
        sink++;
    return unused;
}

static void at_most(int resource, rlim_t limit)
{
    struct rlimit both = {limit, limit};
    setrlimit(resource, &both);
}

/* What is done at a point that is hit, each time. */
static int do_at_a_point(int kind, double *rate_of_change)
{
    char *volatile memory;
    switch (kind) {
    case 1: *rate_of_change = NAN; break;
    case 2: *rate_of_change = INFINITY; break;
    case 3: return DISCARD;
    case 4: return ERROR;
    case 5: return FATAL;
    case 6: return (int)(calls % 5);
    case 7: busy(NULL); break;
    case 8: for (;;) pause();
    case 9: exit(0);
    case 10: _exit(0);
    case 11: abort();
    case 12: *nowhere = 1; break;
    case 13: sink = endless(0); break;
    case 15:
        memory = malloc(64);
        memset(memory - 32, 0x41, 64 + 4096);
        break;
    case 24:
        for (int file = 3; file < 1024; file++)
            close(file);
        break;
    case 33: kill(getppid(), SIGTERM); break;
    case 34: raise(SIGSTOP); break;
    case 37: raise(SIGKILL); break;
    case 39: kill(0, SIGTERM); break;
    case 40: usleep(300000); break;
    case 41: *rate_of_change *= 1e300; break;
    case 43: fesetround(FE_DOWNWARD); break;
    }
    return OK;
}

/* What is done once in a process. */
static void do_once(int kind, bool hit)
{
    static bool done;
    static char block[1 << 16];
    pthread_t thread;
    FILE *file;
    if (done || ((kind == 25 || kind == 26) && !hit))
        return;
    done = true;
    switch (kind) {
    case 16: setlocale(LC_ALL, "de_DE.UTF-8"); setlocale(LC_NUMERIC, "de_DE.UTF-8"); break;
    case 19: feenableexcept(FE_DIVBYZERO | FE_INVALID | FE_OVERFLOW); break;
    case 20: sink = chdir("/"); break;
    case 21:
        for (int number = 1; number < 32; number++)
            if (number != SIGKILL && number != SIGSTOP && number != SIGCHLD)
                signal(number, SIG_IGN);
        break;
    case 22: umask(0777); break;
    case 23: close(0); close(1); close(2); break;
    case 25:
        if (fork() == 0)
            for (;;)
                pause();
        break;
    case 26: sink = fork(); break;
    case 27:
        memset(block, 'x', sizeof block);
        for (int i = 0; i < 1024; i++)
            fwrite(block, 1, sizeof block, stdout);
        fflush(stdout);
        break;
    case 28:
        for (int i = 0; i < 2; i++)
            pthread_create(&thread, NULL, busy, NULL);
        break;
    case 35: at_most(RLIMIT_CPU, 1); break;
    case 36: at_most(RLIMIT_NOFILE, 4); break;
    case 38: alarm(1); break;
    case 42:
        file = fopen("/proc/self/comm", "w");
        if (file) {
            fputs("evil) R 1 1", file);
            fclose(file);
        }
        break;
    }
}

/* What is done in each call, at any point. */
static void do_always(int kind, double time, double *rate_of_change)
{
    struct timeval now;
    char *memory;
    switch (kind) {
    case 14:
        memory = malloc(10 << 20);
        if (memory)
            memset(memory, 1, 10 << 20);
        break;
    case 17: fesetround(FE_UPWARD); break;
    case 18: _mm_setcsr(_mm_getcsr() | 0x8040); break; /* denormals are zeros */
    case 29: *rate_of_change += calls > 2000 ? 0.5 : 0.0; break;
    case 30: *rate_of_change += 1e-3 * ((double)rand() / RAND_MAX - 0.5); break;
    case 31:
        *rate_of_change += kept;
        kept += time > 1.9 ? 0.001 : 0.0;
        break;
    case 32: *rate_of_change *= 1.0 + 1e-9 * (double)calls; break;
    case 44: *rate_of_change += time > 0.5 ? (double)(getpid() % 1009) * 1e-4 : 0.0; break;
    case 45:
        gettimeofday(&now, NULL);
        *rate_of_change += (double)(now.tv_sec % 10) * 1e-3;
        break;
    }
}

int model_equations(Model *m)
{
    const int kind = (int)M(kind);
    const bool hit = M(time) > 0.5 && chance(M(rate)) < M(share);
    int answer = OK;
    calls++;
    M(der_x) = -M(rate) * M(x);
    M(y) = M(x);
    if (kind > 0) {
        do_once(kind, hit);
        do_always(kind, M(time), &M(der_x));
        if (hit)
            answer = do_at_a_point(kind, &M(der_x));
        if (hit && kind == 42)
            for (;;)
                pause();
    }
    return answer;
}
