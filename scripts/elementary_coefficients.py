"""Write workers/core/elementary_tables.h: tables and polynomials of the elementary functions.

    python scripts/elementary_coefficients.py [--check]

Everything is computed here with mpmath at 240 bits, nothing is taken from a library. Entries of
tables are the true values, rounded to one double, or to a sum of two. Polynomials are minimax
approximations by Remez' exchange on 200 Chebyshev points (J.-M. Muller, Elementary Functions,
3rd ed., Birkhaeuser 2016, chapter 3), with a weight that makes the error one relative to the
function's result. Coefficients are rounded to doubles from the lowest power on, and those that
remain are fitted anew after each. The bound printed beside each polynomial is the largest weighted
error of the rounded one on 601 points, as a power of 2; half an ulp is 2**-53 to 2**-54.

`--check` compares with the file and writes nothing.
"""

from __future__ import annotations

import argparse
import struct
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import mpmath  # type: ignore[import-untyped]
from mpmath import mpf

FILE = Path(__file__).resolve().parent.parent / "workers" / "core" / "elementary_tables.h"
Function = Callable[[mpf], mpf]

mpmath.mp.prec = 240
LN2, PI = mpmath.log(2), +mpmath.pi


def main() -> int:
    """Write the header, or compare with it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing, compare")
    options = parser.parse_args()
    text = header()
    if options.check:
        same = FILE.is_file() and FILE.read_text() == text
        print("the same" if same else "differs")
        return 0 if same else 1
    FILE.write_text(text)
    return 0


def header() -> str:
    """Return the whole file."""
    parts = [
        "/* Written by scripts/elementary_coefficients.py, which says how; do not edit. */",
        "#ifndef ELEMENTARY_TABLES_H",
        "#define ELEMENTARY_TABLES_H",
        "#include <stdint.h>",
        *exponential(),
        *logarithm(),
        *trigonometric(),
        *arctangent(),
        *hyperbolic(),
        "#endif",
    ]
    return "\n".join(parts) + "\n"


# What is tabulated, function by function


def exponential() -> list[str]:
    """exp, expm1 and pow: 2**(j/128), ln 2 / 128 in two parts, two polynomials."""
    rows = []
    for j in range(128):
        value = mpf(2) ** (mpf(j) / 128)
        rounded = float(value)
        # The complete n = 128 m + j is added to the exponent's field, so j is subtracted here.
        field = (int.from_bytes(to_bytes(rounded), "big") - (j << 45)) % 2**64
        rows.append(f"{{{number((value - rounded) / rounded)}, 0x{field:016x}}}")
    high, low = leading(LN2 / 128, -43), LN2 / 128 - leading(LN2 / 128, -43)
    reach = LN2 / 256 * mpf("1.001")
    return [
        "/* 2**(j/128), j = 0..127: what the double misses of it, relative, and the double's bits",
        " * less j << 45. */",
        "static const struct { double missing; uint64_t bits; } EXP_TABLE[128] = {",
        *lines(rows, 2),
        "};",
        constant("EXP_PER_STEP", 128 / LN2),
        constant("EXP_STEP_HIGH", high),
        constant("EXP_STEP_LOW", low),
        *polynomial(
            "EXP_POLYNOMIAL",
            "(exp(r) - 1 - r) / r**2, |r| <= ln 2 / 256, absolute",
            lambda r: series(lambda k: r**k / mpmath.factorial(k + 2)),
            (-reach, reach),
            4,
            lambda r: r**2,
        ),
        *polynomial(
            "EXPM1_POLYNOMIAL",
            "(exp(x) - 1 - x - x**2/2) / x**3, |x| <= 1/16, relative to exp(x) - 1",
            lambda x: series(lambda k: x**k / mpmath.factorial(k + 3)),
            (-mpf(1) / 16, mpf(1) / 16),
            7,
            lambda x: x**2,
        ),
    ]


LOG_OFFSET = 0x3FE6700000000000  # half a cell below 0.703125: 1 is inside a cell, not at an edge


def logarithm() -> list[str]:
    """log and pow: points with reciprocals of few bits, their logarithms, ln 2 in two parts."""
    log_rows, pow_rows, log_ends, pow_ends = [], [], [mpf(0)], [mpf(0)]
    for j in range(128):
        first, last = (mpf(from_bits(LOG_OFFSET + (i << 45))) for i in (j, j + 1))
        centre, inverse = log_point(first, last)
        log_ends += [first * inverse - 1, last * inverse - 1]
        high, low = split(mpmath.log(centre))
        log_rows.append("{" + ", ".join(number(v) for v in (centre, inverse, high, low)) + "}")
        # 11 bits, so that products with 21 and with 32 bits of an argument are exact.
        inverse = mpmath.nint(2048 / (first + last)) / 1024 if not first < 1 < last else mpf(1)
        pow_ends += [first * inverse - 1, last * inverse - 1]
        high, low = split(-mpmath.log(inverse))
        pow_rows.append("{" + ", ".join(number(v) for v in (inverse, high, low)) + "}")

    def rest(r: mpf) -> mpf:
        return series(lambda k: (-r) ** k / (k + 3))

    def fitted(name: str, ends: Sequence[mpf], terms: int) -> list[str]:
        low, high = min(ends), max(ends)
        title = f"(log(1 + r) - r + r**2/2) / r**3, {float(low):.5f} <= r <= {float(high):.5f}"
        return polynomial(name, f"{title}, relative to r", rest, (low, high), terms, lambda r: r**2)

    return [
        f"/* 128 cells from {from_bits(LOG_OFFSET).hex()} on: a double c, a reciprocal of few",
        " * bits, and log(c) in two parts, the first a multiple of 2**-42. */",
        "static const struct { double centre, inverse, high, low; } LOG_TABLE[128] = {",
        *lines(log_rows, 1),
        "};",
        "/* The same cells with reciprocals 1/c of at most 11 bits, c no double, and log(c). */",
        "static const struct { double inverse, high, low; } POW_TABLE[128] = {",
        *lines(pow_rows, 1),
        "};",
        f"#define LOG_OFFSET 0x{LOG_OFFSET:016x}u",
        constant("LN2_HIGH", split(LN2)[0]),
        constant("LN2_LOW", split(LN2)[1]),
        *fitted("LOG_POLYNOMIAL", log_ends, 5),
        *fitted("POW_POLYNOMIAL", pow_ends, 6),
    ]


def split(value: mpf) -> tuple[mpf, mpf]:
    """Return the nearest multiple of 2**-42 and the rest."""
    high = leading(value, -42)
    return high, value - high


def log_point(first: mpf, last: mpf) -> tuple[mpf, mpf]:
    """Return a double c and nearly 1/c for a cell, so that (z - c) / c is nearly exact near 1.

    The error of the product with the reciprocal has two parts: that of the reciprocal and that of
    rounding. The latter is zero if the factors have at most 53 bits. The result minimises the sum
    of both relative to the cell's smallest logarithm.
    """
    if 1 - mpf(2) ** -9 <= last and first < 1:
        return mpf(1), mpf(1)
    best: tuple[mpf, mpf, mpf] | None = None
    middle = int(mpmath.nint(2048 / (first + last)))
    for numerator in range(middle - 6, middle + 7):
        inverse = mpf(numerator) / 1024
        centre = mpf(float(1 / inverse))
        distance = max(abs(first - centre), abs(last - centre))
        if distance * inverse > mpf("0.0046"):
            continue
        grid = mpmath.ldexp(1, -52 if first >= 1 else -53)
        odd_part = numerator // (numerator & -numerator)
        product_bits = mpmath.ceil(mpmath.log(distance / grid, 2)) + odd_part.bit_length()
        rounding = distance * inverse * mpmath.ldexp(1, -53) if product_bits > 53 else mpf(0)
        error = abs(centre * inverse - 1) * distance * inverse + rounding
        error /= min(abs(mpmath.log(first)), abs(mpmath.log(last)))
        if best is None or error < best[0]:
            best = (error, centre, inverse)
    if best is None:
        raise ArithmeticError("no reciprocal of 11 bits is near enough")
    return best[1], best[2]


def trigonometric() -> list[str]:
    """sin, cos and tan: values at multiples of pi/64, pi/64 in three parts, digits of 2/pi."""
    sines, tangents = [], []
    for k in range(-32, 32):
        high, low = pair(mpmath.sin(k * PI / 64) if k else mpf(0))
        cosine = mpf(0) if k == -32 else mpmath.cos(k * PI / 64)
        # With so few bits, the product with any number is exact.
        rough = mpmath.nint(2 * cosine) / 2
        values = (high, low, rough, cosine - rough)
        sines.append("{" + ", ".join(number(v) for v in values) + "}")
    for k in range(64):
        odd, part = divmod(k + 16, 32)
        part -= 16
        high, low = pair(mpmath.sign(part) if abs(part) == 16 else mpmath.tan(part * PI / 64))
        one = (mpf(1), mpf(0), -high)
        row = (-one[0], one[1], high, high, low, mpf(1)) if odd % 2 else (high, low, mpf(1), *one)
        tangents.append("{" + ", ".join(number(v) for v in row) + "}")
    step = PI / 64
    first = leading(step, -32)
    second = leading(step - first, -60)
    with mpmath.workprec(1500):
        digits = int(mpmath.floor(mpmath.ldexp(2 / +mpmath.pi, 64 * 19)))
        fraction = int(mpmath.floor(mpmath.ldexp(+mpmath.pi / 4, 128)))
    words = [0] + [(digits >> 64 * (18 - i)) & (2**64 - 1) for i in range(19)]
    reach = PI / 128 * mpf("1.0001")
    domain = (mpf(0), reach**2)
    return [
        "/* sin(k pi/64) in two parts, cos(k pi/64) as 0, 1/2 or 1 and the rest, k = -32..31. */",
        "static const struct { double high, low, rough_cosine, cosine_rest; } SIN_TABLE[64] = {",
        *lines(sines, 1),
        "};",
        "/* k = 0..63, T = high + low: high, low, 1, 1, 0, -high with T = tan(k pi/64) up to 1,",
        " * else -1, 0, high, high, low, 1 with T = -1/tan(k pi/64). */",
        "static const double TAN_TABLE[64][6] = {",
        *lines(tangents, 1),
        "};",
        constant("ANGLE_PER_STEP", 64 / PI),
        constant("ANGLE_STEP_1", first),
        constant("ANGLE_STEP_2", second),
        constant("ANGLE_STEP_3", step - first - second),
        "/* 2/pi: 64 zeros, then its first 1,216 binary digits. */",
        "static const uint64_t TWO_OVER_PI[20] = {",
        *lines([f"0x{w:016x}u" for w in words], 4),
        "};",
        "/* pi/4 times 2**128. */",
        f"static const uint64_t QUARTER_PI[2] = {{0x{fraction >> 64:016x}u, "
        f"0x{fraction & (2**64 - 1):016x}u}};",
        *polynomial(
            "SIN_POLYNOMIAL",
            "(sin(r) - r) / r**3 in u = r**2, |r| <= pi/128, relative to r",
            lambda u: series(lambda k: (-1) ** (k + 1) * u**k / mpmath.factorial(2 * k + 3)),
            domain,
            3,
            lambda u: u,
        ),
        *polynomial(
            "COS_POLYNOMIAL",
            "(cos(r) - 1) / r**2 in u = r**2, |r| <= pi/128, absolute",
            lambda u: series(lambda k: (-1) ** (k + 1) * u**k / mpmath.factorial(2 * k + 2)),
            domain,
            3,
            lambda u: u,
        ),
        *polynomial(
            "TAN_POLYNOMIAL",
            "(tan(r) - r) / r**3 in u = r**2, |r| <= pi/128, relative to r",
            odd_rest(mpmath.tan, mpf(1) / 3),
            domain,
            4,
            lambda u: u,
        ),
    ]


def arctangent() -> list[str]:
    """atan: values at the centres of 16 cells for each power of 2 from 1/16 to 64."""
    rows = []
    for power in range(-4, 6):
        for i in range(16):
            high, low = pair(mpmath.atan(mpmath.ldexp(1 + (mpf(i) + 0.5) / 16, power)))
            rows.append(f"{{{number(high)}, {number(low)}}}")
    half = pair(PI / 2)

    def rest(u: mpf) -> mpf:
        return series(lambda k: (-1) ** (k + 1) * u**k / (2 * k + 3))

    title = "(atan(r) - r) / r**3 in u = r**2, |r| <= 1/{}, relative to r"
    return [
        "/* atan(c) in two parts, c the centres of 16 cells a power of 2, from 1/16 to 64. */",
        "static const struct { double high, low; } ATAN_TABLE[160] = {",
        *lines(rows, 2),
        "};",
        constant("HALF_PI_HIGH", half[0]),
        constant("HALF_PI_LOW", half[1]),
        *polynomial(
            "ATAN_POLYNOMIAL", title.format(64), rest, (mpf(0), mpf(1) / 4096), 3, lambda u: u
        ),
        *polynomial(
            "ATAN_SMALL_POLYNOMIAL",
            title.format(16),
            rest,
            (mpf(0), mpf(1) / 256),
            6,
            lambda u: u,
        ),
    ]


def hyperbolic() -> list[str]:
    """tanh: values at the centres of 32 cells for each power of 2 from 1/8 to 16, and 7 more."""
    rows = []
    for i in range(231):
        value = mpmath.tanh(mpmath.ldexp(1 + (mpf(i % 32) + 0.5) / 32, i // 32 - 3))
        high, low = pair(value)
        rows.append(f"{{{number(high)}, {number(low)}, {number(1 - value**2)}}}")

    def weight(u: mpf) -> mpf:
        # A step d is at most 1/64 of x; its weight is (1 - tanh(x)**2) d / tanh(x).
        d = mpmath.sqrt(u)
        x = max(64 * d, mpf(1) / 8)
        return u * (1 - mpmath.tanh(x) ** 2) * d / mpmath.tanh(x)

    rest = odd_rest(mpmath.tanh, -mpf(1) / 3)
    return [
        "/* tanh(c) in two parts and 1 - tanh(c)**2, c the centres of 32 cells for each power of 2",
        " * from 1/8 on. */",
        "static const struct { double high, low, slope; } TANH_TABLE[231] = {",
        *lines(rows, 1),
        "};",
        *polynomial(
            "TANH_POLYNOMIAL",
            "(tanh(d) - d) / d**3 in u = d**2, |d| <= 1/4, relative to tanh(64 d)",
            rest,
            (mpf(0), mpf(1) / 16),
            4,
            weight,
        ),
        *polynomial(
            "TANH_SMALL_POLYNOMIAL",
            "(tanh(x) - x) / x**3 in u = x**2, |x| <= 1/8, relative to x",
            rest,
            (mpf(0), mpf(1) / 64),
            6,
            lambda u: u,
        ),
    ]


# Values and their parts


def series(term: Callable[[int], mpf]) -> mpf:
    """Return the sum of a series whose first 32 terms give all digits."""
    return mpmath.fsum(term(k) for k in range(32))


def odd_rest(function: Function, at_zero: mpf) -> Function:
    """Return (function(r) - r) / r**3 as a function of u = r**2."""

    def rest(u: mpf) -> mpf:
        with mpmath.workprec(480):
            r = mpmath.sqrt(u)
            return (function(r) - r) / (u * r) if u > mpmath.ldexp(1, -100) else at_zero

    return rest


def leading(value: mpf, exponent: int) -> mpf:
    """Return the nearest multiple of 2**exponent."""
    return mpmath.ldexp(mpmath.nint(mpmath.ldexp(value, -exponent)), exponent)


def pair(value: mpf) -> tuple[mpf, mpf]:
    """Return the nearest double, and the double nearest to the remainder."""
    high = mpf(float(value))
    return high, mpf(float(value - high))


def to_bytes(value: float) -> bytes:
    """Return the bits of a double, with the sign's bit first."""
    return struct.pack(">d", value)


def from_bits(bits: int) -> float:
    """Return the double with these bits."""
    return float(struct.unpack(">d", bits.to_bytes(8, "big"))[0])


# Minimax polynomials


def polynomial(
    name: str,
    title: str,
    function: Function,
    domain: tuple[mpf, mpf],
    terms: int,
    weight: Function,
) -> list[str]:
    """Return the lines that define a polynomial, with its error."""
    points = chebyshev(domain, 200)
    values = [function(x) for x in points]
    weights = [weight(x) for x in points]
    coefficients: list[mpf] = []
    for count in range(terms, 0, -1):
        coefficients.append(mpf(float(remez(points, values, weights, count)[0])))
        # The remainder is divided by x, and fitted with one term less.
        kept = [i for i in range(len(points)) if points[i] != 0]
        values = [(values[i] - coefficients[-1]) / points[i] for i in kept]
        weights = [weights[i] * abs(points[i]) for i in kept]
        points = [points[i] for i in kept]
    worst = max(
        abs(weight(x) * (function(x) - value_at(coefficients, x))) for x in chebyshev(domain, 601)
    )
    return [
        f"/* {title}: error 2**{float(mpmath.log(worst, 2)):.1f}. */",
        f"static const double {name}[{len(coefficients)}] = {{",
        *lines([number(c) for c in coefficients], 3),
        "};",
    ]


def value_at(coefficients: Sequence[mpf], x: mpf) -> mpf:
    """Return a polynomial's value; the constant coefficient comes first."""
    value = mpf(0)
    for coefficient in reversed(coefficients):
        value = value * x + coefficient
    return value


def chebyshev(domain: tuple[mpf, mpf], count: int) -> list[mpf]:
    """Return points between two ends, dense at both."""
    low, high = domain
    return [
        (low + high) / 2 - (high - low) / 2 * mpmath.cospi(mpf(i) / (count - 1))
        for i in range(count)
    ]


def remez(
    points: Sequence[mpf], values: Sequence[mpf], weights: Sequence[mpf], terms: int
) -> list[mpf]:
    """Return the coefficients that minimise the largest weighted error on the points."""
    used = [i for i in range(len(points)) if weights[i] != 0]
    count = terms + 1
    chosen = [used[round(k * (len(used) - 1) / (count - 1))] for k in range(count)]
    for _ in range(60):
        rows = [
            [points[i] ** p for p in range(terms)] + [(-1) ** k / weights[i]]
            for k, i in enumerate(chosen)
        ]
        solution = list(
            mpmath.lu_solve(mpmath.matrix(rows), mpmath.matrix([values[i] for i in chosen]))
        )
        level = abs(solution.pop())
        errors = {i: weights[i] * (values[i] - value_at(solution, points[i])) for i in used}
        if max(abs(e) for e in errors.values()) <= level * (1 + mpf(2) ** -30):
            break
        chosen = alternating(errors, count)
    return solution


def alternating(errors: dict[int, mpf], count: int) -> list[int]:
    """Return `count` positions of the largest errors between changes of sign."""
    places: list[int] = []
    for i, error in errors.items():
        if places and (errors[places[-1]] > 0) == (error > 0):
            if abs(error) > abs(errors[places[-1]]):
                places[-1] = i
        else:
            places.append(i)
    while len(places) > count:
        # The end with the smaller error is removed.
        del places[0 if abs(errors[places[0]]) < abs(errors[places[-1]]) else -1]
    if len(places) < count:
        raise ArithmeticError(f"{len(places)} extrema for {count}")
    return places


# C text


def number(value: mpf) -> str:
    """Return the nearest double as an exact C literal."""
    return float(value).hex()


def constant(name: str, value: mpf) -> str:
    """Return the line that defines a constant."""
    return f"#define {name} {number(value)}"


def lines(items: Sequence[str], per_line: int) -> list[str]:
    """Return items as lines of a list."""
    return [
        "    " + ", ".join(items[i : i + per_line]) + "," for i in range(0, len(items), per_line)
    ]


if __name__ == "__main__":
    sys.exit(main())
