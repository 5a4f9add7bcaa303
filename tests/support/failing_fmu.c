/* An FMU in memory, of FMI 2.0 and 3.0, that fails at a call of one's choice: x' = u - x, with a
 * state event at x = 0.2, a time event each second, and steps that want to be completed. */
#include <stdint.h>
#include <stddef.h>
#include <string.h>

typedef struct {
    int64_t calls, fail_at, fail_with, completes; /* fail_at < 0: never */
    double t, x, u, k, next;
} State;

static State m;

/* The state, for the test to read and write. */
State *state(void) { return &m; }

static int count(void) { return m.calls++ == m.fail_at ? (int)m.fail_with : 0; }

int just_count(void *c) { return (void)c, count(); }
int set_time(void *c, double t) { return (void)c, m.t = t, count(); }
int set_states(void *c, const double *x, size_t n) { return (void)c, (void)n, m.x = x[0], count(); }
int get_states(void *c, double *x, size_t n) { return (void)c, (void)n, x[0] = m.x, count(); }
int get_derivatives(void *c, double *dx, size_t n) {
    return (void)c, (void)n, dx[0] = m.k * (m.u - m.x), count();
}
int get_indicators(void *c, double *z, size_t n) {
    return (void)c, (void)n, z[0] = m.x - 0.2, count();
}
int reset2(void *c) {
    (void)c;
    m.t = m.x = 0.0, m.next = 1.0;
    return count();
}

static int set(const uint32_t *r, size_t n, const double *v) {
    for (size_t j = 0; j < n; j++) *(r[j] == 0 ? &m.u : &m.k) = v[j];
    return count();
}
static int get(size_t n, double *v) {
    for (size_t j = 0; j < n; j++) v[j] = m.x;
    return count();
}
int set_real2(void *c, const uint32_t *r, size_t n, const double *v) { return (void)c, set(r, n, v); }
int get_real2(void *c, const uint32_t *r, size_t n, double *v) {
    return (void)c, (void)r, get(n, v);
}
int set_real3(void *c, const uint32_t *r, size_t n, const double *v, size_t k) {
    return (void)c, (void)k, set(r, n, v);
}
int get_real3(void *c, const uint32_t *r, size_t n, double *v, size_t k) {
    return (void)c, (void)r, (void)k, get(n, v);
}
int set_up2(void *c, int has, double tol, double t, int stops, double stop) {
    return (void)c, (void)has, (void)tol, (void)stops, (void)stop, m.t = t, count();
}
int set_up3(void *c, uint8_t has, double tol, double t, uint8_t stops, double stop) {
    return (void)c, (void)has, (void)tol, (void)stops, (void)stop, m.t = t, count();
}

static double next_event(void) {
    while (m.next <= m.t + 1e-9) m.next += 1.0;
    return m.next;
}
int update2(void *c, void *info) {
    int32_t flags[5] = {0, 0, 0, 0, 1};
    const double next = next_event();
    (void)c;
    memcpy(info, flags, sizeof flags);
    memcpy((char *)info + 24, &next, sizeof next);
    return count();
}
int update3(void *c, uint8_t *a, uint8_t *b, uint8_t *d, uint8_t *e, uint8_t *f, double *next) {
    (void)c;
    *a = *b = *d = *e = 0, *f = 1, *next = next_event();
    return count();
}
int completed2(void *c, int no_set, int *event, int *ends) {
    return (void)c, (void)no_set, *event = *ends = 0, count();
}
int completed3(void *c, uint8_t no_set, uint8_t *event, uint8_t *ends) {
    return (void)c, (void)no_set, *event = *ends = 0, count();
}

static void advance(double h) {
    for (int j = 0; j < 10; j++) m.x += 0.1 * h * m.k * (m.u - m.x);
}
int do_step2(void *c, double t, double h, int no_set) {
    return (void)c, (void)t, (void)no_set, advance(h), count();
}
int do_step3(void *c, double t, double h, uint8_t no_set, uint8_t *event, uint8_t *ends,
             uint8_t *early, double *last) {
    (void)c, (void)no_set;
    advance(h);
    *event = *ends = *early = 0, *last = t + h;
    return count();
}
