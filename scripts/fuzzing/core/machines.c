/* The fast machine of the core, and a plain one that it must have the bits of. */
#include "machines.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "elementary.h"

/* One instruction after the other. */
static void run_plain(const Instruction *i, double *r) {
    for (; i->operation != END; i++) {
        const double a = r[i->a], b = r[i->b];
        switch (i->operation) {
#define VALUE(name, value) \
    case name: r[i->to] = value; break;
            OPERATIONS(VALUE, VALUE)
        default: /* CHOOSE */
            if (a != 0.0) r[i->to] = b;
        }
    }
}

void evaluate(const Program *p, int machine, const double *given, double *results) {
    static const int pieces[] = {ONCE, BEFORE, AFTER};
    const size_t n_before = p->first_constant - p->first_effective;
    double *const r = calloc(p->n_registers + 1, sizeof *r);
    if (r == NULL) abort();
    memcpy(r, given, p->first_effective * sizeof *r);
    memcpy(r + p->first_constant, p->constants, p->n_constants * sizeof *r);
    for (size_t j = 0; j < sizeof pieces / sizeof *pieces; j++) {
        if (machine == PLAIN)
            run_plain(p->code[pieces[j]], r);
        else
            run_fast(p->fast[pieces[j]], r);
    }
    memcpy(results, r + p->first_effective, n_before * sizeof *r);
    for (uint32_t s = 0; s < p->n_sites; s++) results[n_before + s] = r[p->sites[s].r];
    free(r);
}
