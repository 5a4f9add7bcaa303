/* The functions of FMI 2.0 and 3.0 under the standard's names, by address.
 *
 * Each returns the standard's status. Where the versions differ, that of the instance is called
 * with what it takes; `fmi` is a constant in loops that are compiled for one version.
 */
#ifndef FMU_H
#define FMU_H
#include <math.h>

#include "compiler.h"
#include "core.h"

/* From DISCARD on a call brought no result; from ERROR on the instance must be reset. */
enum { OK, WARNING, DISCARD, ERROR, FATAL, PENDING };

/* Call, and return the status if it failed: the standard forbids to call anything after a
 * failure. */
#define TRY(call)                                         \
    do {                                                  \
        const int status_ = (call);                       \
        if (UNLIKELY(status_ >= DISCARD)) return status_; \
    } while (0)

/* Types of functions: of the handle alone, of a time, a vector, values and so on. */
typedef int OfHandle(void *);
typedef int OfTime(void *, double);
typedef int GetVector(void *, double *, size_t);
typedef int SetVector(void *, const double *, size_t);
typedef int GetValues2(void *, const uint32_t *, size_t, void *);
typedef int SetValues2(void *, const uint32_t *, size_t, const void *);
typedef int GetValues3(void *, const uint32_t *, size_t, void *, size_t);
typedef int SetValues3(void *, const uint32_t *, size_t, const void *, size_t);
typedef int SetUp(void *, int, double, double, int, double);
typedef int SetUp3(void *, uint8_t, double, double, uint8_t, double);
typedef int DoStep2(void *, double, double, int);
typedef int DoStep3(void *, double, double, uint8_t, uint8_t *, uint8_t *, uint8_t *, double *);
typedef int InputSlopes(void *, const uint32_t *, size_t, const int32_t *, const double *);
typedef int Directional2(void *, const uint32_t *, size_t, const uint32_t *, size_t, const double *,
                         double *);
typedef int Directional3(void *, const uint32_t *, size_t, const uint32_t *, size_t, const double *,
                         size_t, double *, size_t);
typedef int Completed2(void *, int, int *, int *);
typedef int Completed3(void *, uint8_t, uint8_t *, uint8_t *);
typedef int Update2(void *, void *);
typedef int Update3(void *, uint8_t *, uint8_t *, uint8_t *, uint8_t *, uint8_t *, double *);

/* fmi2EventInfo, and behind it what else FMUs say of events. */
typedef struct {
    int32_t update_needed, terminate, nominals_changed, values_changed, next_defined;
    double next_time;
    int32_t event_needed, ended;
} EventInfo;

ALWAYS int call(Function function, void *handle) { return ((OfHandle *)function)(handle); }

ALWAYS int set_reals(const Fmu *f, int fmi, const uint32_t *references, size_t n,
                     const double *values) {
    if (fmi == 2) return ((SetValues2 *)f->set[0])(f->handle, references, n, values);
    return ((SetValues3 *)f->set[0])(f->handle, references, n, values, n);
}

ALWAYS int get_reals(const Fmu *f, int fmi, const uint32_t *references, size_t n, double *values) {
    if (fmi == 2) return ((GetValues2 *)f->get[0])(f->handle, references, n, values);
    return ((GetValues3 *)f->get[0])(f->handle, references, n, values, n);
}

ALWAYS int set_time(const Fmu *f, double time) { return ((OfTime *)f->set_time)(f->handle, time); }

ALWAYS int set_continuous_states(const Fmu *f, const double *x, size_t n) {
    return ((SetVector *)f->set_continuous_states)(f->handle, x, n);
}

ALWAYS int get_vector(Function function, void *handle, double *to, size_t n) {
    return ((GetVector *)function)(handle, to, n);
}

ALWAYS int do_step(const Fmu *f, int fmi, double time, double h, EventInfo *info) {
    if (fmi == 2) return ((DoStep2 *)f->do_step)(f->handle, time, h, 1);
    uint8_t event = 0, terminate = 0, early = 0;
    const int status = ((DoStep3 *)f->do_step)(f->handle, time, h, 1, &event, &terminate, &early,
                                               &info->next_time);
    info->ended = terminate;
    return status;
}

ALWAYS int set_input_slopes(const Fmu *f, const uint32_t *references, size_t n,
                            const int32_t *orders, const double *slopes) {
    return ((InputSlopes *)f->set_real_input_derivatives)(f->handle, references, n, orders, slopes);
}

ALWAYS int completed_integrator_step(const Fmu *f, int fmi, EventInfo *info) {
    if (fmi == 2)
        return ((Completed2 *)f->completed_integrator_step)(f->handle, 1, &info->event_needed,
                                                            &info->ended);
    uint8_t needed = 0, ended = 0;
    const int status =
        ((Completed3 *)f->completed_integrator_step)(f->handle, 1, &needed, &ended);
    info->event_needed = needed, info->ended = ended;
    return status;
}

/* fmi2NewDiscreteStates in FMI 2.0. */
static inline int update_discrete_states(const Fmu *f, EventInfo *info) {
    if (f->version == 2) return ((Update2 *)f->update_discrete_states)(f->handle, info);
    uint8_t b[5] = {0};
    const int status = ((Update3 *)f->update_discrete_states)(
        f->handle, &b[0], &b[1], &b[2], &b[3], &b[4], &info->next_time);
    info->update_needed = b[0], info->terminate = b[1], info->nominals_changed = b[2];
    info->values_changed = b[3], info->next_defined = b[4];
    return status;
}

/* The derivative of the unknowns along `seed`, a direction in the knowns: float64 scalars. */
static inline int get_directional_derivative(const Fmu *f, const uint32_t *unknowns,
                                             size_t n_unknowns, const uint32_t *knowns,
                                             size_t n_knowns, const double *seed, double *to) {
    if (f->version == 2)
        return ((Directional2 *)f->get_directional_derivative)(f->handle, unknowns, n_unknowns,
                                                               knowns, n_knowns, seed, to);
    return ((Directional3 *)f->get_directional_derivative)(
        f->handle, unknowns, n_unknowns, knowns, n_knowns, seed, n_knowns, to, n_unknowns);
}

/* Tolerance (0: none), start, and the stop time for those that want one: fmi2SetupExperiment, or
 * what FMI 3.0 is told when it enters initialisation. */
static inline int set_up(const Fmu *f, Function function, double tolerance, double start,
                         double stop) {
    const double unit = f->stop_unit;
    if (unit > 0.0) stop = start + unit * fmax(1.0, ceil((stop - start) / unit));
    if (unit < 0.0) stop = 0.0;
    if (f->version == 2)
        return ((SetUp *)function)(f->handle, tolerance > 0.0, tolerance, start, unit >= 0.0, stop);
    return ((SetUp3 *)function)(f->handle, tolerance > 0.0, tolerance, start, unit >= 0.0, stop);
}

#endif
