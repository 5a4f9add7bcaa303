/* The loops of workers/kernels in C, as the limit that the bench `kernels` measures against.
 * The FMU's functions come by address, in the order of FUNCTIONS there. */
#include <stddef.h>
#include <stdint.h>

typedef struct {
    void *handle;
    int (*reset)(void *);
    int (*setup_experiment)(void *, int, double, double, int, double);
    int (*enter_initialization_mode)(void *);
    int (*exit_initialization_mode)(void *);
    int (*set_real)(void *, const uint32_t *, size_t, const double *);
    int (*get_real)(void *, const uint32_t *, size_t, double *);
    int (*set_time)(void *, double);
    int (*set_continuous_states)(void *, const double *, size_t);
    int (*get_continuous_states)(void *, double *, size_t);
    int (*get_derivatives)(void *, double *, size_t);
    int (*update_discrete_states)(void *, void *);
    int (*enter_continuous_time_mode)(void *);
    int (*completed_integrator_step)(void *, int, int *, int *);
    int (*do_step)(void *, double, double, int);
    int (*set_real_input_derivatives)(void *, const uint32_t *, size_t, const int *, const double *);
} Fmu;

#define MAX_STATES 16

static int initialise(const Fmu *f, const uint32_t *vr, size_t n, const double *values,
                      uint32_t input, const double *u, double start)
{
    int worst = f->reset(f->handle) | f->set_real(f->handle, vr, n, values);
    worst |= f->setup_experiment(f->handle, 0, 0.0, start, 0, 0.0);
    worst |= f->enter_initialization_mode(f->handle);
    worst |= f->set_real(f->handle, &input, 1, u);
    return worst | f->exit_initialization_mode(f->handle);
}

/* One input, one output, one communication step from each time to the next. */
int co_simulate(const Fmu *f, const uint32_t *vr, size_t n, const double *values, uint32_t input,
                uint32_t output, const double *t, const double *u, size_t count, double *y)
{
    const int order = 1;
    int worst = initialise(f, vr, n, values, input, u, t[0]);
    for (size_t i = 0; i < count && worst < 2; i++) {
        worst |= f->set_real(f->handle, &input, 1, &u[i]);
        worst |= f->get_real(f->handle, &output, 1, &y[i]);
        if (i + 1 == count)
            break;
        const double h = t[i + 1] - t[i], slope = (u[i + 1] - u[i]) / h;
        worst |= f->set_real_input_derivatives(f->handle, &input, 1, &order, &slope);
        worst |= f->do_step(f->handle, t[i], h, 1);
    }
    return worst;
}

static int go_to(const Fmu *f, double t, const double *x, size_t n, uint32_t input, double u)
{
    return f->set_time(f->handle, t) | f->set_continuous_states(f->handle, x, n)
           | f->set_real(f->handle, &input, 1, &u);
}

/* One input, one output, one classic Runge-Kutta step from each time to the next. */
int rk4(const Fmu *f, const uint32_t *vr, size_t n, const double *values, uint32_t input,
        uint32_t output, const double *t, const double *u, size_t count, double *y, size_t states)
{
    double x[MAX_STATES], trial[MAX_STATES], k[4][MAX_STATES];
    int event_info[8], flags[2];
    int worst = initialise(f, vr, n, values, input, u, t[0]);
    worst |= f->update_discrete_states(f->handle, event_info);
    worst |= f->enter_continuous_time_mode(f->handle);
    worst |= f->get_continuous_states(f->handle, x, states);
    for (size_t i = 0; i < count && worst < 2; i++) {
        worst |= go_to(f, t[i], x, states, input, u[i]);
        worst |= f->get_real(f->handle, &output, 1, &y[i]);
        if (i + 1 == count)
            break;
        const double h = t[i + 1] - t[i];
        worst |= f->get_derivatives(f->handle, k[0], states);
        for (int stage = 1; stage < 4; stage++) {
            const double part = stage == 3 ? 1.0 : 0.5;
            for (size_t j = 0; j < states; j++)
                trial[j] = x[j] + part * h * k[stage - 1][j];
            worst |= go_to(f, t[i] + part * h, trial, states, input,
                           u[i] + part * (u[i + 1] - u[i]));
            worst |= f->get_derivatives(f->handle, k[stage], states);
        }
        for (size_t j = 0; j < states; j++)
            x[j] += h / 6.0 * (k[0][j] + 2.0 * k[1][j] + 2.0 * k[2][j] + k[3][j]);
        worst |= go_to(f, t[i] + h, x, states, input, u[i + 1]);
        worst |= f->completed_integrator_step(f->handle, 1, &flags[0], &flags[1]);
    }
    return worst;
}
