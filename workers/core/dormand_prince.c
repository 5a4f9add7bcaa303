/* Dormand-Prince 5(4), adaptive, with a step that ends at every time of the grid, but for those
 * that it may pass over: what is recorded there is interpolated.
 *
 * The default for model exchange. Because no step crosses a kink of an input, the error estimate is
 * right and the tolerance is met; because the last stage of a step is the first of the next, a step
 * costs six derivatives.
 *
 * References: J. R. Dormand, P. J. Prince, J. Comput. Appl. Math. 6 (1980) 19-26,
 * doi:10.1016/0771-050X(80)90013-3. Step control and starting step: E. Hairer, S. P. Norsett, G.
 * Wanner, Solving Ordinary Differential Equations I, doi:10.1007/978-3-540-78862-1, section II.4;
 * stiffness: E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, section IV.2.
 */
#include "dormand_prince.h"

#include "elementary.h"
#include "exchange.h"

static const double error_weight[] = {71 / 57600.0,      0,          -71 / 16695.0, 71 / 1920.0,
                                      -17253 / 339200.0, 22 / 525.0, -1 / 40.0};
/* Of order 4: L. F. Shampine, Math. Comp. 46 (1986) 135-150,
 * doi:10.1090/S0025-5718-1986-0815836-3. */
static const double interpolant[7][4] = {
    {1, -8048581381 / 2820520608.0, 8663915743 / 2820520608.0, -12715105075 / 11282082432.0},
    {0, 0, 0, 0},
    {0, 131558114200 / 32700410799.0, -68118460800 / 10900136933.0, 87487479700 / 32700410799.0},
    {0, -1754552775 / 470086768.0, 14199869525 / 1410260304.0, -10690763975 / 1880347072.0},
    {0, 127303824393 / 49829197408.0, -318862633887 / 49829197408.0, 701980252875 / 199316789632.0},
    {0, -282668133 / 205662961.0, 2019193451 / 616988883.0, -1453857185 / 822651844.0},
    {0, 40617522 / 29380423.0, -110615467 / 29380423.0, 69997945 / 29380423.0}};
static const DenseOutput dense = {7, 4, interpolant[0]};
static const double safety = 0.9, shrink = 0.2, grow = 5.0;

/* The six stages after the first, and the new states, into `trial`. The step meets the tolerance if
 * *error is at most 1. */
ALWAYS int try_stages(const Model *c, const Shape s, Work *w, const Interval *a, double time,
                      double h, double *error) {
    const size_t n = N_STATES;
    double *restrict const x = c->at.x, *restrict const trial = c->at.trial;
    double *restrict const k = c->at.k;
#define PREVIOUS(earlier) (weight[stage][earlier] * k[earlier * n + (size_t)j])
#define STAGE(number, sum)                                                          \
    {                                                                               \
        enum { stage = number };                                                    \
        if (s.n_states >= 0) {                                                      \
            double next[MOST_STATES];                                               \
            for (int j = 0; j < s.n_states; j++) next[j] = x[j] + h * (sum);        \
            memcpy(trial, next, n * sizeof *trial);                                 \
        } else {                                                                    \
            FOR(j, n) trial[j] = x[j] + h * (sum);                                  \
        }                                                                           \
        TRY(derivatives_at(c, s, w, a, time + node[stage] * h, k + stage * n));     \
    }
    STAGE(1, PREVIOUS(0))
    STAGE(2, PREVIOUS(0) + PREVIOUS(1))
    STAGE(3, PREVIOUS(0) + PREVIOUS(1) + PREVIOUS(2))
    STAGE(4, PREVIOUS(0) + PREVIOUS(1) + PREVIOUS(2) + PREVIOUS(3))
    STAGE(5, PREVIOUS(0) + PREVIOUS(1) + PREVIOUS(2) + PREVIOUS(3) + PREVIOUS(4))
    STAGE(6, PREVIOUS(0) + PREVIOUS(2) + PREVIOUS(3) + PREVIOUS(4) + PREVIOUS(5))
    const double rtol = w->batch->settings->rtol;
    double total = 0.0;
    FOR(j, n) {
        const double estimate = error_weight[0] * k[j] + error_weight[2] * k[2 * n + j]
                                + error_weight[3] * k[3 * n + j] + error_weight[4] * k[4 * n + j]
                                + error_weight[5] * k[5 * n + j] + error_weight[6] * k[6 * n + j];
        const double scale = w->atols[j] + rtol * larger(fabs(x[j]), fabs(trial[j]));
        const double part = h * estimate / scale;
        total += part * part;
    }
    *error = sqrt(total / (double)(n ? n : 1));
    return OK;
}

/* The factor by which to change the step after a try. */
static inline double step_factor(int status, double error) {
    if (status >= DISCARD || !isfinite(error)) return shrink;
    return error == 0.0 ? grow : smaller(grow, larger(shrink, safety * ce_pow(error, -0.2)));
}

/* A hundredth of the time in which the states would change by their own scale. */
static double initial_step(const Work *w, const double *x, const double *dx) {
    double size = 0.0, speed = 0.0;
    for (size_t j = 0; j < w->model.n_states; j++) {
        const double scale = w->atols[j] + w->batch->settings->rtol * fabs(x[j]);
        size += (x[j] / scale) * (x[j] / scale);
        speed += (dx[j] / scale) * (dx[j] / scale);
    }
    return size < 1e-10 || speed < 1e-10 ? 1e-6 : 0.01 * sqrt(size / speed);
}

ALWAYS void accept(const Model *c, const Shape s) {
    const size_t n = N_STATES;
    FOR(j, n) {
        c->at.x[j] = c->at.trial[j];
        c->at.k[j] = c->at.k[6 * n + j];
    }
}

/* Times of the grid that steps pass over: up to, but not, `end`; the next one, and its outputs. */
typedef struct {
    size_t next, end;
    double *y;
} Passing;

/* Record the outputs at times within a step that has just met the tolerance. */
ALWAYS int record_passed(const Model *c, const Shape s, Work *w, const Interval *a, double time,
                         double h, int final, Passing *passing) {
    const size_t n = N_STATES;
    double *const x = c->at.x, *const trial = c->at.trial, *const k = c->at.k;
    memcpy(w->end, trial, n * sizeof *trial);
    for (; passing->next < passing->end; passing->next++) {
        const double at = c->times[passing->next], part = (at - time) / h;
        if (!final && at > time + h) break;
        FOR(j, n) trial[j] = x[j];
        for (size_t stage = 0; stage < 7; stage++) {
            double weight = 0.0;
            for (int power = 3; power >= 0; power--)
                weight = (weight + interpolant[stage][power]) * part;
            FOR(j, n) trial[j] += h * weight * k[stage * n + j];
        }
        interpolate(c, s, a, at - a->begin);
        TRY(set_model(c, s, w, at));
        TRY(get_outputs(c, s, w, passing->y));
        passing->y += c->n_outputs;
    }
    memcpy(trial, w->end, n * sizeof *trial);
    return OK;
}

/* Step from where the FMU is up to `last` or a state event. Returns the code, EVENT for one. */
ALWAYS int to_next_event(const Model *c, const Shape s, Work *w, size_t i, const Interval *a,
                         double last, Stepping *now, const int quiet, Forward *forward,
                         Passing *passing) {
    const double resolution = time_resolution(now->time, last), longest = w->batch->settings->step;
    int status = derivatives(c, s, c->at.k);
    if (now->proposed == 0.0 && status < DISCARD)
        now->proposed = initial_step(w, c->at.x, c->at.k);
    /* or not a number, after an overflow: a step of 0 would never end */
    if (!(now->proposed >= resolution)) now->proposed = resolution;
    if (status >= DISCARD) return failed(STEP_FAILED, status);
    while (now->left > 0) {
        if (longest > 0.0) now->proposed = smaller(now->proposed, longest);
        const double time = now->time, remaining = last - time;
        const int final = now->proposed >= remaining * (1.0 - 1e-10);
        const double h = final ? remaining : smaller(now->proposed, 0.5 * remaining);
        double error = 0.0, part = 2.0;
        status = try_stages(c, s, w, a, time, h, &error);
        if (!quiet && c->f.n_indicators > 0 && status < DISCARD && error <= 1.0)
            status = find_event(w, i, time, h, dense_output, &dense, &part);
        now->left--;
        if (UNLIKELY(status >= ERROR)) return failed(STEP_FAILED, status);
        const double next = h * step_factor(status, error);
        if (UNLIKELY(status >= DISCARD || !(error <= 1.0))) {
            now->proposed = next;
            if (next < resolution) return STEP_TOO_SMALL;
            continue;
        }
        if (forward != NULL) {
            status = advance_sensitivities(w, i, time, h, forward);
            if (status >= DISCARD) return failed(SENSITIVITIES_FAILED, status);
        }
        if (passing != NULL && passing->next < passing->end) {
            status = record_passed(c, s, w, a, time, h, final, passing);
            if (status >= DISCARD) return failed(OUTPUT_FAILED, status);
        }
        accept(c, s);
        int code = quiet ? FINISHED : complete_step(w);
        if (!quiet && code == FINISHED && part <= 1.0) code = EVENT;
        now->time = final && part > 1.0 ? last : time + h * smaller(part, 1.0);
        now->proposed = final ? larger(now->proposed, next) : next;
        if (code != FINISHED || final) return code;
    }
    return TOO_MANY_STEPS;
}

/* From the present time, which the FMU is set to, to grid time i + 1; with sensitivities up to the
 * first event. Returns the code. */
ALWAYS int adaptive_steps_of(Work *w, const Shape s, size_t i, Stepping *now, Forward *forward) {
    const Model *c = &w->model;
    const Interval a = interval(c, s, i);
    const double last = c->times[i + 1], resolution = time_resolution(now->time, last);
    for (int64_t repeated = 0;;) {
        const double begin = now->time, end = next_stop(w, last, resolution);
        int code = FINISHED;
        if (end > begin) code = to_next_event(c, s, w, i, &a, end, now, 0, forward, NULL);
        if (code == EVENT || (code == FINISHED && now->time >= w->next_event)) {
            if (forward != NULL) return HAS_EVENTS;
            repeated = now->time - begin <= resolution ? repeated + 1 : 0;
            code = handle_event(w, i, i, now->time, repeated);
            now->proposed = 0.0;
        }
        if (code != FINISHED || last - now->time <= resolution) return code;
    }
}

static int adaptive_steps_2(Work *w, size_t i, Stepping *now) {
    return adaptive_steps_of(w, (Shape){2, 0, 1, -1, -1}, i, now, NULL);
}

static int adaptive_steps_2_effects(Work *w, size_t i, Stepping *now) {
    return adaptive_steps_of(w, (Shape){2, 1, 1, -1, -1}, i, now, NULL);
}

int adaptive_steps(Work *w, size_t i, Stepping *now, Forward *forward) {
    const Model *c = &w->model;
    if (forward != NULL || c->f.version == 3 || !has_reals(c))
        return adaptive_steps_of(w, ANY, i, now, forward);
    return c->program ? adaptive_steps_2_effects(w, i, now) : adaptive_steps_2(w, i, now);
}

ALWAYS End simulate(Work *w, const double *point, double *y, const Shape s) {
    Own own;
    const Model copy = with_own(&w->model, s, &own), *const c = &copy;
    const double *const t = c->times;
    const uint8_t *const passed = w->batch->experiment->passed;
    const size_t last = c->n_times - 1;
    const Settings *const settings = w->batch->settings;
    const int bounded = w->bound < HUGE_VAL, quiet = is_quiet(c);
    int64_t all_steps = 0;
    Stepping now = {t[0], 0.0, 0};
    int code = start_simulation(w, point);
    if (code != FINISHED) return (End){code, now.time, 0};
    take_back(c, s, w);
    double quiet_end = quiet ? quiet_until(w) : -HUGE_VAL;
    for (size_t i = 0;; i++, y += c->n_outputs) {
        if (UNLIKELY(!quiet)) code = jump(c, s, w, i, now.time);
        if (UNLIKELY(code != FINISHED)) return (End){code, now.time, i};
        const Interval a = interval(c, s, i);
        const int status = record(c, s, w, &a, now.time, y);
        if (UNLIKELY(status >= DISCARD))
            return (End){failed(OUTPUT_FAILED, status), now.time, i};
        if (bounded && is_above_bound(w, i, y)) return (End){ENDED_EARLY, now.time, i};
        if (i == last) break;
        const int64_t granted = now.left = steps_granted(settings, all_steps);
        Passing passing = {i + 1, i + 1, y + c->n_outputs};
        while (passed[passing.end] && t[passing.end + 1] < quiet_end) passing.end++;
        if (LIKELY(t[i + 1] < quiet_end)) {
            code = to_next_event(c, s, w, i, &a, t[passing.end], &now, 1, NULL, &passing);
            for (; code == FINISHED && i + 1 < passing.end; i++, y += c->n_outputs)
                if (bounded && is_above_bound(w, i + 1, y + c->n_outputs)) code = ENDED_EARLY;
        } else {
            hand_over(c, s, w);
            code = adaptive_steps(w, i, &now, NULL);
            take_back(c, s, w);
            if (quiet) quiet_end = quiet_until(w);
        }
        all_steps += granted - now.left;
        code = limit_reached(settings, all_steps, code);
        if (UNLIKELY(code != FINISHED)) return (End){code, now.time, i};
    }
    c->progress[STEPS] = all_steps;
    return (End){FINISHED, now.time, last};
}

/* ---- a loop for each common shape -------------------------------------------------------- */

LOOP(simulate, any, 0, -1, 0, -1, -1)
LOOP(simulate, fmi2, 2, 0, 1, -1, -1)
LOOP(simulate, fmi2_effects, 2, 1, 1, -1, -1)
LOOP(simulate, fmi3, 3, 0, 1, -1, -1)
LOOP(simulate, fmi2_2_1, 2, 0, 1, 2, 1)
LOOP(simulate, fmi2_2_1_effects, 2, 1, 1, 2, 1)

Loop *dormand_prince_loop(const Model *c) {
    const int effects = c->program != NULL;
    if (!has_reals(c) || (c->f.version == 3 && effects)) return any;
    if (c->f.version == 3) return fmi3;
    if (c->n_states == 2 && c->f.n_states == 2 && c->n_inputs == 1)
        return effects ? fmi2_2_1_effects : fmi2_2_1;
    return effects ? fmi2_effects : fmi2;
}

/* ---- stiffness --------------------------------------------------------------------------- *
 *
 * The two last stages of a step are at the same time. The distance of their derivatives over that
 * of their states estimates the largest eigenvalue; where its product with the step stays at the
 * border of the region of stability, stability limits the steps, and a model is stiff. */

static const double border = 3.25;
enum { STIFF_STEPS = 15, FORGIVING_STEPS = 6 };

static double eigenvalue(const Work *w, double h) {
    const size_t n = w->model.n_states;
    const double *k = w->k;
    double of_derivatives = 0.0, of_states = 0.0;
    for (size_t j = 0; j < n; j++) {
        double total = 0.0;
        for (size_t stage = 0; stage < 5; stage++) total += weight[5][stage] * k[stage * n + j];
        const double sixth = w->x[j] + h * total;
        of_derivatives += (k[6 * n + j] - k[5 * n + j]) * (k[6 * n + j] - k[5 * n + j]);
        of_states += (w->trial[j] - sixth) * (w->trial[j] - sixth);
    }
    return of_states > 0.0 ? sqrt(of_derivatives / of_states) : 0.0;
}

/* Try steps until one, of length *h, is accepted. Returns the code. */
static int accepted_step(Work *w, size_t i, double time, double *h, double *proposed) {
    const double longest = w->batch->settings->step;
    const Interval at = interval(&w->model, ANY, i), *const a = &at;
    for (double error = 0.0;;) {
        if (longest > 0.0) *proposed = smaller(*proposed, longest);
        *h = smaller(*proposed, w->model.times[i + 1] - time);
        if (!(time + *h > time)) return STEP_TOO_SMALL;
        const int status = try_stages(&w->model, ANY, w, a, time, *h, &error);
        if (status >= ERROR) return failed(STEP_FAILED, status);
        const double next = *h * step_factor(status, error);
        const int accepted = status < DISCARD && error <= 1.0;
        *proposed = accepted && *h < *proposed ? larger(next, *proposed) : next;
        if (accepted) return FINISHED;
    }
}

static int is_stiff(Work *w, int *code) {
    const Model *c = &w->model;
    double time = c->times[0], proposed = 0.0, h = 0.0;
    int at_border = 0, off_border = 0;
    *code = start_simulation(w, w->batch->points);
    if (*code != FINISHED) return 0;
    size_t i = 0;
    for (int64_t n = 0; n < w->batch->settings->max_steps && i + 1 < c->n_times; n++) {
        int status = set_at(w, i, time, w->x);
        if (status < DISCARD) status = derivatives(c, ANY, w->k);
        if (status >= DISCARD) return *code = failed(STEP_FAILED, status), 0;
        if (proposed == 0.0) proposed = initial_step(w, w->x, w->k);
        *code = accepted_step(w, i, time, &h, &proposed);
        if (*code != FINISHED) return 0;
        if (h * eigenvalue(w, h) > border)
            at_border++, off_border = 0;
        else if (++off_border == FORGIVING_STEPS)
            at_border = 0;
        if (at_border == STIFF_STEPS) return 1;
        time = smaller(time + h, c->times[i + 1]);
        if (time == c->times[i + 1]) i++;
        memcpy(w->x, w->trial, c->n_states * sizeof *w->x);
        *code = complete_step(w);
        if (*code != FINISHED) return 0;
    }
    return 0;
}

int core_is_stiff(const Batch *batch) {
    Work work, *const w = &work;
    int code = begin_work(w, batch), stiff = 0;
    if (code == FINISHED) {
        select_point(w, 0);
        stiff = is_stiff(w, &code);
    }
    end_work(w);
    batch->codes[0] = code;
    return stiff;
}
