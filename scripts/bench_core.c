/* One simulation of mass_spring_damper, by the core or by a loop for this model alone, for
 * callgrind.
 *
 *     bench_core LIBRARY GUID WHAT [PROGRAM]
 *
 * WHAT: co, rk4, dp, cvode with "-tight" for the loop by hand, "-bound" for a bound that is never
 * reached, "-half" for two steps an interval, "-hook" for the effect of PROGRAM as a compiled
 * function. Counted is `measured`, which runs twice: two simulations. CVODE is taken from the
 * libraries whose paths are in SUNDIALS, with a space between two.
 */
#include <dlfcn.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "elementary.h"
#include "fmu.h"
#include "program.h"

enum { COUNT = 1001, X = 2 };
static double times[COUNT], intervals[COUNT], force[COUNT], slopes[COUNT], outputs[COUNT];
static double measured_values[COUNT], sigmas[COUNT];
static int64_t gather[COUNT], row_ends[COUNT], progress[4];
static uint8_t jumps[COUNT], passed[COUNT];
static const double point[] = {1.0, 25.0, 0.8}, atols[] = {1e-8, 1e-8}, large[] = {1e9};
static const double rtol = 1e-6, rates[] = {0.0};
static const uint32_t starts[] = {1, 2, 3}, input[] = {4}, output[] = {9};
static Fmu fmu;

/* ---- loops by hand: two states, one input, one output -------------------------------------- */

typedef struct {
    void *c;
    SetValues2 *set;
    GetValues2 *get;
    OfTime *set_time;
    SetVector *set_x;
    GetVector *get_dx;
} Exchange;

static int initialise(double start) {
    int worst = call(fmu.reset, fmu.handle);
    worst |= ((SetUp *)fmu.setup_experiment)(fmu.handle, 0, 0.0, start, 0, 0.0);
    worst |= set_reals(&fmu, 2, starts, 3, point);
    worst |= call(fmu.enter_initialization_mode, fmu.handle);
    worst |= set_reals(&fmu, 2, input, 1, force);
    return worst | call(fmu.exit_initialization_mode, fmu.handle);
}

static int start(double *x) {
    EventInfo info = {0};
    int worst = initialise(times[0]);
    worst |= update_discrete_states(&fmu, &info);
    worst |= call(fmu.enter_continuous_time_mode, fmu.handle);
    return worst | get_vector(fmu.get_continuous_states, fmu.handle, x, X);
}

static int tight_co(void) {
    void *const c = fmu.handle;
    SetValues2 *const set = (SetValues2 *)fmu.set[0];
    GetValues2 *const get = (GetValues2 *)fmu.get[0];
    InputSlopes *const tell = (InputSlopes *)fmu.set_real_input_derivatives;
    DoStep2 *const step = (DoStep2 *)fmu.do_step;
    const int order = 1;
    int worst = initialise(times[0]);
    for (int i = 0; worst < 2; i++) {
        worst |= set(c, input, 1, &force[i]);
        worst |= get(c, output, 1, &outputs[i]);
        if (i + 1 == COUNT) break;
        worst |= tell(c, input, 1, &order, &slopes[i]);
        worst |= step(c, times[i], times[i + 1] - times[i], 1);
    }
    return worst;
}

ALWAYS int go_to(const Exchange *e, double t, const double *x, double u) {
    return e->set_time(e->c, t) | e->set_x(e->c, x, X) | e->set(e->c, input, 1, &u);
}

ALWAYS Exchange exchange(const Fmu *f) {
    return (Exchange){f->handle, (SetValues2 *)f->set[0], (GetValues2 *)f->get[0],
                      (OfTime *)f->set_time, (SetVector *)f->set_continuous_states,
                      (GetVector *)f->get_derivatives};
}

__attribute__((noinline)) static int tight_rk4(const Fmu *f, const double *t, const double *u,
                                               const double *du, double *y) {
    const Exchange copy = exchange(f), *const e = &copy;
    double x[X], trial[X], k[4][X];
    int worst = start(x);
    for (int i = 0; worst < 2; i++) {
        worst |= go_to(e, t[i], x, u[i]) | e->get(e->c, output, 1, &y[i]);
        if (i + 1 == COUNT) break;
        const double h = t[i + 1] - t[i], half = 0.5 * h, sixth = h / 6.0;
        const double middle = u[i] + half * du[i], at = t[i] + half;
        worst |= e->get_dx(e->c, k[0], X);
        for (int j = 0; j < X; j++) trial[j] = x[j] + half * k[0][j];
        worst |= go_to(e, at, trial, middle) | e->get_dx(e->c, k[1], X);
        for (int j = 0; j < X; j++) trial[j] = x[j] + half * k[1][j];
        worst |= go_to(e, at, trial, middle) | e->get_dx(e->c, k[2], X);
        for (int j = 0; j < X; j++) trial[j] = x[j] + h * k[2][j];
        worst |= go_to(e, t[i + 1], trial, u[i + 1]) | e->get_dx(e->c, k[3], X);
        for (int j = 0; j < X; j++)
            x[j] += sixth * (k[0][j] + 2.0 * k[1][j] + 2.0 * k[2][j] + k[3][j]);
    }
    return worst;
}

static const double node[] = {0, 1 / 5.0, 3 / 10.0, 4 / 5.0, 8 / 9.0, 1, 1};
static const double weight[7][6] = {
    {0},
    {1 / 5.0},
    {3 / 40.0, 9 / 40.0},
    {44 / 45.0, -56 / 15.0, 32 / 9.0},
    {19372 / 6561.0, -25360 / 2187.0, 64448 / 6561.0, -212 / 729.0},
    {9017 / 3168.0, -355 / 33.0, 46732 / 5247.0, 49 / 176.0, -5103 / 18656.0},
    {35 / 384.0, 0, 500 / 1113.0, 125 / 192.0, -2187 / 6784.0, 11 / 84.0}};
static const double error_weight[] = {71 / 57600.0,      0,          -71 / 16695.0, 71 / 1920.0,
                                      -17253 / 339200.0, 22 / 525.0, -1 / 40.0};

static int tight_dp(void) {
    const Exchange copy = exchange(&fmu), *const e = &copy;
    double x[X], trial[X], k[7][X], proposed = 1e-4;
    int worst = start(x);
    for (int i = 0; worst < 2; i++) {
        worst |= go_to(e, times[i], x, force[i]) | e->get(e->c, output, 1, &outputs[i]);
        if (i + 1 == COUNT) break;
        worst |= e->get_dx(e->c, k[0], X);
        for (double time = times[i]; time < times[i + 1];) {
            const double remaining = times[i + 1] - time;
            const int final = proposed >= remaining * (1.0 - 1e-10);
            const double h = final ? remaining : fmin(proposed, 0.5 * remaining);
#define TERM(earlier) weight[stage][earlier] * k[earlier][j]
#define STAGE(number, sum)                                                                        \
    {                                                                                             \
        enum { stage = number };                                                                  \
        const double at = time + node[stage] * h;                                                 \
        for (int j = 0; j < X; j++) trial[j] = x[j] + h * (sum);                                  \
        worst |= go_to(e, at, trial, force[i] + (at - times[i]) * slopes[i])                      \
                 | e->get_dx(e->c, k[stage], X);                                                  \
    }
            STAGE(1, TERM(0))
            STAGE(2, TERM(0) + TERM(1))
            STAGE(3, TERM(0) + TERM(1) + TERM(2))
            STAGE(4, TERM(0) + TERM(1) + TERM(2) + TERM(3))
            STAGE(5, TERM(0) + TERM(1) + TERM(2) + TERM(3) + TERM(4))
            STAGE(6, TERM(0) + TERM(2) + TERM(3) + TERM(4) + TERM(5))
            double total = 0.0;
            for (int j = 0; j < X; j++) {
                const double estimate = error_weight[0] * k[0][j] + error_weight[2] * k[2][j]
                                        + error_weight[3] * k[3][j] + error_weight[4] * k[4][j]
                                        + error_weight[5] * k[5][j] + error_weight[6] * k[6][j];
                const double one = fabs(x[j]), other = fabs(trial[j]);
                const double part = h * estimate / (atols[j] + rtol * (one > other ? one : other));
                total += part * part;
            }
            const double error = sqrt(total / X);
            const double wanted = 0.9 * ce_pow(error, -0.2);
            const double next = h * (wanted > 5.0 ? 5.0 : wanted < 0.2 ? 0.2 : wanted);
            if (worst >= 2) break;
            if (!(error <= 1.0)) {
                proposed = next;
                continue;
            }
            for (int j = 0; j < X; j++) x[j] = trial[j], k[0][j] = k[6][j];
            time = final ? times[i + 1] : time + h;
            proposed = final && proposed > next ? proposed : next;
        }
    }
    return worst;
}

/* ---- CVODE ---------------------------------------------------------------------------------- */

typedef int RightHandSide(double, void *, void *, void *);
static void *sundials[8];
static struct {
    void *memory, *vector, *work_vector;
    double y[X], z[X];
    int (*reinit)(void *, double, void *), (*stop)(void *, double);
    int (*integrate)(void *, double, void *, double *, int);
    double *(*values)(void *);
    size_t interval;
} cv;

static void *of_sundials(const char *name) {
    for (int j = 0; j < 8 && sundials[j] != NULL; j++) {
        void *found = dlsym(sundials[j], name);
        if (found != NULL) return found;
    }
    fprintf(stderr, "no %s in SUNDIALS\n", name);
    exit(1);
}

static int tight_rhs(double time, void *y, void *dy, void *data) {
    const double u = force[cv.interval] + (time - times[cv.interval]) * slopes[cv.interval];
    void *const c = fmu.handle;
    (void)data;
    return ((OfTime *)fmu.set_time)(c, time)
           | ((SetVector *)fmu.set_continuous_states)(c, cv.values(y), X)
           | ((SetValues2 *)fmu.set[0])(c, input, 1, &u)
           | ((GetVector *)fmu.get_derivatives)(c, cv.values(dy), X);
}

static int tight_cvode(void) {
    const Exchange copy = {fmu.handle, (SetValues2 *)fmu.set[0], (GetValues2 *)fmu.get[0],
                           (OfTime *)fmu.set_time, (SetVector *)fmu.set_continuous_states,
                           (GetVector *)fmu.get_derivatives}, *const e = &copy;
    double time = times[0];
    int worst = start(cv.y);
    cv.reinit(cv.memory, time, cv.vector);
    for (int i = 0; worst < 2; i++) {
        worst |= e->set_time(e->c, times[i]) | e->set_x(e->c, cv.y, X)
                 | e->set(e->c, input, 1, &force[i]) | e->get(e->c, output, 1, &outputs[i]);
        if (i + 1 == COUNT) break;
        cv.interval = (size_t)i;
        cv.stop(cv.memory, times[i + 1]);
        while (time < times[i + 1])
            if (cv.integrate(cv.memory, times[i + 1], cv.vector, &time, 2) < 0) return 3;
    }
    return worst;
}

static void open_cvode(RightHandSide *right_hand_side, Cvode *of_core) {
    char paths[4096], *rest = paths;
    snprintf(paths, sizeof paths, "%s", getenv("SUNDIALS") ? getenv("SUNDIALS") : "");
    for (int j = 0; j < 7; j++) {
        char *path = strtok(j ? NULL : rest, " ");
        if (path != NULL) sundials[j] = dlopen(path, RTLD_NOW | RTLD_GLOBAL);
    }
#define TAKE(type, name) ((type)(uintptr_t)of_sundials(name))
    void *context, *matrix, *solver;
    TAKE(int (*)(int, void **), "SUNContext_Create")(0, &context);
    void *(*const make)(int64_t, double *, void *) =
        TAKE(void *(*)(int64_t, double *, void *), "N_VMake_Serial");
    cv.vector = make(X, cv.y, context), cv.work_vector = make(X, cv.z, context);
    matrix = TAKE(void *(*)(int64_t, int64_t, void *), "SUNDenseMatrix")(X, X, context);
    solver = TAKE(void *(*)(void *, void *, void *), "SUNLinSol_Dense")(cv.vector, matrix, context);
    cv.memory = TAKE(void *(*)(int, void *), "CVodeCreate")(2, context);
    TAKE(int (*)(void *, RightHandSide *, double, void *), "CVodeInit")(cv.memory, right_hand_side,
                                                                        0.0, cv.vector);
    TAKE(int (*)(void *, void *, void *), "CVodeSetLinearSolver")(cv.memory, solver, matrix);
    memcpy(cv.z, atols, sizeof atols);
    TAKE(int (*)(void *, double, void *), "CVodeSVtolerances")(cv.memory, rtol, cv.work_vector);
    cv.reinit = TAKE(int (*)(void *, double, void *), "CVodeReInit");
    cv.stop = TAKE(int (*)(void *, double), "CVodeSetStopTime");
    cv.integrate = TAKE(int (*)(void *, double, void *, double *, int), "CVode");
    cv.values = TAKE(double *(*)(void *), "N_VGetArrayPointer");
#define CORE_TAKES(member, name) of_core->member = TAKE(Function, name)
    CORE_TAKES(reinit, "CVodeReInit");
    CORE_TAKES(set_tolerances, "CVodeSVtolerances");
    CORE_TAKES(set_jacobian, "CVodeSetJacFn");
    CORE_TAKES(set_user_data, "CVodeSetUserData");
    CORE_TAKES(set_max_step, "CVodeSetMaxStep");
    CORE_TAKES(set_stop_time, "CVodeSetStopTime");
    CORE_TAKES(integrate, "CVode");
    CORE_TAKES(interpolate, "CVodeGetDky");
    CORE_TAKES(vector_data, "N_VGetArrayPointer");
    CORE_TAKES(matrix_data, "SUNDenseMatrix_Data");
    of_core->memory = cv.memory, of_core->state_vector = cv.vector;
    of_core->work_vector = cv.work_vector, of_core->y = cv.y, of_core->z = cv.z;
}

/* ---- the effect as a compiled function: 20 operations of which one is tanh ------------------ */

static uint16_t first_coefficient, site;

static double hook(const Step *i, double *r, double a) {
    const double x = r[1], v = r[2], *k = r + first_coefficient;
    const double level = k[0] + k[1] * fabs(v) + k[2] * v * v + k[3] * x * x;
    (void)i;
    r[site] = -level * ce_tanh(v / k[6]) - k[4] * v * fabs(v) + k[5] * x * x * x;
    return a;
}

/* ---- what is measured ---------------------------------------------------------------------- */

static const char *what;
static Batch batch;
static int64_t codes[1], indices[1], steps[1];
static double stopped_at[1];

__attribute__((noinline)) void measured(void) {
    int code;
    if (strstr(what, "-tight"))
        code = strstr(what, "cvode") ? tight_cvode()
               : strstr(what, "co")  ? tight_co()
               : strstr(what, "rk4") ? tight_rk4(&fmu, times, force, slopes, outputs)
                                     : tight_dp();
    else
        code = core_simulate(&batch) == 1 ? (int)codes[0] : -1;
    if (code != 0) fprintf(stderr, "%s: code %d\n", what, code), exit(1);
}

static void *of_library(void *library, const char *name) {
    void *found = dlsym(library, name);
    if (found == NULL) fprintf(stderr, "no %s\n", name), exit(1);
    return found;
}

static void say_nothing(void *e, const char *n, int s, const char *c, const char *m, ...) {
    (void)e, (void)n, (void)s, (void)c, (void)m;
}

static void open_fmu(const char *path, const char *guid, int co) {
    static const struct {
        void (*logger)(void *, const char *, int, const char *, const char *, ...);
        void *(*allocate)(size_t, size_t);
        void (*release)(void *);
        void *finished, *environment;
    } callbacks = {say_nothing, calloc, free, NULL, NULL};
    void *library = dlopen(path, RTLD_NOW);
    if (library == NULL) fprintf(stderr, "%s\n", dlerror()), exit(1);
#define BIND(member, name) fmu.member = (Function)(uintptr_t)of_library(library, "fmi2" name)
    BIND(reset, "Reset");
    BIND(setup_experiment, "SetupExperiment");
    BIND(enter_initialization_mode, "EnterInitializationMode");
    BIND(exit_initialization_mode, "ExitInitializationMode");
    BIND(set_time, "SetTime");
    BIND(set_continuous_states, "SetContinuousStates");
    BIND(get_continuous_states, "GetContinuousStates");
    BIND(get_derivatives, "GetDerivatives");
    BIND(update_discrete_states, "NewDiscreteStates");
    BIND(enter_continuous_time_mode, "EnterContinuousTimeMode");
    BIND(do_step, "DoStep");
    BIND(set_real_input_derivatives, "SetRealInputDerivatives");
    BIND(get[0], "GetReal");
    BIND(set[0], "SetReal");
    void *(*instantiate)(const char *, int, const char *, const char *, const void *, int, int) =
        (void *(*)(const char *, int, const char *, const char *, const void *, int, int))(
            uintptr_t)of_library(library, "fmi2Instantiate");
    fmu.handle = instantiate("bench", co, guid, "", &callbacks, 0, 0);
    fmu.version = 2, fmu.interpolates_inputs = 1, fmu.stop_unit = -1.0;
    fmu.n_states = co ? 0 : X;
    if (fmu.handle == NULL) fprintf(stderr, "no instance\n"), exit(1);
}

static Program *read_program(const char *path) {
    static char bytes[1 << 16];
    FILE *file = fopen(path, "rb");
    const char *wrong = "no file";
    const size_t n = file ? fread(bytes, 1, sizeof bytes, file) : 0;
    Program *program = core_program(bytes, n, &wrong);
    if (program == NULL) fprintf(stderr, "%s: %s\n", path, wrong), exit(1);
    return program;
}

int main(int n, char **given) {
    const double coefficients[] = {0.5, 0.05, 0.04, 0.03, 0.02, 0.7, 0.01};
    uint64_t seed = 1;
    what = given[3];
    const int co = strstr(what, "co") == what;
    open_fmu(given[1], given[2], co);
    for (int i = 0; i < COUNT; i++) {
        seed = seed * 6364136223846793005u + 1442695040888963407u;
        times[i] = 0.005 * i, sigmas[i] = 1.0, gather[i] = i, row_ends[i] = i + 1;
        force[i] = (double)(seed >> 11) / (double)(1ull << 53) * 4.0 - 2.0;
    }
    for (int i = 0; i + 1 < COUNT; i++) {
        intervals[i] = times[i + 1] - times[i];
        slopes[i] = (force[i + 1] - force[i]) / intervals[i];
    }
    const Experiment experiment = {
        .stop = times[COUNT - 1], .numbers = {starts, NULL, 3, 0}, .inputs = {input, NULL, 1, 0},
        .continuous_inputs = {input, NULL, 1, 0}, .outputs = {output, NULL, 1, 0}, .times = times,
        .intervals = intervals, .values = force, .slopes = slopes, .jumps = jumps,
        .passed = passed, .n_times = COUNT, .n_inputs = 1, .n_outputs = 1, .gather = gather, .by_time = gather,
        .row_ends = row_ends, .measured = measured_values, .sigmas = sigmas};
    const Settings settings = {.step = strstr(what, "-half") ? 0.0025 : 0.0, .rtol = rtol,
                               .atol = 1e-8, .atols = atols, .max_steps = 100000};
    Effects effects = {.fastest_rates = rates, .coefficients = coefficients};
    if (n > 4) {
        Program *program = read_program(given[4]);
        static Step compiled;
        effects.program = program;
        first_coefficient = (uint16_t)program->first_coefficient, site = program->sites[0].r;
        compiled.action = hook;
        if (strstr(what, "-hook")) program->fast[AFTER] = &compiled;
    }
    static Cvode cvode;
    if (strstr(what, "cvode"))
        open_cvode(strstr(what, "-tight") ? tight_rhs : core_right_hand_side, &cvode);
    batch = (Batch){.fmu = &fmu, .experiment = &experiment, .settings = &settings,
                    .effects = &effects,
                    .method = co                     ? CO_SIMULATION
                              : strstr(what, "cvode") ? CVODE
                              : strstr(what, "rk4")   ? RUNGE_KUTTA
                                                      : DORMAND_PRINCE,
                    .n_points = 1, .n_values = 3, .n_states = co ? 0 : X, .largest_array = 1,
                    .points = point, .bounds = strstr(what, "-bound") ? large : NULL,
                    .progress = progress, .outputs = outputs, .codes = codes, .indices = indices,
                    .steps = steps, .stopped_at = stopped_at, .cvode = &cvode};
    measured();
    measured();
    printf("%.17g\n", outputs[COUNT / 2]);
    return 0;
}
