/* The elementary functions of the C library at hand, to compare with: their bits differ from one
 * processor to another. */
#include <math.h>

#include "elementary.h"

double ce_exp(double x) { return exp(x); }
double ce_expm1(double x) { return expm1(x); }
double ce_log(double x) { return log(x); }
double ce_sin(double x) { return sin(x); }
double ce_cos(double x) { return cos(x); }
double ce_tan(double x) { return tan(x); }
double ce_atan(double x) { return atan(x); }
double ce_tanh(double x) { return tanh(x); }
double ce_pow(double x, double y) { return pow(x, y); }
