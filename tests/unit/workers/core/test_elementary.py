"""Elementary functions of our own: near the true values, with the same bits however built."""

import ctypes
import hashlib
import platform
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path

import mpmath
import numpy as np
import pytest
from mpmath import mpf

ROOT = Path(__file__).resolve().parents[4]
SOURCE = ROOT / "workers" / "core" / "elementary.c"
NAMES = ("exp", "expm1", "log", "pow", "sin", "cos", "tan", "atan", "tanh")
TRUE: dict[str, Callable[..., mpf]] = {
    n: getattr(mpmath, "power" if n == "pow" else n) for n in NAMES
}
INF, NAN = float("inf"), float("nan")

# Of what `each` writes for the arguments of `drawn(name, 100_000)`: the same on every processor.
HASHES: dict[str, str] = {
    "exp": "66625a6ef3b928ac",
    "expm1": "171e463bf6faa678",
    "log": "b5f01fa8eacc463e",
    "pow": "af7496a2367ed6c6",
    "sin": "92fbfde371459ffb",
    "cos": "561ff621b1dc15fe",
    "tan": "ef2898e8e3052d1a",
    "atan": "67b0ab40c5df9911",
    "tanh": "593af544183aa677",
}

# Calls each function for many arguments; pow alone takes the second ones.
EACH = """
#include <stddef.h>
#include "elementary.h"
static double (*const functions[])(double) = {
    ce_exp, ce_expm1, ce_log, NULL, ce_sin, ce_cos, ce_tan, ce_atan, ce_tanh};
void each(int which, long count, const double *x, const double *y, double *results)
{
    for (long i = 0; i < count; i++)
        results[i] = functions[which] ? functions[which](x[i]) : ce_pow(x[i], y[i]);
}
"""
Arguments = tuple[np.ndarray, np.ndarray]


class Library:
    """The functions, built with some options."""

    def __init__(self, folder: Path, *options: str) -> None:
        compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
        if compiler is None:
            pytest.skip("the elementary functions are tested where there is a C compiler")
        (folder / "each.c").write_text(EACH)
        binary = folder / f"elementary{len(list(folder.iterdir()))}.so"
        command = [
            compiler,
            "-std=c11",
            "-Wall",
            "-Wextra",
            "-Werror",
            "-ffp-contract=off",
            *options,
        ]
        command += ["-fPIC", "-shared", f"-I{SOURCE.parent}", str(SOURCE), str(folder / "each.c")]
        subprocess.run([*command, "-o", str(binary)], check=True)
        self._each = ctypes.CDLL(str(binary)).each

    def __call__(self, name: str, x: np.ndarray, y: np.ndarray | None = None) -> np.ndarray:
        x = np.ascontiguousarray(x, dtype=float)
        y = np.zeros_like(x) if y is None else np.ascontiguousarray(y, dtype=float)
        results = np.empty_like(x)
        addresses = [ctypes.c_void_p(a.ctypes.data) for a in (x, y, results)]
        self._each(NAMES.index(name), ctypes.c_long(len(x)), *addresses)
        return results


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Library:
    return Library(tmp_path_factory.mktemp("elementary"), "-O2")


# Arguments: made by operations that have the same bits everywhere


class Draws:
    """Numbers from PCG64's raw bits, which NumPy promises to keep."""

    def __init__(self, seed: int) -> None:
        self._bits = np.random.PCG64(seed)

    def uniform(self, low: float, high: float, count: int) -> np.ndarray:
        fractions = (self._bits.random_raw(count) >> np.uint64(11)).astype(float) * 2.0**-53
        return low + (high - low) * fractions

    def integers(self, low: int, high: int, count: int) -> np.ndarray:
        span = np.uint64(high - low + 1)
        return low + ((self._bits.random_raw(count) >> np.uint64(11)) % span).astype(int)

    def scaled(self, low: int, high: int, count: int) -> np.ndarray:
        """Return numbers of any sign with any exponent between two."""
        signs = 2.0 * self.integers(0, 1, count) - 1.0
        return signs * np.ldexp(self.uniform(1.0, 2.0, count), self.integers(low, high, count))


# Where each function is interesting: one interval, a smaller one, and powers of 2.
RANGES = {
    "exp": ((-746.0, 710.0), (-1.0, 1.0), (-60, 9)),
    "expm1": ((-40.0, 40.0), (-0.125, 0.125), (-60, 9)),
    "log": ((0.0, 1e3), (0.5, 2.0), (-1074, 1023)),
    "sin": ((-100.0, 100.0), (-2.0, 2.0), (-60, 1023)),
    "cos": ((-100.0, 100.0), (-2.0, 2.0), (-60, 1023)),
    "tan": ((-100.0, 100.0), (-2.0, 2.0), (-60, 1023)),
    "atan": ((-10.0, 10.0), (-0.125, 0.125), (-60, 60)),
    "tanh": ((-20.0, 20.0), (-0.25, 0.25), (-60, 5)),
}


def drawn(name: str, count: int) -> Arguments:
    """Return arguments: a third each from an interval, a smaller one, and of any size."""
    draws, third = Draws(NAMES.index(name)), count // 3
    if name == "pow":
        return drawn_for_pow(draws, third)
    wide, narrow, powers = RANGES[name]
    scaled = draws.scaled(*powers, count - 2 * third)
    x = [draws.uniform(*wide, third), draws.uniform(*narrow, third), scaled]
    if name == "log":
        x[2] = abs(x[2])
        x += [1.0 + draws.scaled(-52, -3, third)]
    return np.concatenate(x)[:count] if name != "log" else thinned(x, count), np.zeros(count)


def thinned(parts: Sequence[np.ndarray], count: int) -> np.ndarray:
    """Return `count` of all, each part with the same share."""
    share = -(-count // len(parts))
    return np.concatenate([part[:share] for part in parts])[:count]


def drawn_for_pow(draws: Draws, third: int) -> Arguments:
    """Return bases of any size, near 1, and very near 1, with results over the whole range."""
    exponents = draws.integers(-1074, 1023, third)
    any_size = np.ldexp(draws.uniform(1.0, 2.0, third), exponents)
    near = draws.uniform(0.5, 2.0, third)
    bits = draws.integers(3, 50, third)
    nearer = 1.0 + np.ldexp(draws.uniform(-1.0, 1.0, third), -bits)
    powers = [
        draws.uniform(-1100.0, 1100.0, third) / (abs(exponents) + 1.0),
        draws.uniform(-1500.0, 1500.0, third),
        np.ldexp(draws.uniform(-1500.0, 1500.0, third), bits),
    ]
    return np.concatenate([any_size, near, nearer]), np.concatenate(powers)


def hard(name: str) -> np.ndarray:
    """Return arguments on both sides of where a function's method changes, and hard ones."""
    centres: list[float] = []
    if name in ("sin", "cos", "tan"):
        with mpmath.workprec(1300):
            multiples = [*range(1, 400), *(2**k + j for k in range(9, 1020, 3) for j in (0, 1))]
            centres += [float(k * mpmath.pi / 2) for k in multiples]
            centres += [float(k * mpmath.pi / 128) for k in range(1, 260)]
        # Nearest of all doubles to a multiple of pi/2 (J.-M. Muller, Elementary Functions).
        centres += [6381956970095103.0 * 2.0**797, 2.0**-27, 2.0**20, 1.7e308, 2.0**1023]
    elif name in ("exp", "expm1"):
        step = float(mpmath.log(2) / 256)
        centres += [k * step for k in range(-400, 400)]
        centres += [2.0**-54, 1 / 16, 32.0, 64.0, -37.43, 512.0, -512.0, 709.78, -708.4, -745.13]
    elif name == "log":
        offset = 0x3FE6700000000000
        centres += [of_bits(offset + (i << 45)) for i in range(129)]
        centres += [1.0, 2.0**-1022, 1.75 * 2.0**1023, *np.linspace(0.97, 1.03, 2000).tolist()]
    elif name == "atan":
        centres += [of_bits(i << 48) for i in range(0x3FB0, 0x4051)] + [2.0**-27, 1e17]
    elif name == "tanh":
        centres += [of_bits(i << 47) for i in range(0x7F80, 0x7F80 + 232)] + [2.0**-27, 19.0625]
    return np.array([x for c in centres for x in (np.nextafter(c, -INF), c, np.nextafter(c, INF))])


def of_bits(bits: int) -> float:
    return float(struct.unpack("<d", struct.pack("<Q", bits))[0])


# Errors


def error(name: str, result: float, arguments: Sequence[float]) -> float:
    """Return how far a result is from the true value, in units in its last place."""
    with mpmath.workprec(120):
        true = TRUE[name](*map(mpf, arguments))
        _, exponent = mpmath.frexp(true)
        unit = mpmath.ldexp(1, max(int(exponent) - 53, -1074))
        if abs(result) == INF:
            # What would be the next double if there were larger ones.
            result_ = mpmath.ldexp(mpmath.sign(result), 1024)
            return 0.0 if abs(true) >= abs(result_) else float(abs(true - result_) / unit)
        return float(abs(true - mpf(result)) / unit)


def worst(name: str, built: Library, arguments: Arguments) -> float:
    """Return the largest error."""
    x, y = arguments
    pairs = zip(x.tolist(), y.tolist(), strict=True)
    errors = [
        error(name, result, pair if name == "pow" else pair[:1])
        for result, pair in zip(built(name, x, y).tolist(), pairs, strict=True)
    ]
    return max(errors)


@pytest.mark.parametrize("name", NAMES)
def test_errors_are_little_above_half_a_unit_in_the_last_place(
    built: Library, name: str, record_property: Callable[[str, object], None]
) -> None:
    x, y = drawn(name, 18_000)
    extra = hard(name)
    largest = worst(name, built, (np.append(x, extra), np.append(y, np.zeros(len(extra)))))
    record_property(f"{name}_ulp", largest)
    print(f"{name}: {largest:.4f} ulp")
    # The largest one of log is known, and where: next but one to 1 of its cells.
    assert largest < (0.63 if name == "log" else 0.58)


def test_subnormal_results_are_rounded_once(built: Library) -> None:
    x = np.linspace(-745.2, -708.3, 2000)
    assert worst("exp", built, (x, x)) < 0.51
    y = np.linspace(-1074.9, -1021.9, 2000)
    assert worst("pow", built, (np.full(2000, 2.0), y)) < 0.51
    assert built("pow", [2.0, -2.0], [-1074.0, -1073.0]).tolist() == [5e-324, -1e-323]


def test_powers_that_are_doubles_are_exact(built: Library) -> None:
    for base in (2, 3, 5, 10, 7, 1.5, 0.75, -3, -1.25):
        for exponent in range(-20, 53):
            true = Fraction(base) ** exponent
            if Fraction(float(true)) == true:
                assert built("pow", [base], [exponent]).item() == float(true)
    assert built("pow", [4.0, 2.25, 1e-300], [0.5, 1.5, 1.0]).tolist() == [2.0, 3.375, 1e-300]


# Special values (C11, annex F)

SPECIAL = {
    "exp": [(0.0, 1.0), (-0.0, 1.0), (INF, INF), (-INF, 0.0), (710.0, INF), (-746.0, 0.0)],
    "expm1": [(0.0, 0.0), (-0.0, -0.0), (INF, INF), (-INF, -1.0), (710.0, INF), (-50.0, -1.0)],
    "log": [(0.0, -INF), (-0.0, -INF), (1.0, 0.0), (-1.0, NAN), (INF, INF), (-INF, NAN)],
    "sin": [(0.0, 0.0), (-0.0, -0.0), (INF, NAN), (-INF, NAN), (5e-324, 5e-324)],
    "cos": [(0.0, 1.0), (-0.0, 1.0), (INF, NAN), (-INF, NAN), (5e-324, 1.0)],
    "tan": [(0.0, 0.0), (-0.0, -0.0), (INF, NAN), (-INF, NAN), (-5e-324, -5e-324)],
    "atan": [(0.0, 0.0), (-0.0, -0.0), (INF, float(np.pi / 2)), (-INF, float(-np.pi / 2))],
    "tanh": [(0.0, 0.0), (-0.0, -0.0), (INF, 1.0), (-INF, -1.0), (20.0, 1.0), (1e308, 1.0)],
}  # fmt: skip


def bits(values: Sequence[float] | np.ndarray) -> list[str]:
    return [struct.pack(">d", v).hex() for v in np.asarray(values, dtype=float).tolist()]


NAN_BITS = "7ff8000000000000"


@pytest.mark.parametrize("name", SPECIAL)
def test_special_values(built: Library, name: str) -> None:
    x = np.array([x for x, _ in SPECIAL[name]])
    assert bits(built(name, x)) == bits([result for _, result in SPECIAL[name]])
    nans = np.array([0x7FF8000000000001, 0xFFF8000000000000, 0x7FF0000000000001], dtype=np.uint64)
    assert bits(built(name, nans.view(float))) == [NAN_BITS] * 3


def special_power(x: float, y: float) -> float | None:
    """Return x**y where C11, F.10.4.4 says what it is."""
    odd = abs(y) < 2.0**53 and y % 2.0 == 1.0
    result: float | None = None
    if y == 0.0 or x == 1.0:
        result = 1.0
    elif x != x or y != y:
        result = NAN
    elif abs(y) == INF:
        result = 1.0 if x == -1.0 else INF if (abs(x) > 1.0) == (y > 0.0) else 0.0
    elif x == 0.0 or abs(x) == INF:
        result = INF if (x == 0.0) == (y < 0.0) else 0.0
        result = float(np.copysign(result, x)) if odd else result
    elif x < 0.0 and y != np.floor(y):
        result = NAN
    return result


def test_special_powers(built: Library) -> None:
    numbers = [0.0, 1.0, 2.0, 3.0, 0.5, 1.5, 1e-320, 1e300, 2.0**53, 2.0**53 - 1.0, 2.0**70, INF]
    values = [sign * v for v in numbers for sign in (1.0, -1.0)] + [NAN]
    x, y = (a.ravel() for a in np.meshgrid(values, values))
    results = built("pow", x, y)
    for x_, y_, result in zip(x.tolist(), y.tolist(), results.tolist(), strict=True):
        expected = special_power(x_, y_)
        if expected is None:
            # Left are finite ones: the magnitude is that of |x|, the sign y's parity's.
            expected = built("pow", [abs(x_)], [y_]).item()
            expected = -expected if x_ < 0.0 and abs(y_) < 2.0**53 and y_ % 2.0 else expected
        assert bits([result]) == bits([expected]), (x_, y_)


# Properties


@pytest.mark.parametrize("name", ["sin", "tan", "atan", "tanh", "cos"])
def test_odd_functions_are_odd_and_cos_is_even(built: Library, name: str) -> None:
    x = np.append(drawn(name, 30_000)[0], hard(name))
    sign = 1.0 if name == "cos" else -1.0
    assert bits(built(name, -x)) == bits(sign * built(name, x))


@pytest.mark.parametrize("name", ["exp", "expm1", "log", "atan", "tanh"])
def test_results_never_fall_where_the_method_changes(built: Library, name: str) -> None:
    around = np.arange(-300, 301)
    for centre in hard(name)[1::3].tolist():
        if abs(centre) > 1e-300:
            x = np.sort((np.array([centre]).view(np.int64) + around).view(float))
            assert (np.diff(built(name, x)) >= 0.0).all(), centre


def test_sine_tangent_and_power_never_fall_where_they_rise(built: Library) -> None:
    """Where a function is so flat that hundreds of arguments share a result, it may."""
    around = np.arange(-300, 301)
    for k in range(1, 64):
        x = (np.array([k * np.pi / 128.0]).view(np.int64) + around).view(float)
        assert k > 56 or (np.diff(built("sin", x)) >= 0.0).all(), k
        assert k < 8 or (np.diff(built("cos", x)) <= 0.0).all(), k
        assert (np.diff(built("tan", x)) >= 0.0).all(), k
    for centre in hard("log")[1::3].tolist():
        x = (np.array([centre]).view(np.int64) + around).view(float)
        x = x[x >= 2.0**-1022]
        assert (np.diff(built("pow", x, np.full(len(x), 0.7))) >= 0.0).all(), centre


# The same bits


def hash_of(library: Library, name: str) -> str:
    results = library(name, *drawn(name, 100_000))
    return hashlib.sha256(results.astype("<f8").tobytes()).hexdigest()[:16]


def variants() -> list[tuple[str, ...]]:
    fused = [("-O3", "-mfma", "-mavx2")] if platform.machine() in ("x86_64", "AMD64") else []
    return [("-O0",), ("-O1",), ("-O2",), ("-O3",), ("-O2", "-DCE_WITHOUT_INT128"), *fused]


@pytest.mark.parametrize("options", variants(), ids=" ".join)
def test_bits_are_those_recorded_however_built(tmp_path: Path, options: tuple[str, ...]) -> None:
    library = Library(tmp_path, *options)
    assert {name: hash_of(library, name) for name in NAMES} == HASHES


def test_tables_are_what_the_script_writes() -> None:
    script = ROOT / "scripts" / "elementary_coefficients.py"
    done = subprocess.run([sys.executable, str(script), "--check"], capture_output=True, text=True)
    assert done.stdout == "the same\n"


def test_no_function_has_more_than_8_kb_of_tables(tmp_path: Path) -> None:
    header = (SOURCE.parent / "elementary_tables.h").read_text()
    names = [line.split("[")[0].split()[-1] for line in header.splitlines() if "] = {" in line]
    (tmp_path / "sizes.c").write_text(
        '#include "elementary_tables.h"\nunsigned long sizes[] = {'
        + ", ".join(f"sizeof {n}" for n in names)
        + "};\n"
    )
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        pytest.skip("sizes are those that a C compiler says")
    binary = tmp_path / "sizes.so"
    command = [compiler, "-w", "-shared", "-fPIC", f"-I{SOURCE.parent}", str(tmp_path / "sizes.c")]
    subprocess.run([*command, "-o", str(binary)], check=True)
    sizes = (ctypes.c_ulong * len(names)).in_dll(ctypes.CDLL(str(binary)), "sizes")
    size = dict(zip(names, sizes, strict=True))
    assert size["POW_TABLE"] + size["EXP_TABLE"] < 8000
    assert all(value < 8000 for value in size.values())
