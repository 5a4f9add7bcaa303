/* Elementary functions whose results have the same bits on every processor.
 *
 * The C library's functions differ between systems, and glibc's differ between processors with and
 * without fused multiply-add. These use only + - * / of IEEE doubles, rounded to nearest, and
 * integers. Compile elementary.c with -ffp-contract=off, and without -ffast-math.
 *
 * Largest errors found are 0.62 ulp for log, 0.56 for expm1 and atan, below 0.52 for the others.
 * Special values are those of C11, annex F. errno is left alone, flags of the floating-point
 * environment are not specified, and every NaN returned is the same one.
 */
#ifndef ELEMENTARY_H
#define ELEMENTARY_H

double ce_exp(double x);
double ce_expm1(double x);
double ce_log(double x);
double ce_pow(double x, double y);
double ce_sin(double x);
double ce_cos(double x);
double ce_tan(double x);
double ce_atan(double x);
double ce_tanh(double x);

#endif
