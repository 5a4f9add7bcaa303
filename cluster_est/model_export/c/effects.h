/* The effects' equations, printed from the run. Arrays are laid out as model.h says. */
#ifndef EFFECTS_H
#define EFFECTS_H

/* Effects at derivatives, inputs and parameters: start the own states; make of the inputs those
 * that the original sees and of parameters those that hold now; add to the derivatives and fill in
 * those of the own states; and the fastest rate of an own state. */
void effects_begin(double t, double *states, const double *raw, const double *coefficients,
                   const double *base);
void effects_before(double t, const double *states, const double *raw, const double *coefficients,
                    const double *base, double *edited, double *varied);
void effects_inside(double t, const double *states, const double *raw, const double *coefficients,
                    const double *base, double *slopes);
double effects_rate(const double *coefficients);

/* Steps of effect number e at an output, which sees `row`, the variables that
 * such effects need. */
void output_begin(int e, double t, double *states, const double *row, const double *raw,
                  const double *coefficients);
void output_inside(int e, double t, const double *states, const double *row, const double *raw,
                   const double *coefficients, double *slopes);
double output_after(int e, double t, const double *states, const double *row, const double *raw,
                    const double *coefficients);
double output_rate(int e, const double *row, const double *raw, const double *coefficients);
double output_decay(int e, const double *row, const double *raw, const double *coefficients);

#endif
