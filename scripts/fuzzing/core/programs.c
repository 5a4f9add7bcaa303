/* A fuzzer of byte code: refused with a sentence, or evaluated by every machine to the same bits.
 *
 * The first byte says whether the rest are the bytes of a program as they come, or a tape that a
 * sound one is made of. What is taken is evaluated, simulated with an FMU whose values are from the
 * tape, and applied to an output.
 */
#include <math.h>
#include <string.h>

#include "machines.h"
#include "stub.h"

enum { MOST_GIVEN = 4096, TIMES = 3 };

/* Machines give the same where no piece reads what it has not written: equal bits, or both are not
 * a number, whose bits are not promised. */
static void compare_machines(Tape *tape, const Program *p, int is_sound) {
    const size_t n_results = p->first_constant - p->first_effective + p->n_sites;
    double *const given = new_numbers(p->first_effective, tape);
    double *const fast = new_numbers(n_results, NULL), *const plain = new_numbers(n_results, NULL);
    evaluate(p, FAST, given, fast);
    evaluate(p, PLAIN, given, plain);
    for (size_t j = 0; is_sound && j < n_results; j++)
        if (memcmp(&fast[j], &plain[j], sizeof *fast) != 0 && !(isnan(fast[j]) && isnan(plain[j])))
            found("machines that differ");
}

/* A simulation of the FMU that the program is for. */
static void simulate(Tape *tape, const Program *p) {
    static const double times[TIMES] = {0.0, 0.5, 0.75}, intervals[TIMES] = {0.5, 0.25};
    static const uint8_t jumps[TIMES] = {0, 1, 0}, passed[TIMES] = {0};
    static const uint32_t output = 0;
    const size_t x = p->n_states, u = p->n_inputs;
    Instance instance;
    const int64_t method = (int64_t)below(tape, 3);
    const size_t n_states = method == CO_SIMULATION ? 0 : x - p->n_own;
    const Fmu fmu = stub_fmu(tape, &instance, 2, n_states, below(tape, 2));
    double *const atols = new_numbers(x, NULL), point = 1.0, at[1];
    int64_t progress[4] = {0}, codes[1], indices[1], steps[1];
    double *const outputs = new_numbers(TIMES, NULL);
    for (size_t j = 0; j < x; j++) atols[j] = 1e-6;
    const Variables inputs = {new_array(u, sizeof(uint32_t)), NULL, u, 0};
    const Experiment e = {
        .stop = times[TIMES - 1], .inputs = inputs, .continuous_inputs = inputs,
        .outputs = {&output, NULL, 1, 0}, .times = times, .intervals = intervals,
        .values = new_numbers(TIMES * u, tape), .slopes = new_numbers(TIMES * u, tape),
        .jumps = jumps, .passed = passed, .n_times = TIMES, .n_inputs = u, .n_outputs = 1};
    const Settings s = {
        ONE_OF(tape, 0.0, 0.1), 1e-6, 1e-6, atols, 8, 0.0, 0.0, (int64_t)ONE_OF(tape, 0.0, 50.0)};
    const Effects effects = {p, new_array(p->n_parameters, sizeof(uint32_t)),
                             new_numbers(1, tape), new_numbers(p->n_coefficients, tape),
                             new_numbers(p->n_base, tape)};
    const Batch b = {.fmu = &fmu, .experiment = &e, .settings = &s, .effects = &effects,
                     .method = method, .n_points = 1, .n_states = x, .points = &point,
                     .progress = progress, .outputs = outputs, .codes = codes,
                     .indices = indices, .steps = steps, .stopped_at = at};
    if (core_simulate(&b) != 1) found("a wrong number of points");
    const int fits = n_states + p->n_own == x;
    if ((codes[0] == WRONG_SIZES) != !fits) found("a wrong end");
}

static void apply(Tape *tape, const Program *p) {
    static const double times[TIMES] = {0.0, 0.5, 0.75};
    if (p->n_inputs < 1) return;
    const size_t n_outputs = p->n_inputs > 1 ? 1 + below(tape, 2) : 1;
    const size_t u = p->n_inputs - n_outputs;
    const Record r = {times, new_numbers(TIMES * u, tape), new_numbers(TIMES * u, tape), TIMES, u,
                      n_outputs, below(tape, n_outputs), p, new_numbers(p->n_coefficients, tape),
                      ONE_OF(tape, 1.0, 50.0, NAN, INFINITY, 0.0), ONE_OF(tape, 0.0, 1.0, 1e-3),
                      new_numbers(TIMES * n_outputs, tape), NULL, 1};
    core_apply_to_outputs(&r);
}

static const void *made(Tape *tape, size_t *size) {
    const int for_outputs = (int)below(tape, 2);
    Counts c = {.own = (uint32_t)below(tape, 3), .inputs = (uint32_t)below(tape, 4),
                .coefficients = (uint32_t)below(tape, 4)};
    c.states = c.own + (for_outputs ? 0 : (uint32_t)below(tape, 4));
    c.changes_inputs = for_outputs || below(tape, 2);
    if (for_outputs)
        c.parameters = 1;
    else if (c.changes_inputs)
        c.base = c.parameters = (uint32_t)below(tape, 3);
    return make_program(tape, &c, size);
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n) {
    if (n == 0) return 0;
    Tape tape = {bytes + 1, n - 1, 0};
    const char *wrong = NULL;
    const void *code = bytes + 1;
    size_t size = n - 1;
    if (bytes[0] % 2) code = made(&tape, &size);
    Program *const p = core_program(code, size, &wrong);
    if (p == NULL && (wrong == NULL || bytes[0] % 2)) found("a program that is refused");
    if (p != NULL && p->first_effective <= MOST_GIVEN && p->n_registers <= MOST_GIVEN) {
        compare_machines(&tape, p, bytes[0] % 2);
        simulate(&tape, p);
        apply(&tape, p);
    }
    core_program_free(p);
    free_arrays();
    return 0;
}
