/* A fuzzer of what the core does with FMUs that misbehave: any status, any value, at any call.
 *
 * The tape says what is asked (a method, a grid, effects, linearisations ...) and then is the FMU.
 * Whatever it does, there must be an end, a code, a time and an index, and no call after a failure.
 */
#include <math.h>
#include <string.h>

#include "integrator.h"
#include "program.h"
#include "stub.h"

enum { CASE_SIMULATE, CASE_STIFF, CASE_LINEARISE, CASE_FILTER, CASE_SENSITIVITIES, CASE_KNOWN };
enum { MOST_INSTANCES = 8 };

/* What is asked, and memory for it. */
typedef struct {
    Tape *tape;
    int what;
    Fmu fmu;
    Experiment experiment;
    Settings settings;
    Effects effects, offsets;
    Batch batch;
    Instance instances[MOST_INSTANCES];
} Asked;

static uint32_t *references(Tape *tape, size_t n) {
    uint32_t *const r = new_array(n, sizeof *r);
    for (size_t j = 0; j < n; j++) r[j] = next_byte(tape);
    return r;
}

/* ---- variables --------------------------------------------------------------------------- */

/* Variables of n columns: float64 scalars, then others, which may be arrays with fixed elements
 * behind the first. */
static Variables variables(Asked *a, size_t n, int reals_only) {
    enum { MOST_ELEMENTS = 16 };
    static const int64_t types2[] = {0, 6, 10};
    Tape *const tape = a->tape;
    const size_t n_reals = reals_only ? n : below(tape, n + 1);
    Element *const elements = new_array(n_reals < n ? MOST_ELEMENTS : 0, sizeof *elements);
    size_t count = 0;
    for (size_t column = n_reals; column < n && count + 3 <= MOST_ELEMENTS;) {
        const int fmi2 = a->fmu.version == 2;
        const int64_t type = fmi2 ? types2[below(tape, 3)] : (int64_t)below(tape, N_TYPES);
        const size_t size = fmi2 ? 1 : 1 + below(tape, 3);
        for (size_t e = 0; e < size; e++) {
            const int fixed = column >= n || (e > 0 && below(tape, 2));
            const double value = next_number(tape);
            Element element = {type, next_byte(tape), (int64_t)size, -1, 0};
            if (fixed)
                memcpy(&element.bits, &value, sizeof value);
            else
                element.column = (int64_t)column++;
            elements[count++] = element;
        }
    }
    Element *const exact = new_array(count, sizeof *exact);
    if (count > 0) memcpy(exact, elements, count * sizeof *exact);
    return (Variables){references(tape, n_reals), exact, n_reals, count};
}

/* ---- the experiment ---------------------------------------------------------------------- */

static void choose_grid(Asked *a) {
    Tape *const tape = a->tape;
    Experiment *const e = &a->experiment;
    const size_t n = e->n_times = 1 + below(tape, 6), u = e->n_inputs;
    double *const times = new_numbers(n, NULL), *const intervals = new_numbers(n, NULL);
    double *const values = new_numbers(n * u, tape), *const slopes = new_numbers(n * u, NULL);
    uint8_t *const jumps = new_array(n, 1), *const passed = new_array(n, 1);
    times[0] = ONE_OF(tape, 0.0, -5.0, 1e6, 3.0);
    for (size_t i = 0; i + 1 < n; i++) {
        times[i + 1] = times[i] + ONE_OF(tape, 0.1, 1.0, 1e-6, 1e3, 0.3);
        intervals[i] = times[i + 1] - times[i];
        for (size_t j = 0; j < u; j++) {
            const double change = values[(i + 1) * u + j] - values[i * u + j];
            if (next_byte(tape) % 2)
                slopes[i * u + j] = change / intervals[i];
            else if (change != 0.0)
                jumps[i + 1] = 1;
        }
    }
    e->times = times, e->intervals = intervals, e->values = values, e->slopes = slopes;
    for (size_t i = 1; i + 1 < n; i++) passed[i] = !jumps[i] && next_byte(tape) % 2;
    e->jumps = jumps, e->passed = passed, e->stop = times[n - 1];
}

/* A sum of squares above which a simulation may end. */
static void choose_bounds(Asked *a) {
    Experiment *const e = &a->experiment;
    int64_t *const gather = new_array(e->n_times, 8), *const by_time = new_array(e->n_times, 8);
    int64_t *const row_ends = new_array(e->n_times, 8);
    for (size_t i = 0; i < e->n_times; i++) {
        gather[i] = (int64_t)(i * e->n_outputs + below(a->tape, e->n_outputs));
        by_time[i] = (int64_t)i, row_ends[i] = (int64_t)i + 1;
    }
    e->gather = gather, e->by_time = by_time, e->row_ends = row_ends;
    e->measured = new_numbers(e->n_times, a->tape), e->sigmas = new_numbers(e->n_times, a->tape);
    a->batch.bounds = new_numbers(a->batch.n_points, a->tape);
}

static void choose_experiment(Asked *a) {
    static const char *const texts[] = {"one", ""};
    Tape *const tape = a->tape;
    Experiment *const e = &a->experiment;
    Batch *const b = &a->batch;
    const int reals_only = below(tape, 3) > 0;
    e->n_inputs = below(tape, 3), e->n_outputs = 1 + below(tape, 3);
    b->n_values = 1 + below(tape, 4);
    e->numbers = variables(a, b->n_values, reals_only);
    e->inputs = variables(a, e->n_inputs, reals_only);
    e->outputs = variables(a, e->n_outputs, reals_only);
    e->continuous_inputs = e->inputs;
    if (next_byte(tape) % 4 == 0) { /* some change at events alone */
        e->continuous_inputs.n_elements = 0;
        e->continuous_inputs.n_reals = below(tape, e->inputs.n_reals + 1);
    }
    if (a->fmu.version == 3 && next_byte(tape) % 4 == 0)
        e->structure = variables(a, b->n_values, 0);
    if (next_byte(tape) % 4 == 0)
        e->strings = references(tape, 2), e->texts = texts, e->n_strings = 2;
    choose_grid(a);
}

static void choose_settings(Asked *a) {
    Tape *const tape = a->tape;
    Settings *const s = &a->settings;
    s->step = ONE_OF(tape, 0.0, 0.05, 1.0, 1e-9, 0.3);
    s->rtol = ONE_OF(tape, 1e-6, 1e-3, 1e-12, 0.1), s->atol = ONE_OF(tape, 1e-6, 1e-300, 1.0);
    s->max_steps = 1 + (int64_t)below(tape, 12);
    s->fmu_tolerance = ONE_OF(tape, 0.0, 1e-6);
    if (a->batch.method == CO_SIMULATION && below(tape, 4) == 0) s->fixed = s->step = 0.1;
    double *const atols = new_numbers(a->batch.n_states, NULL);
    for (size_t j = 0; j < a->batch.n_states; j++) atols[j] = s->atol;
    s->atols = atols;
}

/* ---- effects ----------------------------------------------------------------------------- */

static Program *loaded(Tape *tape, const Counts *counts) {
    size_t size;
    const char *wrong;
    const void *const bytes = make_program(tape, counts, &size);
    Program *const program = core_program(bytes, size, &wrong);
    if (program == NULL) found(wrong);
    return program;
}

/* Effects at all, and the same numbers of others with an offset at each input behind them. */
static void choose_effects(Asked *a, size_t own) {
    Tape *const tape = a->tape;
    const size_t n_points = a->batch.n_points;
    Counts counts = {.states = (uint32_t)(a->fmu.n_states + own), .own = (uint32_t)own,
                     .inputs = (uint32_t)a->experiment.n_inputs,
                     .coefficients = (uint32_t)below(tape, 4),
                     .changes_inputs = (uint32_t)below(tape, 2)};
    if (counts.changes_inputs) counts.parameters = counts.base = (uint32_t)below(tape, 3);
    a->effects.parameters = references(tape, counts.parameters);
    a->effects.fastest_rates = new_numbers(n_points, tape);
    a->effects.coefficients = new_numbers(n_points * counts.coefficients, tape);
    a->effects.base = new_numbers(n_points * counts.base, tape);
    a->effects.program = loaded(tape, &counts);
    counts.coefficients += counts.inputs, counts.changes_inputs = 1;
    a->offsets = a->effects;
    a->offsets.coefficients = new_numbers(n_points * counts.coefficients, tape);
    if (a->what == CASE_LINEARISE || a->what == CASE_FILTER)
        a->offsets.program = loaded(tape, &counts);
}

/* CVODE, or another method where it is not there; perhaps with a Jacobian by the FMU. */
static void choose_cvode(Asked *a) {
    Cvode *const c = new_cvode(a->batch.n_states);
    const int directional = (int)below(a->tape, 2);
    a->batch.cvode = c;
    if (c == NULL)
        a->batch.method = DORMAND_PRINCE;
    else if (directional)
        c->jacobian_states = c->jacobian_derivatives = references(a->tape, a->batch.n_states);
}

/* ---- what is asked ----------------------------------------------------------------------- */

static void choose_batch(Asked *a) {
    Tape *const tape = a->tape;
    Batch *const b = &a->batch;
    a->what = (int)below(tape, 8);
    if (a->what > CASE_KNOWN) a->what = CASE_SIMULATE;
    const int version = 2 + (int)below(tape, 2);
    const size_t n_states = below(tape, 6), n_indicators = below(tape, 4);
    const size_t method = next_byte(tape);
    b->method = (int64_t)(method % 3);
    if (b->method == CO_SIMULATION && a->what != CASE_SIMULATE) b->method = DORMAND_PRINCE;
    const int asks_cvode = a->what == CASE_SIMULATE && method / 3 % 4 == 0;
    if (asks_cvode) b->method = CVODE;
    const int exchange = b->method != CO_SIMULATION;
    a->fmu = stub_fmu(tape, a->instances, version, exchange ? n_states : 0,
                      exchange ? n_indicators : 0);
    b->n_points = a->what == CASE_SIMULATE ? 1 + below(tape, 2) : 1;
    choose_experiment(a);
    const int effects = a->what <= CASE_FILTER && below(tape, 2);
    const size_t own = effects ? below(tape, 3) : 0;
    b->n_states = a->fmu.n_states + own;
    choose_settings(a);
    if (effects) choose_effects(a, own);
    if (asks_cvode) choose_cvode(a);
    b->fmu = &a->fmu, b->experiment = &a->experiment, b->settings = &a->settings;
    b->effects = &a->effects, b->largest_array = 3;
    if (a->what == CASE_SIMULATE && next_byte(tape) % 4 == 0) choose_bounds(a);
    b->points = new_numbers(b->n_points * b->n_values, tape);
    b->progress = new_array(4, sizeof *b->progress);
    b->outputs = new_numbers(b->n_points * a->experiment.n_times * a->experiment.n_outputs, NULL);
    b->codes = new_array(b->n_points, sizeof *b->codes);
    b->indices = new_array(b->n_points, sizeof *b->indices);
    b->steps = new_array(b->n_points, sizeof *b->steps);
    b->stopped_at = new_numbers(b->n_points, NULL);
}

static Range range(Tape *tape, size_t n) {
    return (Range){new_numbers(n, tape), new_numbers(n, tape), new_numbers(n, tape), n};
}

static Linearisation linearisation(Asked *a) {
    Tape *const tape = a->tape;
    const Experiment *const e = &a->experiment;
    const size_t x = a->batch.n_states, y = e->n_outputs, t = e->n_times, p = below(tape, 3);
    const size_t u = e->n_inputs > 0 ? 1 + below(tape, e->n_inputs) : 0;
    int64_t *const positions = new_array(p, sizeof *positions);
    Linearisation l = {.stepping = a->batch.method, .offsets = &a->offsets, .n_inputs = u};
    if (a->what == CASE_LINEARISE && below(tape, 4) == 0) l.stepping = CVODE;
    if (a->effects.program != NULL)
        l.first_offset = a->effects.program->n_coefficients;
    l.states = range(tape, x), l.inputs = range(tape, u), l.parameters = range(tape, p);
    l.references = references(tape, p), l.values = new_numbers(p, tape);
    for (size_t j = 0; j < p; j++) positions[j] = -1;
    l.effect_positions = positions;
    l.x = new_numbers(t * x, tape), l.dx = new_numbers(t * x, NULL);
    l.effective = new_numbers(t * u, NULL);
    l.A = new_numbers(t * x * x, NULL), l.B = new_numbers(t * x * u, NULL);
    l.P = new_numbers(t * x * p, NULL), l.C = new_numbers(t * y * x, NULL);
    l.D = new_numbers(t * y * u, NULL), l.Q = new_numbers(t * y * p, NULL);
    return l;
}

static void filter(Asked *a) {
    const Linearisation l = linearisation(a);
    const size_t x = a->batch.n_states, n = a->experiment.n_times * a->experiment.n_outputs;
    const Kalman k = {new_numbers(x, a->tape), new_numbers(n, a->tape), new_numbers(n, a->tape),
                      new_numbers(n, NULL), new_numbers(n, NULL), new_numbers(x * x, a->tape)};
    core_filter(&a->batch, &l, &k);
}

static void sensitivities(Asked *a) {
    Tape *const tape = a->tape;
    const size_t q = below(tape, 3), x = a->fmu.n_states, y = a->experiment.n_outputs;
    int64_t *const kinds = new_array(q, 8), *const positions = new_array(q, 8);
    int64_t *const of_outputs = new_array(y, 8), *const states = new_array(y, 8);
    void **const handles = new_array(2 * q, sizeof *handles);
    size_t others = 0;
    for (size_t j = 0; j < q; j++) {
        kinds[j] = (int64_t)below(tape, 3);
        positions[j] = (int64_t)below(tape, a->batch.n_values);
        for (size_t side = 0; side < 2; side++) handles[2 * j + side] = a->instances + 1 + 2 * j + side;
    }
    for (size_t j = 0; j < y; j++) {
        states[j] = x > 0 && below(tape, 2) ? (int64_t)below(tape, x) : -1;
        if (states[j] < 0) of_outputs[others++] = (int64_t)j;
    }
    const Sensitivities s = {
        q, kinds, positions, references(tape, q), handles, new_numbers(2 * q, tape),
        references(tape, x), references(tape, x), references(tape, others), of_outputs, states,
        others, new_numbers(a->experiment.n_times * q * y, NULL)};
    core_sensitivities(&a->batch, &s);
}

/* Whether the end of point p is one that Python can tell. */
static void check_end(const Asked *a, size_t p, int is_last) {
    const Batch *const b = &a->batch;
    const Experiment *const e = &a->experiment;
    const int64_t code = b->codes[p] % IS_FATAL;
    if (b->codes[p] < 0 || code > OUT_OF_STEPS || code == WRONG_SIZES || code == NO_MEMORY)
        found("a code that is none");
    if (b->codes[p] >= IS_FATAL && stub.worst < 4) found("a fatal end without a fatal status");
    if (a->what == CASE_KNOWN) return; /* which returns a status */
    if (is_last && code == FINISHED && stub.worst >= 3) found("a failure unseen");
    if (a->what == CASE_STIFF) return;
    if (b->indices[p] < 0 || (size_t)b->indices[p] >= e->n_times) found("an index outside");
    /* an event may be later than its time of the grid by what is no time at all, see exchange.h */
    const double at = b->stopped_at[p], resolution = 16.0 * 0x1p-52 * fabs(e->stop);
    if (!(at >= e->times[0] && at <= e->stop + resolution)) found("a time outside");
    if (code == FINISHED && (size_t)b->indices[p] + 1 != e->n_times) found("a wrong index");
}

static void do_asked(Asked *a) {
    Batch *const b = &a->batch;
    size_t tried = 1;
    if (a->what == CASE_SIMULATE) {
        tried = core_simulate(b);
        if (tried < 1 || tried > b->n_points) found("a wrong number of points");
        for (size_t p = 0; p + 1 < tried; p++)
            if (b->codes[p] != FINISHED) found("a point behind a failure");
    } else if (a->what == CASE_STIFF) {
        core_is_stiff(b);
    } else if (a->what == CASE_LINEARISE) {
        const Linearisation l = linearisation(a);
        core_linearise(b, &l);
    } else if (a->what == CASE_FILTER) {
        filter(a);
    } else if (a->what == CASE_SENSITIVITIES) {
        sensitivities(a);
    } else {
        const uint32_t unknowns[2] = {1, 2};
        double derivatives[2];
        core_is_known(b, unknowns, 2, 3, derivatives);
    }
    for (size_t p = 0; p < tried; p++) check_end(a, p, p + 1 == tried);
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n) {
    Tape tape = {bytes, n, 0};
    Asked asked = {.tape = &tape}, *const a = &asked;
    choose_batch(a);
    do_asked(a);
    core_program_free((Program *)a->effects.program);
    if (a->offsets.program != a->effects.program)
        core_program_free((Program *)a->offsets.program);
    free_cvode();
    free_arrays();
    return 0;
}
