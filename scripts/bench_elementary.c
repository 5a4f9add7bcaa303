/* Times of the core's elementary functions and of the C library's, for scripts/bench_elementary.py.
 *
 *     bench NAME core|libm ROUNDS
 *
 * evaluates 32,768 arguments a round and prints ns a call, the least of all rounds: of calls that
 * follow each other freely, and of calls that wait for the result of the one before. */
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "elementary.h"

#define COUNT 32768

static double core_pow(double x) { return ce_pow(x, 1.7); }
static double libm_pow(double x) { return pow(x, 1.7); }
static double nothing(double x) { return x; }

static const struct {
    const char *name;
    double (*functions[2])(double);
    double low, high;
} cases[] = {
    {"exp", {ce_exp, exp}, -20.0, 20.0},     {"log", {ce_log, log}, 0.0, 1e3},
    {"sin", {ce_sin, sin}, -100.0, 100.0},   {"cos", {ce_cos, cos}, -100.0, 100.0},
    {"tan", {ce_tan, tan}, -100.0, 100.0},   {"tanh", {ce_tanh, tanh}, -5.0, 5.0},
    {"atan", {ce_atan, atan}, -10.0, 10.0},  {"expm1", {ce_expm1, expm1}, -5.0, 5.0},
    {"pow", {core_pow, libm_pow}, 0.0, 50.0}, {"nothing", {nothing, nothing}, 0.0, 1.0}};

static double seconds(void)
{
    struct timespec now;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

int main(int count, char **arguments)
{
    static double x[COUNT];
    double sum = 0.0, free_calls = INFINITY, waiting_calls = INFINITY;
    size_t which = 0;
    if (count != 4) return 1;
    while (strcmp(cases[which].name, arguments[1])) {
        if (++which == sizeof cases / sizeof *cases) return 1;
    }
    double (*const function)(double) = cases[which].functions[!strcmp(arguments[2], "libm")];
    uint64_t seed = which + 1;
    for (int i = 0; i < COUNT; i++) {
        seed = seed * 6364136223846793005u + 1442695040888963407u;
        const double part = (double)(seed >> 11) / 9007199254740992.0;
        x[i] = cases[which].low + (cases[which].high - cases[which].low) * part;
    }
    for (int round = atoi(arguments[3]); round > 0; round--) {
        const double begin = seconds();
        for (int i = 0; i < COUNT; i++) sum += function(x[i]);
        const double middle = seconds();
        double last = 0.0;
        for (int i = 0; i < COUNT; i++) last = function(x[i] + 0.0 * last);
        free_calls = fmin(free_calls, middle - begin);
        waiting_calls = fmin(waiting_calls, seconds() - middle);
        sum += last;
    }
    printf("%.2f %.2f%s\n", free_calls * 1e9 / COUNT, waiting_calls * 1e9 / COUNT,
           sum == 0.5 ? " " : "");
    return 0;
}
