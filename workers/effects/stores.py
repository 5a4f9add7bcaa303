"""Forms with states that the model does not have: hidden stores and hidden oscillators.

Examples are the wall of a room, a tissue, a gut, or a second mode of vibration. Each is an internal
state of the form. A hidden store follows its argument v as a first-order system with time constant
tau:

    der(x) += -k (v - z),    z' = (v - z) / tau

If the store exchanges with the state itself (v is x), k is positive. Such a store is a heat
capacity behind a conductance, or a second compartment with rate constants k (to it) and 1 / tau
(back). Two stores in series are equivalent to two parallel stores with other coefficients, like all
networks of resistors and capacitors (R. M. Foster, Bell Syst. Tech. J. 3 (1924) 259-267,
doi:10.1002/j.1538-7305.1924.tb01358.x). So there is no form for stores in series. If v is another
state, k (v - z) is a delayed transfer from it, or a spring and a damper in series. A store between
two states depends on both: a wall between two rooms follows their weighted mean, and the weight of
the first room is its share of the total conductance.

The initial state of a store may be known: z = v if it is full, z = 0 if it is empty. An unknown
initial state adds a term that decays independently of the signals. So z starts at 0, and a e is
added, with e' = -e / tau and e = 1 at the start. Then the initial state is a / k, and the equation
is linear in a and k. Each experiment has its own a, because the temperature of the wall, for
example, is not measured.

Other dynamics are approximated by a free filter: n equal lags in series, each with its own
strength. Their impulse responses span the same space as the Laguerre functions. With increasing n,
these approximate every decaying response (B. Wahlberg, IEEE Trans. Automatic Control 36 (1991)
551-562, doi:10.1109/9.76361).
"""

from __future__ import annotations

from dataclasses import replace

from workers.effects.kinds import (
    DYNAMICS_FAMILY,
    EffectForm,
    FormCoefficient,
    FormCondition,
    GridScale,
    OwnState,
    SiteKind,
)
from workers.effects.laws import Law

_DER: tuple[SiteKind, ...] = ("derivative",)
_PAIR: tuple[SiteKind, ...] = ("pair",)
_IN: tuple[SiteKind, ...] = ("input",)
_OUT: tuple[SiteKind, ...] = ("output",)
_SIGNAL: tuple[SiteKind, ...] = ("input", "output")


def _time(name: str, *steps: float) -> FormCoefficient:
    return FormCoefficient(
        name, None, positive=True, scale=GridScale.STEP, grid=steps, unit="second"
    )


_EXCHANGE = FormCoefficient("k", positive=True, unit="site / v")
_FIRST = FormCoefficient("a", each=True, unit="site")
"""The contribution of the initial state, which decays."""
_TAU = _time("tau", 3.0, 15.0, 75.0)
_STORE = OwnState("z", "(v - z) / tau", "v")
_EMPTY = OwnState("z", "(v - z) / tau", "0")
_SLOW = OwnState("y", "(v - y) / tau_slow", "v")
_TWO = (
    _EXCHANGE, replace(_EXCHANGE, name="k_slow"), _time("tau", 3.0, 12.0),
    _time("tau_slow", 40.0, 150.0),
)  # fmt: skip
_DECAY = OwnState("e", "-e / tau", "1")
_TWINS = (("tau", "tau_slow"), ("k", "k_slow"))
_FREE = tuple(replace(c, positive=c.scale is not None) for c in _TWO)
"""Coefficients if v is not the state itself: the strengths may then have either sign."""

_RESONANCE = (
    FormCoefficient("f", None, positive=True, scale=GridScale.SPECTRUM, grid=(1.0,),
                    unit="rad / second"),
    FormCoefficient("d", None, positive=True, scale=GridScale.DAMPING, grid=(0.03, 0.2),
                    unit="1"),
)  # fmt: skip
"""Frequency and damping of an oscillator; the frequency is that of a peak in the residual's
spectrum."""
_SWING = OwnState("y", "f * (v - z) - 2 * d * f * y", "0")
_PARTS = (
    FormCoefficient("a", unit="site / v"), FormCoefficient("b", unit="site / v"), *_RESONANCE,
)  # fmt: skip
"""Strengths of the oscillator's position (a) and velocity (b), and the oscillator itself."""

_OWN = (FormCondition.OWN,)
_FILLED = (FormCondition.AMOUNT, FormCondition.FROM_REST)
"""Conditions of a store that is empty at the start although the state is not."""

_AT_STATES = (
    EffectForm("store", "store", Law.STORE, _DER, "-k * (v - z)", (_EXCHANGE, _TAU), 1, (_STORE,),
         when=(FormCondition.STATE,), order=0.4),
    EffectForm("store_from_zero", "store", Law.STORE_FROM_ZERO, _DER,
         "-k * (v - z)", (_EXCHANGE, _TAU), 1, (_EMPTY,),
         when=(*_OWN, *_FILLED), order=0.35),
    EffectForm("store_from_elsewhere", "store", Law.STORE_FROM_ELSEWHERE, _DER,
         "a * e - k * (v - z)", (_EXCHANGE, _FIRST, _TAU), 1, (_EMPTY, _DECAY),
         when=_OWN, order=0.5),
    EffectForm("two_stores", "store", Law.TWO_STORES, _DER, "-k * (v - z) - k_slow * (v - y)",
         _TWO, 1, (_STORE, _SLOW), when=_OWN, order=0.6, twins=_TWINS),
    EffectForm("two_stores_from_zero", "store", Law.TWO_STORES_FROM_ZERO, _DER,
         "-k * (v - z) - k_slow * (v - y)", _TWO, 1, (_EMPTY, replace(_SLOW, start="0")),
         when=(*_OWN, *_FILLED), order=0.55, twins=_TWINS),
    # a gut or a tank that empties: it is full at the start and is not refilled
    EffectForm("emptying", "store", Law.DECAY, _DER, "a * e", (_FIRST, _TAU), 0, (_DECAY,),
         order=0.4),
    # a path from another signal to the state for which one lag is not enough
    EffectForm("two_lags", "store", Law.TWO_LAGS, _DER, "k * z + k_slow * y", _FREE, 1,
         (_STORE, _SLOW), when=(FormCondition.OTHER,), order=0.9, later=True, twins=_TWINS),
    # a flexible mast that a motor's torque excites and that pulls at the body
    EffectForm("driven_mode", "store", Law.RESONANCE, _DER, "a * z + b * y",
         _PARTS, 1, (OwnState("z", "f * y", "0"), _SWING), when=(FormCondition.DRIVEN,),
         order=0.8),
    # a mass on a spring at a body: y is its velocity, k / f its mass over the mass of the body
    EffectForm("oscillator", "store", Law.ATTACHED_OSCILLATOR, _DER,
         "-k * (z + 2 * d * (v - y))", (_EXCHANGE, *_RESONANCE), 1,
         (OwnState("z", "f * (v - y)", "0"), OwnState("y", "f * z + 2 * d * f * (v - y)", "v")),
         when=(FormCondition.OWN, FormCondition.OSCILLATES), order=0.6),
    # a wall between two rooms; it starts at the temperature of either room, or half-way
    EffectForm("store_between", "store", Law.STORE_BETWEEN, _PAIR, "-k * (v - z)",
         (_EXCHANGE, replace(_EXCHANGE, name="back", unit="other / v"),
          _time("tau", 3.0, 15.0, 75.0),
          FormCoefficient("share", None, positive=True, scale=GridScale.SHARE, grid=(0.5,),
                          unit="1"),
          FormCoefficient("begin", None, positive=True, scale=GridScale.SHARE,
                          grid=(0.0, 0.5, 1.0), held=True, unit="1")),
         2, (OwnState("z", "(share * v + (1 - share) * w - z) / tau",
                      "begin * v + (1 - begin) * w"),),
         "back * (z - w)", when=(FormCondition.AROUND,), order=0.5),
    # a joint with creep
    EffectForm("store", "store", Law.STORE, _PAIR, "-k * (v - z)",
         (FormCoefficient("k", positive=True, unit="site / v"),
          FormCoefficient("back", positive=True, unit="other / v"), _TAU), 1, (_STORE,),
         "back * (v - z)", order=0.4),
)  # fmt: skip

_AT_SIGNALS = (
    EffectForm("store", "store", Law.STORE, _IN, "s - k * (v - z)",
         (FormCoefficient("k", unit="site / v"), _TAU), 1, (_STORE,),
         when=(FormCondition.FORCE,), order=0.4),
    EffectForm("lead", "lag", Law.LEAD, _SIGNAL, "s + k * (s - z)",
         (FormCoefficient("k", unit="1"), _TAU), 0, (OwnState("z", "(s - z) / tau", "s"),),
         order=0.6),
    # a mode of vibration that the model does not have
    EffectForm("mode_feed_through", "store", Law.RESONANCE, _OUT, "s + a * z + b * y", _PARTS, 1,
         (OwnState("z", "f * y", "0"), _SWING), when=(FormCondition.DRIVEN,), order=0.6),
)  # fmt: skip

_ORDERS = (3, 5)
"""Orders of the free filters, the coarse one first."""


def _filters(
    name: str, law: Law, kinds: tuple[SiteKind, ...], term: str, *when: FormCondition
) -> list[EffectForm]:
    """Return free filters of each order; their equation is the sum of k_i times a term in z_i."""
    signal = kinds == _SIGNAL
    of = "s" if signal else "v"
    names = (name, *(f"{name}_{order}" for order in _ORDERS[1:]))
    made = []
    for own, order, coarse in zip(names, _ORDERS, ("", *names), strict=False):
        rows = range(1, order + 1)
        states = tuple(
            OwnState(f"z{i}", f"({of if i == 1 else f'z{i - 1}'} - z{i}) / tau", f"begin * {of}")
            for i in rows
        )
        equation = " + ".join(f"k{i} * {term.format(z=f'z{i}')}" for i in rows)
        strengths = (FormCoefficient(f"k{i}", unit="1" if signal else "site / v") for i in rows)
        coefficients = (*strengths, _time("tau", 3.0, 12.0, 48.0), _BEGIN)
        made.append(
            EffectForm(own, DYNAMICS_FAMILY, law, kinds, equation if kinds == _DER else
                       f"s + {equation}", coefficients, 0 if signal else 1, states, when=when,
                       order=2.0, differences=True, finer_than=coarse)
        )  # fmt: skip
    return made


_BEGIN = FormCoefficient(
    "begin", None, positive=True, scale=GridScale.SHARE, grid=(1.0, 0.0), held=True, unit="1"
)
"""Initial state of a free filter: steady state (1) or empty (0)."""

_FREE_FILTERS = (
    *_filters("hidden_dynamics", Law.DYNAMICS, _DER, "{z}", FormCondition.OTHER),
    *_filters("hidden_exchange", Law.EXCHANGE, _DER, "({z} - v)", FormCondition.OWN),
    *_filters("hidden_dynamics", Law.DYNAMICS, _OUT, "{z}"),
    *_filters("signal_dynamics", Law.SIGNAL_DYNAMICS, _SIGNAL, "({z} - s)"),
)

STORES = (*_AT_STATES, *_AT_SIGNALS, *_FREE_FILTERS)
"""The forms of this module."""
