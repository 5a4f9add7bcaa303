/* Elementary functions of our own: the same bits on every processor.
 *
 * Each function takes its argument apart into a tabulated point and a small rest, evaluates a
 * polynomial of the rest, and adds the parts so that only the last addition rounds noticeably:
 *
 *     result = high + (small terms),   |small terms| <= about |high| / 32.
 *
 * A rounding error of the small terms is then at most some 1/32 of one of the result. No product
 * needs to be fused with a sum: where one must be exact, its factors have few enough bits.
 *
 * Tables and polynomials are computed by scripts/elementary_coefficients.py. Sources of methods:
 *  [T89] P. T. P. Tang, Table-driven implementation of the exponential function in IEEE
 *        floating-point arithmetic, ACM TOMS 15 (1989) 144-157, doi:10.1145/63522.214389
 *  [T90] P. T. P. Tang, Table-driven implementation of the logarithm function in IEEE
 *        floating-point arithmetic, ACM TOMS 16 (1990) 378-400, doi:10.1145/98267.98294
 *  [T92] P. T. P. Tang, Table-driven implementation of the expm1 function in IEEE floating-point
 *        arithmetic, ACM TOMS 18 (1992) 211-222, doi:10.1145/146847.146928
 *  [CW]  W. J. Cody, W. Waite, Software Manual for the Elementary Functions, Prentice-Hall 1980
 *  [PH]  M. H. Payne, R. N. Hanek, Radian reduction for trigonometric functions, ACM SIGNUM
 *        Newsletter 18 (1983) 19-24, doi:10.1145/1057600.1057602
 *  [D]   T. J. Dekker, A floating-point technique for extending the available precision,
 *        Numer. Math. 18 (1971) 224-242, doi:10.1007/BF01397083
 *  [M]   J.-M. Muller, Elementary Functions: Algorithms and Implementation, 3rd ed., 2016
 */
#include "elementary.h"

#include <float.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

#include "compiler.h"
#include "elementary_tables.h"

#if FLT_EVAL_METHOD != 0
#error "doubles must be computed as doubles: excess precision gives other bits"
#endif
#ifdef __FAST_MATH__
#error "-ffast-math gives other bits"
#endif
#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#endif

#define SIGN 0x8000000000000000u
#define INFINITE 0x7ff0000000000000u

/* Adding it leaves the nearest integer in the last bits, subtracting it again gives that integer:
 * 1.5 * 2**52, whose own last 51 bits are 0. */
#define TO_INTEGER 0x1.8p52

static inline uint64_t bits_of(double x) {
    uint64_t bits;
    memcpy(&bits, &x, sizeof bits);
    return bits;
}

static inline double from_bits(uint64_t bits) {
    double x;
    memcpy(&x, &bits, sizeof x);
    return x;
}

/* The exponent's field without the sign. */
static inline uint64_t exponent_field(uint64_t bits) { return bits >> 52 & 0x7ff; }

/* The leading 26 bits of a number: products of two such are exact. */
static inline double leading(double x) { return from_bits(bits_of(x) & 0xfffffffff8000000u); }

/* Processors differ in the sign of the NaN that they make, and in what they keep of a given one. */
static inline double not_a_number(void) { return from_bits(0x7ff8000000000000u); }

/* exp [T89]: x = n ln 2 / 128 + r, |r| <= ln 2 / 256, exp(x) = 2**(n/128) exp(r). */

/* exp(r) - 1 and what 2**(n/128) misses, for small r. */
static inline double exp_rest(double r, double missing) {
    const double *const c = EXP_POLYNOMIAL, square = r * r;
    return ((missing + r) + square * (c[0] + c[1] * r)) + (square * square) * (c[2] + c[3] * r);
}

/* scale (1 + rest) where scale's exponent may lie outside of the range: computed nearer to 1. */
RARELY static double exp_extreme(uint64_t scale_bits, double rest, int large) {
    if (large) {
        const double scale = from_bits(scale_bits - (1000ull << 52));
        return 0x1p1000 * (scale + scale * rest);
    }
    const double scale = from_bits(scale_bits + (1022ull << 52)), step = scale * rest;
    if (scale + step >= 1.0) return 0x1p-1022 * (scale + step);
    /* The result is subnormal: rounded once, to a multiple of 2**-52 here, as numbers from 1 to 2
     * are; high and the term beside it are 1 + scale without error. */
    const double high = 1.0 + scale, sum = high + (step - ((high - 1.0) - scale));
    return 0x1p-1022 * (sum - 1.0);
}

double ce_exp(double x) {
    const uint64_t field = exponent_field(bits_of(x));
    /* One comparison for |x| < 2**-54 and for |x| >= 512. */
    if (UNLIKELY(field - 0x3c9 >= 0x408 - 0x3c9)) {
        if (field < 0x3c9) return 1.0 + x;
        if (x != x) return not_a_number();
        if (x > 710.0) return INFINITY;
        if (x < -746.0) return 0.0;
    }
    const double shifted = x * EXP_PER_STEP + TO_INTEGER, n = shifted - TO_INTEGER;
    const uint64_t index = bits_of(shifted);
    const double r = (x - n * EXP_STEP_HIGH) - n * EXP_STEP_LOW;
    const uint64_t scale_bits = EXP_TABLE[index % 128].bits + (index << 45);
    const double rest = exp_rest(r, EXP_TABLE[index % 128].missing);
    if (UNLIKELY(field >= 0x408)) return exp_extreme(scale_bits, rest, x > 0.0);
    const double scale = from_bits(scale_bits);
    return scale + scale * rest;
}

/* exp(x) - 1 [T92]: a polynomial for |x| < 1/16, else exp's parts with -1 added without error. */
double ce_expm1(double x) {
    const uint64_t field = exponent_field(bits_of(x));
    if (field < 0x3fb) {
        if (UNLIKELY(field < 0x3c9)) return x;
        const double *const c = EXPM1_POLYNOMIAL, square = x * x;
        const double high = (c[3] + c[4] * x) + square * (c[5] + c[6] * x);
        const double cubic = (c[0] + c[1] * x) + square * (c[2] + x * high);
        return x + (0.5 * square + (square * x) * cubic);
    }
    if (UNLIKELY(field >= 0x404)) {
        /* |x| >= 32 */
        if (x != x) return not_a_number();
        if (x < -38.0) return -1.0;
        if (x > 64.0) return ce_exp(x);
    }
    const double shifted = x * EXP_PER_STEP + TO_INTEGER, n = shifted - TO_INTEGER;
    const uint64_t index = bits_of(shifted);
    const double r = (x - n * EXP_STEP_HIGH) - n * EXP_STEP_LOW;
    const double scale = from_bits(EXP_TABLE[index % 128].bits + (index << 45));
    const double rest = exp_rest(r, EXP_TABLE[index % 128].missing);
    /* The sum of scale and -1 and its error, whichever is larger (D. E. Knuth's TwoSum [M]). */
    const double high = scale - 1.0, part = high - scale;
    const double low = (scale - (high - part)) - (1.0 + part);
    return high + (low + scale * rest);
}

/* log [T90]: x = 2**k z, z near a tabulated c: log(x) = k ln 2 + log(c) + log(1 + r), r = z/c - 1.
 * Near 1, where log(x) is small, the reciprocals have so few bits that r is all but exact; next to
 * 1, c is 1. */
double ce_log(double x) {
    uint64_t bits = bits_of(x);
    /* One comparison for all but positive normal numbers. */
    if (UNLIKELY(bits - 0x0010000000000000u >= 0x7fe0000000000000u)) {
        if (bits << 1 == 0) return -INFINITY;
        if (bits == INFINITE) return x;
        if (x != x || bits & SIGN) return not_a_number();
        bits = bits_of(x * 0x1p52) - (52ull << 52);
    }
    const uint64_t distance = bits - LOG_OFFSET, index = distance >> 45 & 127;
    const double k = (double)((int64_t)distance >> 52);
    const double z = from_bits(bits - (distance & 0xfff0000000000000u));
    const double r = (z - LOG_TABLE[index].centre) * LOG_TABLE[index].inverse, square = r * r;
    /* base is a multiple of 2**-42 below 2**10, so exact, and larger than r, or 0. */
    const double base = k * LN2_HIGH + LOG_TABLE[index].high;
    const double high = base + r, lost = (base - high) + r;
    const double low = k * LN2_LOW + LOG_TABLE[index].low;
    const double *const c = LOG_POLYNOMIAL;
    const double cubic = (c[0] + c[1] * r) + square * ((c[2] + c[3] * r) + square * c[4]);
    return high + ((lost + low) + square * (r * cubic - 0.5));
}

/* What is left of pow's arguments after special cases: a result, or |x| as a normal number and the
 * result's sign. */
typedef struct {
    int settled;
    double result;
    uint64_t bits, sign;
} Base;

/* 0: no integer, 1: odd, 2: even. */
static inline int parity(uint64_t bits) {
    const uint64_t field = exponent_field(bits);
    if (field < 0x3ff) return bits << 1 ? 0 : 2;
    if (field > 0x3ff + 52) return 2;
    const uint64_t one = 1ull << (0x3ff + 52 - field);
    if (bits & (one - 1)) return 0;
    return bits & one || field == 0x3ff ? 1 : 2;
}

/* C11, F.10.4.4, and y too large or too small for the method. */
RARELY static Base pow_special(double x, double y) {
    const uint64_t y_bits = bits_of(y), one = bits_of(1.0), field = exponent_field(y_bits);
    uint64_t bits = bits_of(x) & ~SIGN, sign = 0;
    if (y == 0.0 || x == 1.0) return (Base){1, 1.0, 0, 0};
    if (x != x || y != y) return (Base){1, not_a_number(), 0, 0};
    if (bits_of(x) & SIGN) {
        const int kind = parity(y_bits);
        if (kind == 0 && bits != 0 && bits != INFINITE) return (Base){1, not_a_number(), 0, 0};
        if (kind == 1) sign = SIGN;
    }
    /* Beyond the range whatever x is, if that is not 1: |y| >= 2**64. */
    const int zero_or_infinite = bits == 0 || bits == INFINITE || field >= 0x3ff + 64;
    if (bits == one) return (Base){1, from_bits(sign | one), 0, 0};
    if (zero_or_infinite) {
        return (Base){1, from_bits(sign | ((bits > one) == (y > 0.0) ? INFINITE : 0)), 0, 0};
    }
    /* 1 but for less than 2**-54: |y| < 2**-65. */
    if (field < 0x3ff - 65) return (Base){1, from_bits(sign | one), 0, 0};
    if (bits < 1ull << 52) bits = bits_of(from_bits(bits) * 0x1p52) - (52ull << 52);
    return (Base){0, 0.0, bits, sign};
}

/* Adding it and subtracting it again rounds a number near 1 to a multiple of 2**-20. */
#define TO_21_BITS 0x1.8p32

/* pow: exp(y log(x)). The logarithm is high + low with a relative error of some 2**-67: as above,
 * but 1/c has 11 bits, and z is cut in two, so that both parts of r = rough + fine are exact. rough
 * has 24 bits, of which the square is exact, and is at least twice fine, or 0. The product with y
 * splits both factors [D]. */
double ce_pow(double x, double y) {
    uint64_t bits = bits_of(x), sign = 0;
    if (UNLIKELY(bits - 0x0010000000000000u >= 0x7fe0000000000000u
                 || exponent_field(bits_of(y)) - (0x3ff - 65) >= 65 + 64)) {
        const Base base = pow_special(x, y);
        if (base.settled) return base.result;
        bits = base.bits, sign = base.sign;
    }
    const uint64_t distance = bits - LOG_OFFSET, cell = distance >> 45 & 127;
    const double k = (double)((int64_t)distance >> 52);
    const double z = from_bits(bits - (distance & 0xfff0000000000000u));
    const double upper = (z + TO_21_BITS) - TO_21_BITS, inverse = POW_TABLE[cell].inverse;
    const double rough = upper * inverse - 1.0, fine = (z - upper) * inverse;
    /* A multiple of 2**-42 below 2**10, so exact. */
    const double base = (k * LN2_HIGH + POW_TABLE[cell].high) + rough;
    const double sum = base + fine, lost = (base - sum) + fine;
    const double r = rough + fine, square = r * r;
    const double half_rough = 0.5 * rough, half = half_rough * rough;
    const double high = sum - half, lost_too = (sum - high) - half;
    const double *const c = POW_POLYNOMIAL;
    const double cubic =
        (c[0] + c[1] * r) + square * ((c[2] + c[3] * r) + square * (c[4] + c[5] * r));
    const double low = ((lost + lost_too) + (k * LN2_LOW + POW_TABLE[cell].low))
                       + ((square * r) * cubic - fine * (half_rough + 0.5 * r));

    const double log_1 = leading(high), log_2 = (high - log_1) + low;
    const double y_1 = leading(y), y_2 = y - y_1;
    const double product = y_1 * log_1, product_low = y_2 * log_1 + y * log_2;
    const double exponent = product + product_low, size = fabs(exponent);
    if (UNLIKELY(!(size < 1024.0))) return from_bits(sign | (exponent > 0.0 ? INFINITE : 0));

    const double shifted = exponent * EXP_PER_STEP + TO_INTEGER, n = shifted - TO_INTEGER;
    const uint64_t index = bits_of(shifted);
    const double e = (product - n * EXP_STEP_HIGH) + (product_low - n * EXP_STEP_LOW);
    const uint64_t scale_bits = EXP_TABLE[index % 128].bits + (index << 45);
    const double rest = exp_rest(e, EXP_TABLE[index % 128].missing);
    if (UNLIKELY(size >= 512.0)) {
        return from_bits(sign | bits_of(exp_extreme(scale_bits, rest, exponent > 0.0)));
    }
    const double scale = from_bits(sign | scale_bits);
    return scale + scale * rest;
}

/* sin, cos, tan: x = n pi/64 + h + l, |h| <= pi/128, n modulo 128 or more. */
typedef struct {
    uint64_t n;
    double h, l;
} Angle;

/* The product of two integers of 64 bits: low half, and the high one by address. */
static inline uint64_t wide_product(uint64_t a, uint64_t b, uint64_t *high) {
#if defined(__SIZEOF_INT128__) && !defined(CE_WITHOUT_INT128)
    __extension__ typedef unsigned __int128 Wide;
    const Wide wide = (Wide)a * b;
    *high = (uint64_t)(wide >> 64);
    return (uint64_t)wide;
#else
    const uint64_t a0 = a & 0xffffffffu, a1 = a >> 32, b0 = b & 0xffffffffu, b1 = b >> 32;
    const uint64_t middle = a1 * b0 + (a0 * b0 >> 32), other = a0 * b1 + (middle & 0xffffffffu);
    *high = a1 * b1 + (middle >> 32) + (other >> 32);
    return a * b;
#endif
}

/* Any |x| >= 2**-6 [PH]: of the digits of 2/pi those that give multiples of 4 quadrants are left
 * out, 192 are used, which leaves 75 correct ones even of the rest nearest to 0 of all doubles. */
RARELY static Angle angle_exact(double x) {
    const uint64_t bits = bits_of(x), mantissa = (bits & 0x000fffffffffffffu) | 1ull << 52;
    const unsigned offset = (unsigned)exponent_field(bits) - 1013;
    const unsigned word = offset / 64, shift = offset % 64;
    uint64_t digits[3], p[3], carry, high;
    for (int i = 0; i < 3; i++) {
        const uint64_t *const at = TWO_OVER_PI + word + i;
        digits[i] = shift ? at[0] << shift | at[1] >> (64 - shift) : at[0];
    }
    /* mantissa * digits modulo 2**192, where 2**192 are 4 quadrants; p[0] is the uppermost. */
    p[2] = wide_product(mantissa, digits[2], &carry);
    p[1] = wide_product(mantissa, digits[1], &high) + carry;
    p[0] = mantissa * digits[0] + high + (p[1] < carry);

    /* 2**185 are pi/64: n is the nearest integer, the rest keeps 185 bits and gets a sign. */
    const uint64_t n = (p[0] + (1ull << 56)) >> 57;
    uint64_t f0 = p[0] << 7 | p[1] >> 57, f1 = p[1] << 7 | p[2] >> 57, f2 = p[2] << 7;
    const uint64_t negative = f0 >> 63;
    if (negative) {
        f2 = ~f2 + 1;
        f1 = ~f1 + (f2 == 0);
        f0 = ~f0 + (f2 == 0 && f1 == 0);
    }
    /* Leading zeros go; two words are left, 2**-128 times them the rest in units of pi/64. */
    double unit = 0x1p-4;
    for (int i = 0; i < 2 && f0 == 0; i++) {
        f0 = f1, f1 = f2, f2 = 0;
        unit *= 0x1p-64;
    }
    while (f0 >> 63 == 0) {
        f0 = f0 << 1 | f1 >> 63, f1 = f1 << 1 | f2 >> 63, f2 <<= 1;
        unit *= 0.5;
    }
    /* The product with pi/4 (and 2**-4 above), 120 bits of it. */
    uint64_t a, b, c, low = wide_product(f0, QUARTER_PI[0], &a);
    wide_product(f0, QUARTER_PI[1], &b);
    wide_product(f1, QUARTER_PI[0], &c);
    low += b;
    a += low < b;
    low += c;
    a += low < c;
    const double sign = negative != bits >> 63 ? -unit : unit;
    return (Angle){bits >> 63 ? 0 - n : n, (double)(a >> 11) * (0x1p-53 * sign),
                   (double)((a & 0x7ff) << 42 | low >> 22) * (0x1p-106 * sign)};
}

/* What angle() takes. */
static inline int is_ordinary(double size) { return size >= 0x1p-27 && size < 0x1p20; }

/* 2**-27 <= |x| < 2**20 [CW]: pi/64 in three parts, of which n times the first two is exact. A rest
 * below 2**-27 lost too many digits, unless n is 0, which |x| excludes. */
static inline Angle angle(double x) {
    const double shifted = x * ANGLE_PER_STEP + TO_INTEGER, n = shifted - TO_INTEGER;
    const double second = n * ANGLE_STEP_2, third = n * ANGLE_STEP_3;
    const double a = x - n * ANGLE_STEP_1, b = a - second;
    const double c = third - ((a - b) - second);
    const double h = b - c;
    if (UNLIKELY(fabs(h) < 0x1p-27)) return angle_exact(x);
    return (Angle){bits_of(shifted), h, (b - h) - c};
}

/* sin of an angle: S cos(h) + C sin(h) with S = sin(n pi/64), and C its cosine, never negative, as
 * A + B with A = 0, 1/2 or 1: (S + A h) + (B h + ..), whose first sum loses nothing. */
static inline double sin_of(Angle at) {
    const double *const s = SIN_POLYNOMIAL, *const c = COS_POLYNOMIAL;
    const uint64_t turned = at.n + 32, index = turned % 64, sign = turned << 57 & SIGN;
    const double sine = SIN_TABLE[index].high, h = at.h, u = h * h;
    const double rough = SIN_TABLE[index].rough_cosine, rest = SIN_TABLE[index].cosine_rest;
    const double sine_rest = (u * h) * (s[0] + u * (s[1] + u * s[2]));
    const double cosine_less_1 = u * (c[0] + u * (c[1] + u * c[2]));
    const double step = rough * h, high = sine + step, lost = (sine - high) + step;
    const double low = ((lost + SIN_TABLE[index].low) + rest * h)
                       + (sine * cosine_less_1 + (rough + rest) * (at.l + sine_rest));
    return from_bits(bits_of(high + low) ^ sign);
}

double ce_sin(double x) {
    const double size = fabs(x);
    if (UNLIKELY(!is_ordinary(size))) {
        if (size < 1.0) return x;
        return size < INFINITY ? sin_of(angle_exact(x)) : not_a_number();
    }
    return sin_of(angle(x));
}

static inline double cos_of(Angle at) { return sin_of((Angle){at.n + 32, at.h, at.l}); }

double ce_cos(double x) {
    const double size = fabs(x);
    if (UNLIKELY(!is_ordinary(size))) {
        if (size < 1.0) return 1.0;
        return size < INFINITY ? cos_of(angle_exact(size)) : not_a_number();
    }
    return cos_of(angle(size));
}

/* tan(n pi/64 + h) = (T + t) / (1 - T t), |T| <= 1, t = tan(h), or minus its reciprocal in odd
 * quadrants: in both cases (e0 + e1 + e2 t) / (e3 + e4 + e5 t), without a branch. Numerator and
 * denominator have two parts; the quotient is corrected by what it leaves of the numerator [D]. */
static inline double tan_of(Angle at) {
    const double *const c = TAN_POLYNOMIAL, h = at.h, u = h * h;
    const double rest = at.l + (u * h) * ((c[0] + u * c[1]) + (u * u) * (c[2] + u * c[3]));
    const double t = h + rest, t_low = (h - t) + rest;
    const double *const e = TAN_TABLE[at.n % 64];
    const double over = e[2] * t, top = e[0] + over;
    const double top_low = ((e[0] - top) + over) + (e[1] + e[2] * t_low);
    const double under = e[5] * t, bottom = e[3] + under;
    const double bottom_low = ((e[3] - bottom) + under) + (e[4] + e[5] * t_low);
    const double inverse = 1.0 / bottom, quotient = top * inverse;
    const double q = leading(quotient), q_2 = quotient - q, b = leading(bottom), b_2 = bottom - b;
    const double left = ((top - q * b) - q * b_2) - q_2 * bottom;
    return quotient + (left + (top_low - quotient * bottom_low)) * inverse;
}

double ce_tan(double x) {
    const double size = fabs(x);
    if (UNLIKELY(!is_ordinary(size))) {
        if (size < 1.0) return x;
        return size < INFINITY ? tan_of(angle_exact(x)) : not_a_number();
    }
    return tan_of(angle(x));
}

/* atan(x) = atan(c) + atan((x - c) / (1 + x c)), c of 6 bits near x [M], infinite from 64 on. */
double ce_atan(double x) {
    const uint64_t bits = bits_of(x) & ~SIGN;
    if (bits < bits_of(0.0625)) {
        if (UNLIKELY(bits < bits_of(0x1p-27))) return x;
        const double *const c = ATAN_SMALL_POLYNOMIAL, u = x * x, square = u * u;
        const double upper = (c[2] + u * c[3]) + square * (c[4] + u * c[5]);
        return x + (u * x) * ((c[0] + u * c[1]) + square * upper);
    }
    const double size = from_bits(bits);
    double high = HALF_PI_HIGH, low = HALF_PI_LOW, top = -1.0, bottom = size;
    if (bits < bits_of(64.0)) {
        const uint64_t cell = bits >> 48;
        const double centre = from_bits(cell << 48 | 1ull << 47);
        high = ATAN_TABLE[cell - 0x3fb0].high, low = ATAN_TABLE[cell - 0x3fb0].low;
        top = size - centre, bottom = 1.0 + size * centre;
    } else if (UNLIKELY(bits > INFINITE)) {
        return not_a_number();
    }
    const double *const c = ATAN_POLYNOMIAL, r = top / bottom, u = r * r;
    const double y = high + (low + (r + (u * r) * (c[0] + u * (c[1] + u * c[2]))));
    return from_bits(bits_of(y) | (bits_of(x) & SIGN));
}

/* tanh(x) = T + (1 - T**2) t / (1 + T t), T = tanh(c), t = tanh(x - c), c of 7 bits near x [M]. */
double ce_tanh(double x) {
    const uint64_t bits = bits_of(x) & ~SIGN;
    if (bits < bits_of(0.125)) {
        if (UNLIKELY(bits < bits_of(0x1p-27))) return x;
        const double *const c = TANH_SMALL_POLYNOMIAL, u = x * x, square = u * u;
        const double upper = (c[2] + u * c[3]) + square * (c[4] + u * c[5]);
        return x + (u * x) * ((c[0] + u * c[1]) + square * upper);
    }
    /* From here on tanh(x) is nearer to 1 than 2**-54. */
    if (bits >= bits_of(19.0625)) {
        return bits > INFINITE ? not_a_number() : from_bits(bits_of(1.0) | (bits_of(x) & SIGN));
    }
    const uint64_t cell = bits >> 47, index = cell - 0x7f80;
    const double d = from_bits(bits) - from_bits(cell << 47 | 1ull << 46), u = d * d;
    const double *const c = TANH_POLYNOMIAL, high = TANH_TABLE[index].high;
    const double t = d + (u * d) * ((c[0] + u * c[1]) + (u * u) * (c[2] + u * c[3]));
    const double step = (TANH_TABLE[index].slope * t) / (1.0 + high * t);
    const double y = high + (TANH_TABLE[index].low + step);
    return from_bits(bits_of(y) | (bits_of(x) & SIGN));
}
