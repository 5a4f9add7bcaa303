"""The law of each form of the library is true of its equation, and no other law is."""

import math
from collections.abc import Callable, Mapping

import numpy as np
import pytest

from workers.effects.forms import FORMS, EffectForm
from workers.effects.laws import Law

Function = Callable[..., np.ndarray]
Values = Mapping[str, float]
NUMPY = {
    "abs": np.abs, "sign": np.sign, "sqrt": np.sqrt, "exp": np.exp, "sin": np.sin, "cos": np.cos,
    "tanh": np.tanh, "min": np.minimum, "max": np.maximum, "where": np.where,
}  # fmt: skip
X = np.array([0.3, 0.7, 1.1, 2.6, 5.0])
FAR = np.array([200.0, 400.0])


def same(one, other) -> bool:
    return bool(np.allclose(one, other, rtol=1e-9, atol=1e-12))


def is_power(f: Function, exponent: float, sign: float) -> bool:
    """c + k |x|^p on the right; on the left the same, the opposite, or nothing."""
    added = lambda x: f(x) - f(0.0 * x)  # noqa: E731
    grows = same(added(2.0 * X), 2.0**exponent * added(X)) and not same(added(X), 0.0)
    return grows and same(added(-X), sign * added(X))


def is_other_power(h: Function) -> bool:
    """Its exponent is none of those that have laws of their own."""
    known = np.log2(np.abs(h(2.0 * X) / h(X)))
    return np.ptp(known) < 1e-9 and not any(
        same(known[0], own) for own in (0.0, 0.5, 1.0, 2.0, 3.0)
    )


def is_exponential(h: Function) -> bool:
    return np.ptp(h(X + 0.5) / h(X)) < 1e-9 and not same(h(X + 0.5), h(X))


def is_affine(y: Function) -> bool:
    """With a slope and a value at zero."""
    slopes = np.diff(y(X)) / np.diff(X)
    return bool(np.ptp(slopes) < 1e-6 and abs(slopes[0]) > 1e-3 and abs(y(1e-3 * X)[0]) > 1e-3)


def is_ramp(f: Function, at: float, way: float) -> bool:
    """Zero up to a place, and linear from there on."""
    beyond = f(at + 2.0 * way * X)
    flat = same(f(at - way * X), 0.0)
    return flat and same(beyond, 2.0 * f(at + way * X)) and not same(beyond, 0.0)


def is_odd(f: Function) -> bool:
    return same(f(-X), -f(X))


def ends_flat(f: Function) -> bool:
    ends = f(FAR), f(-FAR)
    return (
        all(same(end, end[0]) and not same(end, 0.0) for end in ends) and ends[0][0] != ends[1][0]
    )


def ends_as_it_is(f: Function) -> bool:
    return same(f(FAR), FAR) and same(f(-FAR), -FAR)


def is_switch(f: Function, width: float) -> bool:
    """Half of its level is reached where a tanh of this width does."""
    return ends_flat(f) and is_odd(f) and same(f(np.arctanh(0.5) * width), 0.5 * f(FAR[0]))


CLAIMS: dict[Law, Callable[[Function, Values], bool]] = {
    Law.CONSTANT: lambda f, c: same(f(X), f(-X[::-1])) and not same(f(X), 0.0),
    Law.LINEAR: lambda f, c: is_power(f, 1.0, -1.0),
    Law.ABSOLUTE: lambda f, c: is_power(f, 1.0, 1.0),
    Law.SQUARE: lambda f, c: is_power(f, 2.0, 1.0),
    Law.ODD_SQUARE: lambda f, c: is_power(f, 2.0, -1.0),
    Law.CUBE: lambda f, c: is_power(f, 3.0, -1.0),
    Law.ROOT: lambda f, c: is_power(f, 0.5, 0.0),
    Law.ODD_ROOT: lambda f, c: is_power(f, 0.5, -1.0),
    Law.POWER: lambda f, c: is_other_power(f) or is_other_power(lambda x: f(x) + 1.0),
    Law.INVERSE: lambda f, c: is_power(lambda x: 1.0 / (f(x) + 1.0), 1.0, -1.0),
    Law.INVERSE_SQUARE: lambda f, c: is_power(lambda x: 1.0 / (f(x) + 1.0), 2.0, 1.0),
    Law.EXPONENTIAL: lambda f, c: is_exponential(f) or is_exponential(lambda x: f(x) + 1.0),
    Law.SATURATING: lambda f, c: is_affine(lambda u: 1.0 / f(1.0 / u)),
    Law.HILL: lambda f, c: is_affine(lambda u: 1.0 / f(1.0 / np.sqrt(u))),
    Law.HILL_POWER: lambda f, c: {"n", "half"} <= set(c)
    and is_affine(lambda u: 1.0 / f(u ** (-1.0 / c["n"]))),
    Law.ARRHENIUS: lambda f, c: "zero" in c
    and any(
        is_affine(lambda u, one=one: np.log(f(1.0 / u - c["zero"]) + one)) for one in (0.0, 1.0)
    ),
    Law.OFFSET_POWER: lambda f, c: is_other_power(lambda x: f(x) - f(0.0 * x))
    and not same(f(0.0 * X), 0.0)
    and not is_other_power(lambda x: f(x) + 1.0)
    and same(f(X), f(-X)),
    Law.CUT_OFF: lambda f, c: ends_as_it_is(f)
    and bool(np.abs(f(0.3 * c.get("at", 0.0) * np.linspace(-1.0, 1.0, 9))).max() < 1e-6),
    Law.ABOVE: lambda f, c: is_ramp(f, c.get("at", 0.0), 1.0),
    Law.BELOW: lambda f, c: is_ramp(f, c.get("at", 0.0), -1.0),
    Law.ABOVE_BY_POWER: lambda f, c: "at" in c
    and same(f(c["at"] - X), 0.0)
    and is_other_power(lambda x: f(c["at"] + x)),
    Law.GAP: lambda f, c: "at" in c
    and same(f(c["at"] * np.linspace(-1.0, 1.0, 9)), 0.0)
    and is_odd(f)
    and same(f(c["at"] + 2.0 * X), 2.0 * f(c["at"] + X)),
    Law.CLIPPED: lambda f, c: "at" in c
    and ends_flat(f)
    and is_odd(f)
    and same(f(0.5 * c["at"]), 0.5 * f(FAR[0])),
    Law.SWITCH: lambda f, c: is_switch(f, c.get("width", math.nan)),
    Law.SWITCH_WITH_PEAK: lambda f, c: ends_flat(f)
    and is_odd(f)
    and bool(np.abs(f(np.linspace(0.0, 4.0, 99))).max() > 1.05 * abs(f(FAR[0]))),
    Law.TWO_SWITCHES: lambda f, c: ends_flat(f)
    and f(FAR[0]) * f(-FAR[0]) < 0.0
    and not same(f(FAR[0]), -f(-FAR[0])),
    Law.PERIODIC: lambda f, c: "n" in c
    and same(f(X + 2.0 * np.pi / c["n"]), f(X))
    and not same(f(X), f(X[::-1])),
}  # fmt: skip
"""Of a function of one variable; no function of the library has two of them."""

OF_SIGNALS = {
    Law.OFFSET: (Law.CONSTANT, False), Law.GAIN: (Law.LINEAR, False),
    Law.GAIN_OF_MAGNITUDE: (Law.ABSOLUTE, False), Law.ASYMMETRY: (Law.ABOVE, False),
    Law.QUADRATIC_PART: (Law.SQUARE, False), Law.CUBIC_PART: (Law.CUBE, False),
    Law.POWER_CHARACTERISTIC: (Law.POWER, True), Law.LEVELLING: (Law.SATURATING, True),
    Law.DEAD_ZONE: (Law.GAP, True), Law.SATURATION: (Law.CLIPPED, True),
    Law.LIMIT_ABOVE: (Law.ABOVE, False), Law.LIMIT_BELOW: (Law.BELOW, False),
    Law.CUT_OFF: (Law.CUT_OFF, True), Law.PERIODIC_ERROR: (Law.PERIODIC, False),
}  # fmt: skip
"""The law of what a signal becomes, or of what it is changed by: a limit from above takes away what
is beyond it."""

STATES = {
    Law.LAGGED: (("0", "v"), "v"), Law.DELAYED: (("v", "0", "0", "0"), "v"),
    Law.LAGGED_SQUARE: (("0",), "v^2"),
    Law.PERIODIC_TRAVEL: (("0",), ""), Law.HYSTERESIS: (("0",), ""),
    Law.HYSTERESIS_OF_SIGNAL: (("s", "0"), "s"),
    Law.FIRST_ORDER_LAG: (("s",), "s"), Law.FIRST_ORDER_LAG_FROM_ZERO: (("0",), "s"),
    Law.STORE: (("v",), "v"), Law.STORE_FROM_ZERO: (("0",), "v"),
    Law.STORE_FROM_ELSEWHERE: (("0", "1"), "v"), Law.TWO_STORES: (("v", "v"), "v"),
    Law.TWO_STORES_FROM_ZERO: (("0", "0"), "v"), Law.TWO_LAGS: (("v", "v"), "v"),
    Law.DECAY: (("1",), "0"), Law.RESONANCE: (("0", "0"), "v"), Law.LEAD: (("s",), "s"),
    Law.SECOND_ORDER_LAG: (("s", "0"), "s"), Law.SECOND_ORDER_LAG_FROM_ZERO: (("0", "0"), "s"),
}  # fmt: skip
"""Where states may start, and where the first one stands still."""

MEMORIES = {
    Law.BACKLASH: "backlash", Law.RATE_LIMIT: "rate_limit", Law.DELAY: "delay",
    Law.RATE_LIMIT_FROM_REST: "rate_limit_from_rest",
}  # fmt: skip
FREE = (Law.CURVE, Law.CHARACTERISTIC, Law.SWITCH_BY_CURVE)
FILTERS = (Law.DYNAMICS, Law.EXCHANGE, Law.SIGNAL_DYNAMICS)


def coefficients(form: EffectForm) -> dict[str, float]:
    """Return one value for each, all different; switches are narrow."""
    made = {c.name: 0.6 + 0.13 * i for i, c in enumerate(form.coefficients)}
    return made | ({"width": 0.05} if "tanh" in form.equation else {})


def read(form: EffectForm, text: str, *over: str, whole: bool = False) -> Function:
    """Return what a text of a form says, over some names; the change alone where it is `s + ...`.

    At a parameter it is the share by which that changes.
    """
    code, known = compile(text.replace("^", "**"), form.name, "eval"), coefficients(form)

    def value(*given: np.ndarray) -> np.ndarray:
        at = known | {"s": np.ones_like(given[0])} | dict(zip(over, given, strict=True))
        with np.errstate(all="ignore"):
            said = eval(code, {"__builtins__": {}}, NUMPY | at) + 0.0 * given[0]
        changed = form.kinds[0] in ("input", "output", "parameter") and not whole
        return said - at["s"] if changed else said

    return value


def having(kept: Callable[[EffectForm], bool]) -> list:
    return [pytest.param(f, id=f"{kind} {name}") for (kind, name), f in FORMS.items() if kept(f)]


def plain(form: EffectForm) -> bool:
    return not (form.states or form.memory or form.free or form.of_time_alone)


def true_of(f: Function, values: Values) -> set[Law]:
    with np.errstate(all="ignore"):
        return {law for law, claim in CLAIMS.items() if claim(f, values)}


@pytest.mark.parametrize("form", having(lambda f: plain(f) and f.variables < 2))
def test_one_law_is_true_of_a_function_of_one_variable(form):
    values = coefficients(form)
    own, whole = OF_SIGNALS.get(form.law, (form.law, False))
    if form.law is Law.PRODUCT_WITH_SIGNAL:
        f = read(form, form.equation, "s", "v")
        assert same(f(2.0 * X, X), 2.0 * f(X, X))
        assert same(f(X, 2.0 * X), 2.0 * f(X, X))
        return
    over = "v" if form.variables or form.kinds[0] in ("derivative", "pair") else "s"
    if over == "s":  # a place of its own has the name of what it limits
        values |= {"at": values.get("limit", values.get("k", 0.0))} if form.law in PLACED else {}
    assert true_of(read(form, form.equation, over, whole=whole), values) == {own}


PLACED = (Law.CUT_OFF, Law.DEAD_ZONE, Law.SATURATION, Law.LIMIT_ABOVE, Law.LIMIT_BELOW)


@pytest.mark.parametrize("form", having(lambda f: plain(f) and f.variables == 2))
def test_a_law_of_two_variables(form):
    f = read(form, form.equation, "v", "w")
    v, w = X, X[::-1] + 0.2
    if form.law is Law.FOURTH_DIFFERENCE:
        assert same(f(v, v), 0.0)
        assert same(f(v, w), -f(w, v))
        fourth = np.diff(f(np.arange(6.0), 1.0), 4)
        assert same(fourth, fourth[0])
        assert not same(fourth, 0.0)
        return
    of_first, of_second = {
        Law.PRODUCT: (Law.LINEAR, Law.LINEAR),
        Law.PRODUCT_OF_POWERS: (Law.POWER, Law.POWER),
        Law.TIMES_POWER: (Law.LINEAR, Law.POWER),
        Law.SWITCH_BY_MAGNITUDE: (Law.SWITCH, Law.ABSOLUTE),
    }[form.law]
    assert true_of(lambda x: f(2.0 + 0.0 * x, x), {}) == {of_second}
    assert true_of(lambda x: f(x, 2.0 + 0.0 * x), coefficients(form)) == {of_first}


@pytest.mark.parametrize("form", having(lambda f: bool(f.states) and f.law in STATES))
def test_a_law_of_a_state(form):
    starts, rests = STATES[form.law]
    own = tuple(z.start for z in form.states)
    assert own == starts or (len(own) == 1 and own[0] in starts)
    name, s, v = form.states[0].name, X, X[::-1]
    rates = replace_site(form)
    rate = read(
        rates, form.states[0].derivative, name, "s", "v", *(z.name for z in form.states[1:])
    )
    others = [z.name for z in form.states[1:]]
    read_all = read(form, form.equation, name, "s", "v", *others)

    def moved(z: np.ndarray, at: np.ndarray | float) -> np.ndarray:
        return read_all(z, at + 0.0 * z, 0.0 * z, *(0.0 * z for _ in others))

    if rests:
        still = {"s": s, "v": v, "v^2": v**2, "0": 0.0 * v}[rests]
        assert same(rate(still, s, v, *(0.0 * s for _ in others)), 0.0)
        assert same(moved(2.0 * s, s) - moved(s, s), moved(3.0 * s, s) - moved(2.0 * s, s))
    elif form.law is Law.HYSTERESIS:  # as fast as it is gone through, and another on the way back
        assert same(rate(s, s, 2.0 * v), 2.0 * rate(s, s, v))
        assert not same(rate(s, s, -v), -rate(s, s, v))
    else:
        assert same(rate(s, s, v), v)
        assert true_of(lambda z: moved(z, 0.0), coefficients(form)) == {Law.PERIODIC}


def test_a_hysteresis_of_a_signal_depends_on_its_way_alone():
    """Its rate is that of what follows the signal, times a factor that the direction decides."""
    form = FORMS["input", "hysteresis"]
    follows, bent = (read(form, own.derivative, "y", "s", "z", whole=True) for own in form.states)
    y, z, x0 = 0.0 * X, np.tanh(X) - 0.5, coefficients(form)["x0"]
    for way in (1.0, -1.0):
        slow = np.maximum(x0, np.abs(X) / 5.0)  # after a jump of many x0
        assert same(bent(y, way * X, z), follows(y, way * X, z) * (1.0 - way * z) / slow)


def test_a_store_between_two_settles_between_them():
    """Where it settles, it gives to the one what it takes from the other, but for their sizes."""
    form = FORMS["pair", "store_between"]
    (state,) = form.states
    v, w, c = X, X[::-1], coefficients(form)
    settled = c["share"] * v + (1.0 - c["share"]) * w
    assert same(read(form, state.derivative, "z", "v", "w")(settled, v, w), 0.0)
    begun = read(form, state.start, "v", "w")(v, w)
    assert same(begun, c["begin"] * v + (1.0 - c["begin"]) * w)
    here = read(form, form.equation, "z", "v", "w")(settled, v, w)
    there = read(form, form.reaction, "z", "v", "w")(settled, v, w)
    assert same(here, -c["k"] * (1.0 - c["share"]) * (v - w))
    assert same(there, c["back"] * c["share"] * (v - w))


@pytest.mark.parametrize("form", having(lambda f: f.law is Law.ATTACHED_OSCILLATOR))
def test_an_attached_oscillator_swings_about_where_it_moves_along(form):
    """With its frequency and damping; what it does to the state is against its own motion."""
    deflected, moving = form.states
    assert (deflected.start, moving.start) == ("0", "v")
    texts = [z.derivative for z in form.states]
    rates = [read(form, text, "z", "y", "v") for text in [*texts, form.equation]]
    still = [rate(0.0 * X, X, X) for rate in rates]
    assert same(still, 0.0)
    one, none = np.ones(1), np.zeros(1)
    a = np.array([[*rate(one, none, none), *rate(none, one, none)] for rate in rates[:2]])
    c = coefficients(form)
    assert same(np.poly(a), [1.0, 2.0 * c["d"] * c["f"], c["f"] ** 2])
    assert same(rates[2](X, X[::-1], 0.0 * X) * c["f"], -c["k"] * rates[1](X, X[::-1], 0.0 * X))


def replace_site(form: EffectForm) -> EffectForm:
    """The same, with rates that are no change of a signal."""
    return EffectForm(
        form.name,
        form.family,
        form.law,
        ("derivative",),
        "0",
        form.coefficients,
        states=form.states,
    )


@pytest.mark.parametrize("form", having(lambda f: f.of_time_alone and not f.states))
def test_a_law_of_time(form):
    f = read(form, form.equation, "t")
    values = coefficients(form)
    values |= {"n": values["f"]} if "f" in values else {}
    assert true_of(f, values) == {Law.PERIODIC if form.law is Law.WAVE else Law.LINEAR}
    assert form.law in (Law.WAVE, Law.DRIFT)


def test_a_memory_and_what_is_free_have_laws_of_their_own():
    for form in FORMS.values():
        assert MEMORIES.get(form.law, "") == form.memory
        assert (form.law in (*FREE, *FILTERS)) == form.free
        assert (form.law in FILTERS) == form.is_dynamics
        if form.values:
            assert FREE.index(form.law) == {1: 0, 0: 1, 2: 2}[form.variables]


@pytest.mark.parametrize("form", having(lambda f: f.is_dynamics))
def test_a_free_filter_is_equal_lags_in_a_row(form):
    """Settled, it exchanges nothing and leaves a signal as it is; else it adds each strength."""
    argument = "v" if form.variables else "s"
    names = [z.name for z in form.states]
    before = [argument, *names]
    for state, other in zip(form.states, before, strict=False):
        assert state.derivative == f"({other} - {state.name}) / tau"
        assert state.start == f"begin * {argument}"
    f = read(form, form.equation, argument, *names)
    values = coefficients(form)
    total = sum(values[f"k{i + 1}"] for i in range(len(names)))
    settled = f(X, *(X for _ in names))
    assert same(settled, total * X if form.law is Law.DYNAMICS else 0.0)
    assert same(f(0.0 * X, *(X for _ in names)), total * X)
