"""Curves of the effects that were found, over the range that the data visited."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import sympy as sp

from cluster_est.closed_loop.candidates.kinematics import integrated_states
from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory, pooled
from cluster_est.closed_loop.findings.effects import EffectCurve
from cluster_est.closed_loop.workbench import FittedModel, LoopWorkbench
from cluster_est.errors import ClusterEstError
from cluster_est.results.result import Result
from cluster_est.results.row_types import Estimate
from workers.effects.expression import parse
from workers.messages import FloatArray

POINTS, BINS = 201, 48
Shape = Callable[[FloatArray, FloatArray], FloatArray]
"""The term that an effect adds, as a function of its variable and its coefficients."""
Shape1D = Callable[[FloatArray], FloatArray]
"""The same with its coefficients as they were found."""
NORMAL95 = 1.959963984540054


def effect_curves(
    workbench: LoopWorkbench, fitted: FittedModel, result: Result
) -> tuple[EffectCurve, ...]:
    """Compute the curves of all effects that the loop has added.

    Parameters
    ----------
    workbench, fitted
        The model with the effects, where the search ended: its experiments are simulated once more,
        for the range of their signals.
    result
        Of its last fit: values of the coefficients, and their covariance.
    """
    if not fitted.added:
        return ()
    try:
        trajectories = workbench.trajectories(fitted)
    except ClusterEstError as error:
        return tuple(
            _none(c, f"its experiments cannot be simulated ({error})") for c in fitted.added
        )
    return tuple(each for c in fitted.added for each in _curves(workbench, c, trajectories, result))


def shape_over(candidate: EffectCandidate, curve: EffectCurve, result: Result) -> Shape1D | None:
    """Return what an effect adds, over the variable of its curve, also where no data were.

    None where it has no curve. Of a signal that is a function of itself, what is added to it.
    """
    if curve.why_not or candidate.site.kind == "parameter":
        return None
    over = _variable(candidate, candidate.form.equation)
    rows = {e.label: e for e in result.estimates}
    own = [rows.get(f"{candidate.effect.name}.{c.name}") for c in candidate.form.coefficients]
    if over is None or any(e is None for e in own):
        return None
    values = np.array([e.value for e in own if e is not None])
    shape = _function(candidate, candidate.form.equation, over[0], 1.0)
    at_itself = over[0] == "s"

    def added(x: FloatArray) -> FloatArray:
        return shape(x, values) - (x if at_itself else 0.0)

    return added


def _none(candidate: EffectCandidate, why: str) -> EffectCurve:
    return EffectCurve(candidate.effect.name, str(candidate.site), why_not=why)


def _curves(
    workbench: LoopWorkbench,
    candidate: EffectCandidate,
    trajectories: Sequence[LinearisedTrajectory],
    result: Result,
) -> list[EffectCurve]:
    form, site = candidate.form, candidate.site
    if form.memory or form.states:
        return [_none(candidate, "it depends on the past, so no curve over one variable shows it")]
    texts = [form.equation, *([form.reaction] if form.reaction else [])]
    over = _variable(candidate, texts[0])
    if over is None:
        return [_none(candidate, "it is no function of one variable alone")]
    symbol, name = over
    seen = _visited(candidate, trajectories, symbol, name)
    seen = seen[np.isfinite(seen)]
    if not len(seen):
        return [_none(candidate, f"nothing is known of {name}")]
    units = {n: v.unit for n, v in workbench.description.variables.items()}
    own = units.get(name.partition(" - ")[0], "")
    counts, edges = np.histogram(seen, BINS)
    rows = {e.label: e for e in result.estimates}
    fixed = rows.get(site.target)
    signal = fixed.value if fixed is not None and site.kind == "parameter" else 1.0
    known = EffectCurve(
        effect=candidate.effect.name,
        part=str(site),
        variable=name,
        variable_unit="s" if symbol == "t" else own,
        x=np.linspace(float(seen.min()), float(seen.max()), POINTS),
        edges=edges,
        counts=counts.astype(np.float64),
        integral_of=_integral_of(name, trajectories),
    )
    return [
        _curve(known, candidate, _function(candidate, text, symbol, signal), target, units, result)
        for text, target in zip(texts, site.targets, strict=False)
    ]


def _integral_of(name: str, trajectories: Sequence[LinearisedTrajectory]) -> str:
    """The state whose integral a variable is; of a difference that of both."""
    speeds = {x: v for x, (v, _) in integrated_states(trajectories).items()}
    parts = [name] if name in speeds else name.split(" - ")
    return " - ".join(speeds[x] for x in parts) if all(x in speeds for x in parts) else ""


def _curve(
    known: EffectCurve,
    candidate: EffectCandidate,
    shape: Shape,
    target: str,
    units: Mapping[str, str],
    result: Result,
) -> EffectCurve:
    """One part of an effect with its band."""
    rows = {e.label: e for e in result.estimates}
    own = [rows[f"{known.effect}.{c.name}"] for c in candidate.form.coefficients]
    values = np.array([e.value for e in own])
    y = shape(known.x, values)
    if not np.isfinite(y).any():
        return _none(candidate, "it is not finite where the data were")
    spread = NORMAL95 * _spread(shape, known.x, values, _covariance(result, own))
    unit, at_rates = units.get(target, ""), candidate.site.at_rates
    return replace(
        known,
        part=f"der({target})" if at_rates else known.part,
        unit=f"{unit}/s" if unit and at_rates else unit,
        y=y,
        lower=y - spread,
        upper=y + spread,
    )


def _visited(
    candidate: EffectCandidate, trajectories: Sequence[LinearisedTrajectory], symbol: str, name: str
) -> FloatArray:
    """Values in the training experiments; of an output, before effects act on it."""
    if symbol == "t":
        return np.concatenate([trajectory.times for trajectory in trajectories])
    if symbol == "s" and candidate.site.kind == "output":
        having = [c for c in trajectories if name in c.names]
        return np.concatenate([c.outputs[:, c.names.index(name)] for c in having])
    return pooled(trajectories, name)


def _variable(candidate: EffectCandidate, text: str) -> tuple[str, str] | None:
    """The only variable that an equation depends on: its symbol there, and its name."""
    site = candidate.site
    equation = _parsed(candidate, text)
    used = _used(equation) - ({"s"} if site.kind == "parameter" else set())
    if len(used) > 1 and not site.at_rates:  # what is added to the signal may be simpler
        used = _used(sp.expand(equation - sp.Symbol("s", real=True)))
    if used == {"t"}:
        return "t", "time"
    if used == {"s"}:
        return "s", site.target
    if used == {"v"} and candidate.effect.variables:
        return "v", candidate.effect.variables[0]
    return None


def _used(equation: sp.Expr) -> set[str]:
    return {str(symbol) for symbol in equation.free_symbols} & set("tsvw")


def _parsed(candidate: EffectCandidate, text: str) -> sp.Expr:
    names = [*"tsvw", *(c.name for c in candidate.form.coefficients)]
    symbols = {name: sp.Symbol(name, real=True) for name in names}
    return parse(text, symbols, f"form {candidate.form.name}")


def _function(candidate: EffectCandidate, text: str, over: str, signal: float) -> Shape:
    """The term that the effect adds, or the signal it makes, over x and the coefficients."""
    equation = _parsed(candidate, text)
    s = sp.Symbol("s", real=True)
    if candidate.site.kind == "parameter":
        equation = equation.subs(s, signal)
    elif over != "s":
        equation = sp.expand(equation - (0 if candidate.site.at_rates else s))
    names = [over, *(c.name for c in candidate.form.coefficients)]
    compiled = sp.lambdify([sp.Symbol(n, real=True) for n in names], equation, "numpy")

    def shape(x: FloatArray, values: FloatArray) -> FloatArray:
        with np.errstate(all="ignore"):
            found = np.asarray(compiled(x, *values), np.float64)
        return np.array(np.broadcast_to(found, x.shape))

    return shape


def _covariance(result: Result, coefficients: Sequence[Estimate]) -> FloatArray:
    """Of the coefficients; those that are held do not vary."""
    labels = [e.label for e in coefficients]
    known = result.uncertainty
    shared = () if known is None else known.shared
    errors = np.array([0.0 if e.estimated_on == "known" else e.std_error for e in coefficients])
    correlations = np.eye(len(labels))
    for i, one in enumerate(labels):
        for j, other in enumerate(labels[:i]):
            if known is not None and one in shared and other in shared:
                found = known.correlations[shared.index(one), shared.index(other)]
                correlations[i, j] = correlations[j, i] = found
    return np.asarray(correlations * errors * errors[:, None])


def _spread(
    shape: Shape,
    x: FloatArray,
    values: FloatArray,
    covariance: FloatArray,
) -> FloatArray:
    """The standard deviation of a shape, to first order, by central differences."""
    if not np.isfinite(covariance).all():
        return np.full(len(x), np.nan)
    slopes = np.zeros((len(x), len(values)))
    for i, step in enumerate(1e-3 * np.sqrt(np.diag(covariance))):
        if step > 0.0:
            moved = np.eye(len(values))[i] * step
            slopes[:, i] = (shape(x, values + moved) - shape(x, values - moved)) / (2.0 * step)
    variance = np.einsum("ni,ij,nj->n", slopes, covariance, slopes)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))
