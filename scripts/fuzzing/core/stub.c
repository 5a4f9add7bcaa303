#include "stub.h"

#include <string.h>

#include "fmu.h"

Stub stub;
static volatile double sink;

/* ---- statuses ---------------------------------------------------------------------------- */

static int status_now(void) {
    if (stub.calls == stub.fail_at) return stub.fail_with;
    if (!stub.any_status) return OK;
    const uint8_t b = next_byte(stub.tape);
    switch (b) {
    case 255: return DISCARD;
    case 254: return ERROR;
    case 253: return FATAL;
    case 252: return PENDING;
    case 251: return -1;
    case 250: return 77;
    default: return b % 16 == 0 ? WARNING : OK;
    }
}

static int answer(void *handle) {
    Instance *const instance = handle;
    if (instance->failure) found("a call after a failure");
    if (stub.calls > stub.most_calls) found("calls without end");
    const int status = status_now();
    stub.calls++;
    if (status >= ERROR) instance->failure = status == ERROR ? ERROR : FATAL;
    if (status > stub.worst) stub.worst = status;
    return status;
}

static int of_handle(void *c) { return answer(c); }

static int reset(void *c) {
    Instance *const instance = c;
    if (instance->failure == ERROR) instance->failure = 0;
    return answer(c);
}

/* ---- values ------------------------------------------------------------------------------ */

static void read_all(const void *values, size_t n_bytes) {
    const uint8_t *bytes = values;
    for (size_t j = 0; j < n_bytes; j++) sink += bytes[j];
}

static void read_references(const uint32_t *r, size_t n) { read_all(r, n * sizeof *r); }

static void write_numbers(double *to, size_t n) {
    for (size_t j = 0; j < n; j++) to[j] = next_number(stub.tape);
}

static void write_bytes(void *to, size_t n) {
    uint8_t *bytes = to;
    for (size_t j = 0; j < n; j++) bytes[j] = next_byte(stub.tape);
}

static int of_time(void *c, double time) { return sink += time, answer(c); }
static int get_vector_(void *c, double *x, size_t n) { return write_numbers(x, n), answer(c); }
static int set_vector(void *c, const double *x, size_t n) {
    return read_all(x, n * sizeof *x), answer(c);
}

/* Of variables whose elements have `width` bytes; those of float64 are numbers. */
#define VALUES(width)                                                                            \
    static int get2_##width(void *c, const uint32_t *r, size_t n, void *to) {                    \
        read_references(r, n);                                                                   \
        if (width == 8)                                                                          \
            write_numbers(to, n);                                                                \
        else                                                                                     \
            write_bytes(to, n * width);                                                          \
        return answer(c);                                                                        \
    }                                                                                            \
    static int get3_##width(void *c, const uint32_t *r, size_t n, void *to, size_t n_values) {   \
        read_references(r, n);                                                                   \
        if (width == 8)                                                                          \
            write_numbers(to, n_values);                                                         \
        else                                                                                     \
            write_bytes(to, n_values * width);                                                   \
        return answer(c);                                                                        \
    }                                                                                            \
    static int set2_##width(void *c, const uint32_t *r, size_t n, const void *from) {            \
        return read_references(r, n), read_all(from, n * width), answer(c);                      \
    }                                                                                            \
    static int set3_##width(void *c, const uint32_t *r, size_t n, const void *from,              \
                            size_t n_values) {                                                   \
        return read_references(r, n), read_all(from, n_values * width), answer(c);               \
    }
VALUES(1) VALUES(2) VALUES(4) VALUES(8)

static int strings2(void *c, const uint32_t *r, size_t n, const void *from) {
    const char *const *texts = from;
    read_references(r, n);
    for (size_t j = 0; j < n; j++) read_all(texts[j], strlen(texts[j]) + 1);
    return answer(c);
}
static int strings3(void *c, const uint32_t *r, size_t n, const void *from, size_t n_values) {
    (void)n_values;
    return strings2(c, r, n, from);
}

static int directional2(void *c, const uint32_t *u, size_t n, const uint32_t *k, size_t n_k,
                        const double *seed, double *to) {
    read_references(u, n), read_references(k, n_k), read_all(seed, n_k * sizeof *seed);
    return write_numbers(to, n), answer(c);
}
static int directional3(void *c, const uint32_t *u, size_t n, const uint32_t *k, size_t n_k,
                        const double *seed, size_t n_seed, double *to, size_t n_to) {
    read_references(u, n), read_references(k, n_k), read_all(seed, n_seed * sizeof *seed);
    return write_numbers(to, n_to), answer(c);
}

/* ---- modes, steps and events ------------------------------------------------------------- */

static int set_up2(void *c, int has, double tolerance, double start, int stops, double stop) {
    return sink += has + tolerance + start + stops + stop, answer(c);
}
static int set_up3(void *c, uint8_t has, double tolerance, double start, uint8_t stops,
                   double stop) {
    return sink += has + tolerance + start + stops + stop, answer(c);
}

/* Mostly no; in one of eight tapes or so, an FMU that always says so. */
static int rarely(void) { return next_byte(stub.tape) > 230; }

static int update2(void *c, void *to) {
    EventInfo *info = to;
    info->update_needed = rarely(), info->terminate = rarely() && rarely();
    info->nominals_changed = rarely(), info->values_changed = rarely();
    info->next_defined = rarely(), info->next_time = next_number(stub.tape);
    return answer(c);
}
static int update3(void *c, uint8_t *update, uint8_t *terminate, uint8_t *nominals, uint8_t *values,
                   uint8_t *defined, double *time) {
    *update = (uint8_t)rarely(), *terminate = (uint8_t)(rarely() && rarely());
    *nominals = (uint8_t)rarely(), *values = (uint8_t)rarely(), *defined = (uint8_t)rarely();
    *time = next_number(stub.tape);
    return answer(c);
}
static int completed2(void *c, int no_set, int *event, int *ends) {
    (void)no_set;
    *event = rarely(), *ends = rarely() && rarely();
    return answer(c);
}
static int completed3(void *c, uint8_t no_set, uint8_t *event, uint8_t *ends) {
    (void)no_set;
    *event = (uint8_t)rarely(), *ends = (uint8_t)(rarely() && rarely());
    return answer(c);
}
static int do_step2(void *c, double time, double h, int no_set) {
    return sink += time + h + no_set, answer(c);
}
static int do_step3(void *c, double time, double h, uint8_t no_set, uint8_t *event, uint8_t *ends,
                    uint8_t *early, double *last) {
    sink += time + h + no_set;
    *event = (uint8_t)rarely(), *ends = (uint8_t)rarely(), *early = (uint8_t)rarely();
    *last = next_number(stub.tape);
    return answer(c);
}
static int slopes(void *c, const uint32_t *r, size_t n, const int32_t *orders,
                  const double *values) {
    read_references(r, n), read_all(orders, n * sizeof *orders);
    return read_all(values, n * sizeof *values), answer(c);
}

/* ---- the FMU ----------------------------------------------------------------------------- */

static void choose_failure(Tape *tape) {
    static const int statuses[] = {DISCARD, ERROR, FATAL, PENDING, 77};
    const uint8_t how = next_byte(tape);
    stub = (Stub){.tape = tape, .fail_at = -1, .most_calls = 50000000};
    if (how < 100) return;
    if (how < 150) {
        stub.any_status = 1;
    } else {
        stub.fail_at = next_byte(tape) + (how < 170 ? 256 * next_byte(tape) : 0);
        stub.fail_with = statuses[below(tape, sizeof statuses / sizeof *statuses)];
    }
}

#define AT(function) ((Function)(function))
#define BY_VERSION(name) (version == 2 ? AT(name##2) : AT(name##3))
#define BY_WIDTH(name) {AT(name##_1), AT(name##_2), AT(name##_4), AT(name##_8)}

Fmu stub_fmu(Tape *tape, Instance *instance, int version, size_t n_states, size_t n_indicators) {
    static const Function get[2][4] = {BY_WIDTH(get2), BY_WIDTH(get3)};
    static const Function set[2][4] = {BY_WIDTH(set2), BY_WIDTH(set3)};
    static const uint8_t log_width[2][N_TYPES] = {{3, 2, 0, 0, 1, 1, 2, 2, 3, 3, 2},
                                                  {3, 2, 0, 0, 1, 1, 2, 2, 3, 3, 0}};
    const uint8_t flags = next_byte(tape);
    choose_failure(tape);
    *instance = (Instance){0};
    Fmu f = {
        .handle = instance, .reset = AT(reset), .setup_experiment = AT(set_up2),
        .enter_configuration_mode = AT(of_handle), .exit_configuration_mode = AT(of_handle),
        .enter_initialization_mode = version == 2 ? AT(of_handle) : AT(set_up3),
        .exit_initialization_mode = AT(of_handle), .set_string = BY_VERSION(strings),
        .set_time = AT(of_time),
        .set_continuous_states = AT(set_vector), .get_continuous_states = AT(get_vector_),
        .get_nominals = AT(get_vector_), .get_derivatives = AT(get_vector_),
        .get_event_indicators = AT(get_vector_), .enter_event_mode = AT(of_handle),
        .update_discrete_states = BY_VERSION(update),
        .enter_continuous_time_mode = AT(of_handle),
        .completed_integrator_step = BY_VERSION(completed), .do_step = BY_VERSION(do_step),
        .set_real_input_derivatives = version == 2 ? AT(slopes) : NULL,
        .get_directional_derivative = BY_VERSION(directional),
        .stop_unit = ONE_OF(tape, -1.0, 0.0, 0.3), .n_states = n_states,
        .n_indicators = n_indicators, .version = version,
        .interpolates_inputs = version == 2 && (flags & 1), .completes_steps = flags >> 1 & 1,
        .eventful = flags >> 2 & 1,
    };
    for (int type = 0; type < N_TYPES; type++) {
        const int width = log_width[version - 2][type];
        f.get[type] = get[version - 2][width], f.set[type] = set[version - 2][width];
    }
    return f;
}
