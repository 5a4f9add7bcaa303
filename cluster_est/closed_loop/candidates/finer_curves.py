"""Free curves with twice as many steps, over the range that their argument has come to visit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory, pooled
from workers.effects.forms import FORMS, EffectForm

RARE = 0.005
"""Share of the samples at each end that a curve stays constant for."""


def finer_form(coarse: EffectCandidate) -> EffectForm | None:
    """Return the form of a curve with twice as many steps; None for the finest."""
    kind, name = coarse.site.kind, coarse.form.name
    return next((f for (k, _), f in FORMS.items() if (k, f.finer_than) == (kind, name)), None)


def in_finer_form(coarse: EffectCandidate, form: EffectForm) -> EffectCandidate:
    """Return a free curve with more values, over the same range: the new ones are as free."""
    given = {c.name: i for i, c in enumerate(coarse.form.coefficients)}
    like = [given.get(c.name, given[coarse.strengths[0]]) for c in form.coefficients]
    name = coarse.effect.name.replace(coarse.form.name, form.name, 1)
    return replace(
        coarse,
        effect=replace(coarse.effect, name=name, form=form.name),
        form=form,
        grid=tuple(tuple(values[i] for i in like) for values in coarse.grid),
        lowest=tuple(coarse.lowest[i] for i in like),
        highest=tuple(coarse.highest[i] for i in like),
    )


def refined(
    coarse: EffectCandidate,
    values: Sequence[float],
    trajectories: Sequence[LinearisedTrajectory],
    form: EffectForm,
) -> tuple[EffectCandidate, list[float]]:
    """Return a finer curve that says the same as a fitted one.

    With the effect the motion may go further than it did without. Where all values of a curve are
    free, the finer one is spread over where its argument goes now.

    Parameters
    ----------
    coarse, values
        The fitted curve, and its coefficients.
    trajectories
        Of the fitted model.
    form
        The finer form.

    Returns
    -------
    EffectCandidate, list of float
        The finer curve, and its coefficients.
    """
    known = dict(zip([c.name for c in coarse.form.coefficients], values, strict=True))
    ends = known["low"], known["high"]
    if len(coarse.strengths) == coarse.form.values:
        v = pooled(trajectories, coarse.effect.variables[-1])
        ends = float(np.quantile(v, RARE)), float(np.quantile(v, 1.0 - RARE))
    points = np.linspace(known["low"], known["high"], coarse.form.values)
    heights = [known.get(f"k{i + 1}", 0.0) for i in range(coarse.form.values)]
    at = np.linspace(*ends, form.values)
    known |= {f"k{i + 1}": y for i, y in enumerate(np.interp(at, points, heights).tolist())}
    known |= {"low": ends[0], "high": ends[1]}
    finer = in_finer_form(coarse, form)
    return _held(finer, known), [known[c.name] for c in form.coefficients]


def _held(candidate: EffectCandidate, known: dict[str, float]) -> EffectCandidate:
    """Return a curve whose held coefficients may be what they are."""
    held = {i: known[c.name] for i, c in enumerate(candidate.form.coefficients) if c.held}
    low, high = list(candidate.lowest), list(candidate.highest)
    for i, value in held.items():
        low[i], high[i] = min(low[i], value), max(high[i], value)
    grid = tuple(
        tuple(held.get(i, value) for i, value in enumerate(values)) for values in candidate.grid
    )
    return replace(candidate, grid=grid, lowest=tuple(low), highest=tuple(high))
