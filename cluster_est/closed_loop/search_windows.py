"""Parts of long records for a search, chosen by the residual of the declared model.

A thinned record of many hundreds of time constants contains more information than a search needs,
and each trial would simulate all of it. So a search uses a part of the record: the first part, or a
part in which the declared model, fitted to the whole record, has a larger error. A part that begins
later has its own initial states. The statistical power decreases with the square root of the number
of samples. If an effect acts only in other parts, the residual of the whole records shows it. Then
the search is repeated with the whole records.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory
from cluster_est.closed_loop.fitter import FitStart, FittedModel, Fitter
from cluster_est.closed_loop.last_fits import best_on_few_rows
from cluster_est.closed_loop.output_noise import noise_of
from cluster_est.closed_loop.settings import LoopStage
from cluster_est.errors import ProblemError
from cluster_est.problem.display import in_a_row
from cluster_est.problem.gaps import RestartableStates, part_of, with_parameters
from cluster_est.problem.problem import Problem
from cluster_est.problem.thinning import IN_PARTS, looked_at_in_parts, rows_of
from workers.messages import Experiment, FloatArray, IntArray, OwnStart

WORSE_THERE = 2.0
"""Least ratio of another part's misfit to the first part's misfit for which the other part is used.
The first part is preferred, because the initial states of other parts are unknown."""

BY_CHANCE = 4.0
"""If a sum of squares exceeds that of noise by fewer standard errors than this, the excess counts
as chance."""

INFORMED = 0.2
"""Least information of the windows on any combination of unknowns, as a share of all information,
divided by the windows' share of all rows."""

FEWEST_SAMPLES = 30
"""Least number of rows of each output in a window."""

TOLD = 1e-10
"""Ratio to the largest singular value below which a combination of unknowns counts as having no
influence."""

SAME = 0.3
"""Largest root mean square difference, over the noise, between the residuals of the declared model
in a window and in the whole record."""


@dataclass(frozen=True)
class Window:
    """A part of a record.

    Attributes
    ----------
    position
        Index of the record among the training experiments.
    experiment
        The whole record.
    start, stop
        Start and end in seconds.
    count
        Intended number of rows.
    rows
        Indices of the window's rows in the residuals of all training experiments.
    """

    position: int
    experiment: Experiment = field(repr=False)
    start: float
    stop: float
    count: int
    rows: IntArray = field(repr=False)

    @property
    def leads(self) -> bool:
        return self.start == self.experiment.start

    @property
    def place(self) -> str:
        """The record and the times of the window, in words."""
        return f"{self.experiment.id!r} from {self.start:.4g} to {self.stop:.4g} s"


@dataclass(frozen=True)
class SearchWindows:
    """A problem in which windows replace the longest training records.

    Attributes
    ----------
    whole
        The problem with the whole records.
    problem
        The problem with the windows, which the search uses.
    made
        Names of the parameters that are initial states of windows; `whole` does not have them.
    rows
        Indices of those residuals of `whole` that also belong to `problem`.
    fitted
        The declared model, fitted to the whole records.
    """

    whole: Problem = field(repr=False)
    problem: Problem = field(repr=False)
    windows: tuple[Window, ...]
    made: frozenset[str]
    rows: IntArray = field(repr=False)
    fitted: FittedModel = field(repr=False)

    @property
    def sentence(self) -> str:
        """Say which parts of the records the search used."""
        late = [window.place for window in self.windows if not window.leads]
        lengths = [window.stop - window.start for window in self.windows]
        low, high = (f"{length:.3g}" for length in (min(lengths), max(lengths)))
        of = f"{low} s" if low == high else f"{low} to {high} s"
        named = self.windows[0].experiment.id
        which = f"{named!r}" if len(lengths) == 1 else f"each of {len(lengths)} records"
        said = f"effects were looked for in {of} of {which}, "
        if not late:
            return f"{said}from the beginning"
        where = f"{in_a_row(late)}, where the error of the declared model is largest"
        return said + (
            where if len(late) == len(lengths) else f"from the beginning, except for {where}"
        )

    def unlike_records(self, fitter: Fitter) -> str:
        """Say why the declared model's residuals in the windows differ from those in whole records.

        They differ if initial states cannot be set, or if the model has a long memory.

        Parameters
        ----------
        fitter
            Fitter of the problem with windows.

        Returns
        -------
        str
            "" if the residuals are the same.
        """
        space = fitter.space(FitStart(self.problem, self.fitted.estimates))
        ((at,),) = fitter.evaluate(LoopStage.DECLARED_MODEL, [(space, space.start[None])])
        if not at.ok:
            return "the declared model cannot be simulated from the beginning of a part"
        noise = noise_of(fitter, at.residuals)
        off = at.residuals - self.fitted.residuals[self.rows]
        sizes = [(item.output, _root_mean_square(off[item.rows])) for item in fitter.records.items]
        if all(size <= SAME * noise[output] for output, size in sizes):
            return ""
        return "the declared model does not continue correctly from the beginning of a part"

    def on_whole_records(self, fitter: Fitter, starts: Sequence[FitStart]) -> list[FitStart]:
        """Return the models of the search as starts for fits to the whole records.

        For the declared model, the better of two starts is used: the values from the search, or the
        values of an earlier fit to the whole records.

        Parameters
        ----------
        fitter
            Fitter of the problem with whole records.
        starts
            Models of the search; the first is the declared model.
        """
        moved = [self._on_whole_records(start) for start in starts]
        declared = [moved[0], replace(moved[0], values=self.fitted.estimates)]
        spaces = [fitter.space(start) for start in declared]
        points = [(space, space.start[None]) for space in spaces]
        costs = [at.cost for (at,) in fitter.evaluate(LoopStage.FINAL, points)]
        return [declared[int(np.argmin(costs))], *moved[1:]]

    def _on_whole_records(self, start: FitStart) -> FitStart:
        problem = replace(
            start.problem,
            model=self.whole.model,
            parameters=tuple(p for p in start.problem.parameters if p.name not in self.made),
            experiments=self.whole.experiments,
        )
        return replace(start, problem=problem, values={**self.fitted.estimates, **start.values})

    def missed(self, fitter: Fitter, fitted: FittedModel | None) -> str:
        """Say where a model has a clearly larger error than in the windows; "" if nowhere.

        Parameters
        ----------
        fitter
            Fitter of the problem with whole records.
        fitted
            A model, fitted to the whole records; None if it cannot be simulated.
        """
        if fitted is None:
            return "the model that was found in the parts cannot be simulated over whole records"
        left = _Misfit.of(fitter, fitted)
        inside = max(left.within(window.rows) for window in self.windows)
        for window in self.windows:
            others = list(_candidates(fitter, window.position, window.count))
            misfits = [left.within(other.rows) for other in others]
            worst = int(np.argmax(misfits))
            if misfits[worst] > WORSE_THERE * inside:
                where = others[worst].place
                return f"the model that was found in the parts leaves more error in {where}"
        return ""


@dataclass(frozen=True)
class _Misfit:
    """The residuals of a model over whole records, in units of the noise.

    Attributes
    ----------
    residuals : (N,)
    jacobian : (N, unknowns)
    outputs : (N,)
        Index of each residual's output.
    """

    residuals: FloatArray = field(repr=False)
    jacobian: FloatArray = field(repr=False)
    outputs: IntArray = field(repr=False)

    @classmethod
    def of(cls, fitter: Fitter, fitted: FittedModel) -> Self:
        outputs = np.zeros(fitter.size, int)
        noise = noise_of(fitter, fitted.residuals)
        levels = np.ones(fitter.size)
        for number, level in enumerate(noise.tolist()):
            own = fitter.records.of_output(number)
            outputs[own] = number
            seen = level if level > 0.0 else _root_mean_square(fitted.residuals[own])
            levels[own] = max(seen, 1e-300)
        return cls(fitted.residuals / levels, fitted.jacobian / levels[:, None], outputs)

    def within(self, rows: IntArray) -> float:
        """Return the excess of -2 log likelihood over that of noise, after an allowance for chance.

        The unknowns are first fitted to these rows alone (linearised). Otherwise an error in one
        part of the data, which makes the fit to all data wrong, would appear in all other parts.
        """
        matrix = _of_one_size(self.jacobian[rows])
        step = np.linalg.lstsq(matrix, self.residuals[rows], rcond=TOLD)[0]
        squares = (self.residuals[rows] - matrix @ step) ** 2
        found = 0.0
        for number in np.unique(self.outputs[rows]).tolist():
            own = squares[self.outputs[rows] == number]
            more = len(own) * np.log(max(float(np.mean(own)), 1.0))
            found += max(more - BY_CHANCE * np.sqrt(2.0 * len(own)), 0.0)
        return float(found)


def choose_windows(
    fitter: Fitter,
    most: int | None,
    fitted: FittedModel | None = None,
    near: Mapping[str, float] | None = None,
) -> SearchWindows | None:
    """Choose a part of each long record for a search; None if the search needs whole records.

    Parameters
    ----------
    fitter
        Fitter of the problem with thinned records.
    most
        Intended number of rows of each part.
    fitted
        The declared model, if it has already been fitted to these records.
    near
        Start values of the fit otherwise.
    """
    long = [fitter.train.index(e) for e in looked_at_in_parts(fitter.problem, most)]
    if most is None or not long:
        return None
    if fitted is None:
        ((_, fitted),) = best_on_few_rows(fitter, [FitStart(fitter.problem, near or {})])
    windows = None if fitted is None else _enough(fitter, fitted, long, most)
    if fitted is None or windows is None or not _show_all_outputs(fitter, windows):
        return None
    return _with_parts(fitter, fitted, windows)


def _enough(
    fitter: Fitter, fitted: FittedModel, long: Sequence[int], most: int
) -> list[Window] | None:
    """Return windows with enough information on each unknown; their length is doubled until then.

    None if no record is long enough.
    """
    left = _Misfit.of(fitter, fitted)
    shared = [i for i, unknown in enumerate(fitted.space.unknowns) if not unknown.scope]
    u, sizes, _ = np.linalg.svd(_of_one_size(fitted.jacobian[:, shared]), full_matrices=False)
    known = u[:, sizes > TOLD * sizes[:1]]
    while True:
        long = [position for position in long if _rows(fitter, position) > IN_PARTS * most]
        if not long:
            return None
        windows = [_worst(left, list(_candidates(fitter, position, most))) for position in long]
        rows = _rows_of_search(fitter, windows)
        said = np.linalg.norm(known[rows], ord=-2) ** 2 if known.size else 1.0
        if said >= INFORMED * len(rows) / len(known):
            return windows
        most *= 2


def _of_one_size(jacobian: FloatArray) -> FloatArray:
    sizes = np.linalg.norm(jacobian, axis=0)
    return np.asarray(jacobian / np.where(sizes > 0.0, sizes, 1.0))


def _worst(left: _Misfit, windows: Sequence[Window]) -> Window:
    """Return the first window, or the window with the largest misfit if that is much larger."""
    misfits = [left.within(window.rows) for window in windows]
    worst = int(np.argmax(misfits))
    return windows[worst if misfits[worst] > WORSE_THERE * misfits[0] else 0]


def _rows(fitter: Fitter, position: int) -> int:
    return rows_of(fitter.problem.experiments[fitter.train[position]])


def _candidates(fitter: Fitter, position: int, count: int) -> Iterator[Window]:
    """Yield windows of about `count` rows of a record; each overlaps half of the one before."""
    run = fitter.problem.experiments[fitter.train[position]]
    times = max((output.times for output in run.outputs), key=len)
    halves = max(int(np.ceil(2 * len(times) / count)), 2)
    inner = times[np.linspace(0, len(times), halves + 1).astype(int)[1:-1]]
    edges = np.array([run.start, *inner, run.stop]).tolist()
    items = [item for item in fitter.records.items if item.experiment == position]
    for start, stop in zip(edges, edges[2:], strict=False):
        parts = [
            item.rows.start + np.flatnonzero((item.times >= start) & (item.times <= stop))
            for item in items
        ]
        yield Window(position, run, start, stop, count, np.concatenate(parts))


def _rows_of_search(fitter: Fitter, windows: Sequence[Window]) -> IntArray:
    """Return the indices of the residuals in windows, and in all records without a window."""
    own = {window.position: window.rows for window in windows}
    every = range(len(fitter.train))
    return np.concatenate(
        [own.get(position, fitter.records.of_experiment(position)) for position in every]
    )


def _show_all_outputs(fitter: Fitter, windows: Sequence[Window]) -> bool:
    for window in windows:
        for item in fitter.records.items:
            if item.experiment == window.position and len(item.times):
                inside = np.sum((item.times >= window.start) & (item.times <= window.stop))
                if inside < min(FEWEST_SAMPLES, len(item.times)):
                    return False
    return True


def _with_parts(
    fitter: Fitter, fitted: FittedModel, windows: Sequence[Window]
) -> SearchWindows | None:
    """Replace records by their windows; None if a window cannot have its own initial states."""
    before, states = fitter.problem, RestartableStates()
    problem = before
    paths: list[LinearisedTrajectory] = []
    if not all(window.leads for window in windows):
        states = RestartableStates.of(before, fitter.description)
        if states.refusal or not fitter.exchange:
            return None
        try:
            paths = fitter.trajectories(fitted)
        except ProblemError:
            return None
        problem = with_parameters(before, states.added)
    experiments = list(problem.experiments)
    for window in windows:
        part = part_of(window.experiment, window.start, window.stop, states)
        if part is None:
            return None
        if not window.leads:
            part = replace(part, own_starts=_begun(part, states, paths[window.position]))
        name = f"{window.experiment.id} ({window.start:.4g} to {window.stop:.4g} s)"
        part = replace(part, id=name, record=window.experiment.record_id)
        experiments[fitter.train[window.position]] = part
    return SearchWindows(
        whole=before,
        problem=replace(problem, experiments=tuple(experiments)),
        windows=tuple(windows),
        made=frozenset({p.name for p in problem.parameters} - {p.name for p in before.parameters}),
        rows=_rows_of_search(fitter, windows),
        fitted=fitted,
    )


def _begun(
    part: Experiment, states: RestartableStates, path: LinearisedTrajectory
) -> tuple[OwnStart, ...]:
    """Return the initial states of a part, from the fit to the whole record at its start time."""
    at = min(int(np.searchsorted(path.times, part.start)), len(path.times) - 1)
    values = {target: float(path.signals[name][at]) for name, target in states.targets.items()}
    return tuple(
        replace(own, start=min(max(values[own.variable], own.lower), own.upper))
        for own in states.own_starts(part)
    )


def _root_mean_square(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0
