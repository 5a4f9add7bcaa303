#include <stdio.h>
#include <string.h>

#include "model.h"

/* The places are those in tests/integration/fmus/test_scripted.py. */
static const char *const FUNCTIONS[] = {
    "", "Reset", "SetupExperiment", "EnterInitializationMode", "ExitInitializationMode", "SetTime",
    "GetContinuousStates", "SetContinuousStates", "EnterContinuousTimeMode",
    "CompletedIntegratorStep", "DoStep", "GetDirectionalDerivative",
#if FMI == 2
    "GetReal", "NewDiscreteStates", "GetDerivatives",
#else
    "GetFloat64", "UpdateDiscreteStates", "GetContinuousStateDerivatives",
#endif
};

static int calls;          /* of the function that fails */
static const Model *fatal; /* the instance that must not be called any more */

static void complain(const Model *m, const char *function)
{
    if (m == fatal)
        fprintf(stderr, "%s was called after a fatal error\n", function);
}

int model_answer(Model *m, const char *function)
{
    complain(m, function);
    if (M(function) == 0.0 || strcmp(function, FUNCTIONS[(int)M(function)]) != 0)
        return OK;
    calls++;
    const bool fails = M(nth) > 0.0 ? calls == (int)M(nth) : calls >= -(int)M(nth);
    const int status = fails ? (int)M(status) : OK;
    if (status == FATAL)
        fatal = m;
    return status;
}

bool model_takes_any_state(void) { return true; }

int model_accept(Model *m)
{
    (void)m;
    calls = 0;
    return OK;
}

void model_start(Model *m)
{
    if (m->logging_on)
        error(m, "logging is on");
}

void model_free(Model *m) { complain(m, "FreeInstance"); }

/* The plan survives, or nothing could fail before it is set. */
void model_reset(Model *m, const Values *before)
{
    calls = 0;
    M(function) = before->function;
    M(nth) = before->nth;
    M(status) = before->status;
}

int model_equations(Model *m)
{
    static const double BAD[] = {0.0, NAN, INFINITY, 1e300};
    M(der_x) = M(time) > M(since) ? BAD[(int)M(bad)] : -M(x);
    M(above) = M(x) - M(level);
    M(y) = M(x);
    return OK;
}

double model_partial(Model *m, unsigned unknown, unsigned known)
{
    (void)m;
    if (unknown == V_der_x)
        return known == V_x ? -1.0 : 0.0;
    return unknown == V_y && known == V_x ? 1.0 : 0.0;
}

bool model_step_completed(Model *m) { return M(time) > M(after) && M(events) == 0.0; }
bool model_step_ends(Model *m) { return M(time) > M(stops); }

static void jump(Model *m, Event *event, double x)
{
    M(x) = x;
    M(events) += 1.0;
    M(jumped) = M(time);
    event->states_changed = true;
}

void model_event(Model *m, Event *event)
{
    const double now = M(time);
    event->terminate = now >= M(ends);
    if (M(begun) == 0.0) {
        M(begun) = 1.0;
        event->next_time = M(at) >= 0.0 ? M(at) : INFINITY;
    } else if (M(events) == 0.0 && (now > M(after) || (M(at) >= 0.0 && now >= M(at)))) {
        jump(m, event, 5.0);
    } else if (M(x) <= M(level)) {
        jump(m, event, 2.0 * M(level));
    }
    if (M(endless) < 1e9)
        event->next_time = fmax(now, M(endless));
}
