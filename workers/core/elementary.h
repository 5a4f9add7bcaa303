/* The elementary functions of effects and of step control, which are the core's own: the same bits
 * on every processor. */
#ifndef ELEMENTARY_H
#define ELEMENTARY_H

double ce_exp(double x);
double ce_expm1(double x);
double ce_log(double x);
double ce_sin(double x);
double ce_cos(double x);
double ce_tan(double x);
double ce_atan(double x);
double ce_tanh(double x);
double ce_pow(double x, double y);

#endif
