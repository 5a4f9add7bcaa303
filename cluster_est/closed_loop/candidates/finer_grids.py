"""Denser grids of a candidate's shape, and free curves with twice as many values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory, pooled
from workers.effects.forms import FORMS, EffectForm, GridScale
from workers.messages import FloatArray

BETWEEN = 4
"""Steps for each one of the candidate's own grid."""
BEGINNINGS = np.linspace(0.04, 0.96, 24)
"""Quantiles of its argument at which an effect may begin."""
MANY = 12
"""Points of a grid that is dense as it is: of waves."""


def denser_grid(
    candidate: EffectCandidate, trajectories: Sequence[LinearisedTrajectory]
) -> list[tuple[float, ...]]:
    """Return a grid with more points in the one coefficient that the candidate's own grid varies.

    Where an effect begins must be nearly right, or it looks like less than one that begins nowhere.
    A grid in several coefficients stays as it is.

    Parameters
    ----------
    candidate
        Of the library.
    trajectories
        Of a model near the data, over which its argument goes.
    """
    rows = np.array(candidate.grid)
    moving = np.flatnonzero(np.ptp(rows, axis=0) > 0.0)
    if len(moving) != 1 or len(rows) > MANY:
        return list(candidate.grid)
    values = _dense_values(candidate, int(moving[0]), rows[:, moving[0]], trajectories)
    dense = np.repeat(rows[:1], len(values), axis=0)
    dense[:, moving[0]] = values
    return [tuple(row) for row in dense.tolist()]


def _dense_values(
    candidate: EffectCandidate,
    position: int,
    own: FloatArray,
    trajectories: Sequence[LinearisedTrajectory],
) -> FloatArray:
    if candidate.form.coefficients[position].scale is GridScale.QUANTILE_V:
        return np.asarray(
            np.quantile(pooled(trajectories, candidate.effect.variables[0]), BEGINNINGS)
        )
    known = np.sort(own)
    at = np.linspace(0.0, len(known) - 1.0, (len(known) - 1) * BETWEEN + 1)
    if (known > 0.0).all():
        return np.exp(np.interp(at, np.arange(len(known)), np.log(known)))
    return np.interp(at, np.arange(len(known)), known)


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
