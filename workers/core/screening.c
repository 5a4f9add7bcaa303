/* Recursions of the screening: one linear system, many right-hand sides at once. */
#include <string.h>

#include "core.h"

void core_run_linear(const double *keep, const double *from_first, const double *from_last,
                     double *forcing, double *scratch, size_t t, size_t x, size_t m) {
    double *now = scratch, *after = scratch + x * m;
    const size_t row = x * m;
    memset(now, 0, row * sizeof *now);
    for (size_t k = 0; k + 1 < t; k++) {
        const double *f = forcing + k * row, *g = f + row;
        memset(after, 0, row * sizeof *after);
        for (size_t i = 0; i < x; i++)
            for (size_t j = 0; j < x; j++) {
                const size_t at = (k * x + i) * x + j;
                const double a = keep[at], b = from_first[at], c = from_last[at];
                for (size_t n = 0; n < m; n++)
                    after[i * m + n] += a * now[j * m + n] + b * f[j * m + n] + c * g[j * m + n];
            }
        memcpy(forcing + k * row, now, row * sizeof *now);
        memcpy(now, after, row * sizeof *now);
    }
    if (t > 0) memcpy(forcing + (t - 1) * row, now, row * sizeof *now);
}

/* The adjoint backwards from 0, in place of the source: with l the adjoint state,
 * l_k = keep_k' l_(k + 1) + source_k, and what a forcing weighs with is
 * from_first_k' l_(k + 1) + from_last_(k - 1)' l_k at time k. */
void core_run_adjoint(const double *keep, const double *from_first, const double *from_last,
                      double *source, double *scratch, size_t t, size_t x, size_t m) {
    double *now = scratch, *after = scratch + x * m;
    const size_t row = x * m;
    if (t == 0) return;
    memcpy(now, source + (t - 1) * row, row * sizeof *now);
    memset(source + (t - 1) * row, 0, row * sizeof *now);
    for (size_t k = t - 1; k-- > 0;) {
        double *s = source + k * row, *next = s + row;
        memcpy(after, s, row * sizeof *after);
        memset(s, 0, row * sizeof *s);
        for (size_t i = 0; i < x; i++)
            for (size_t j = 0; j < x; j++) {
                const size_t at = (k * x + i) * x + j;
                const double a = keep[at], b = from_first[at], c = from_last[at];
                for (size_t n = 0; n < m; n++) {
                    after[j * m + n] += a * now[i * m + n];
                    s[j * m + n] += b * now[i * m + n];
                    next[j * m + n] += c * now[i * m + n];
                }
            }
        memcpy(now, after, row * sizeof *now);
    }
}
