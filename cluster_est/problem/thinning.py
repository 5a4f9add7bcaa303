"""Thins long records to as few rows as the model's time constants and the noise require.

The outputs are filtered and decimated (`statistics/block_fits.py`), with the noise that remains in
each value. If an output changes fast, as after a jump of an input, its rows are denser, up to all
measured rows. The sum of squares of slow deviations is preserved, so a search takes the same path
as with all rows. The inputs are described by fewer samples.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field
from scipy.sparse import csr_array, eye_array, vstack

from cluster_est.problem.problem import Problem
from cluster_est.problem.process_noise import noise_names
from cluster_est.problem.tables.jumps import jump_times
from cluster_est.settings import Positive, Settings
from cluster_est.statistics.block_fits import (
    NODES,
    SHORTEST_BLOCK,
    BlockFits,
    block_values,
    even_blocks,
    unpredicted,
)
from cluster_est.statistics.fewer_samples import fewer_knots, without_repeats
from cluster_est.statistics.noise.estimate import quantisation_step
from workers.fmu.description import describe_model
from workers.messages import Experiment, FloatArray, Input, IntArray, Output

MOST_ROWS = 2000
"""Rows of each output that "auto" keeps, unless an output needs more; dense windows may add as many
rows again."""

FEWEST = 0.25
"""Share of these rows that the first, longest blocks give; blocks are then halved as necessary."""

LONG = 1.5
"""Least number of rows of a record that is thinned, over the wanted number of rows."""

IN_PARTS = 2
"""Number of rows of a thinned record, over the wanted number, above which only a part of it is used
at first. Such a record covers many hundreds of time constants, which each trial would simulate."""

MOST_BENT = 1.3
"""Largest mean square of the fourth coefficient, over that in blocks half as long. For blocks that
are too long, it is up to 512. Below this limit, the error of a value is below 0.4 of its noise."""

OF_SLOW_NOISE = 4.0
"""Largest value of this quotient for first-order noise, whose spectrum falls with the square of the
frequency. If the quotient of shorter blocks also exceeds 1, the noise is slow. The limit is then
multiplied by that quotient, up to this value."""

BY_CHANCE = 6.0
"""Two standard errors of that quotient, times the square root of the number of blocks."""

MOST_LEFT = 0.7
"""Largest share of the rows after thinning; if more would remain, all rows are kept."""

COLOURED = 1.3
"""Least variance of the fourth coefficient of coloured noise, over the variance within blocks."""

FAST = 5.0
"""Variance within blocks, over the variance of prediction errors, above which the signal itself
changes within a block. For coloured noise, this quotient is below 2."""

NOISY = 0.75
"""Quantile of the blocks' variances that is the noise of an output; at rest it may have none."""

MOST_COMPARED = 1000
"""Approximate largest number of blocks that are used to compare block lengths."""


class ThinningSettings(Settings):
    """Number of rows of long records that a step uses."""

    section: ClassVar[str] = "thinning"

    rows: Literal["auto", "no"] | Positive = Field(
        "auto",
        description="number of rows of each output that close-loop keeps while it looks for "
        f"effects; auto: records of more than {LONG * MOST_ROWS:.0f} rows are thinned "
        f"to about {MOST_ROWS} or fewer; no: all rows are kept",
    )

    def most(self, *, auto: bool = True) -> int | None:
        """Return the largest number of rows of a record; None for no limit.

        `auto` is whether "auto" thins records.
        """
        if isinstance(self.rows, int):
            return self.rows
        return MOST_ROWS if auto and self.rows == "auto" else None


@dataclass(frozen=True)
class Fineness:
    """Accuracy of a thinned record.

    Attributes
    ----------
    tolerance
        Tolerance of the inputs, over the range of each input; 0 keeps all samples.
    shorter
        Divisor of the length of blocks.
    """

    tolerance: float = 3e-3
    shorter: int = 1


WHOLE_INPUTS = Fineness(tolerance=0.0)
"""Inputs with all of their samples, so the simulation is that of the whole record."""

FINENESS = (
    Fineness(),
    Fineness(tolerance=5e-4),
    Fineness(tolerance=5e-4, shorter=2),
    WHOLE_INPUTS,
    replace(WHOLE_INPUTS, shorter=2),
)
"""Levels of accuracy, the coarsest first."""


@dataclass(frozen=True)
class ThinnedProblem:
    """A problem with thinned records.

    Attributes
    ----------
    whole
        The problem with all rows.
    problem
        The thinned problem, with the same experiments.
    rows
        For each experiment and output, the matrix that computes its values from the measured
        values; None for an output that is not thinned.
    sentence
        What was thinned, for the user; "" if nothing was.
    noise
        Upper limit of the standard deviation of the noise of measured rows, by output. It comes
        from the residuals of polynomials in blocks of training experiments.
    within
        Lower limit of this standard deviation: that of the noise within a block. It is small for
        slow noise.
    """

    whole: Problem
    problem: Problem
    rows: tuple[tuple[csr_array | None, ...], ...] = field(repr=False)
    sentence: str
    noise: Mapping[str, float] = field(default_factory=dict)
    within: Mapping[str, float] = field(default_factory=dict)

    @property
    def is_thinner(self) -> bool:
        return bool(self.sentence)

    @property
    def thinned_outputs(self) -> frozenset[tuple[int, str]]:
        """Pairs (index of the experiment, output) of the thinned outputs."""
        return frozenset(
            (e, output.variable)
            for e, (run, own) in enumerate(zip(self.problem.experiments, self.rows, strict=True))
            for output, matrix in zip(run.outputs, own, strict=True)
            if matrix is not None
        )


def thinned(problem: Problem, most: int | None, fineness: Fineness | None = None) -> ThinnedProblem:
    """Thin the long records of a problem.

    Records with up to `LONG` times as many rows are not changed. Problems with process noise are
    not changed, because the filter depends on the steps. Neither are problems with residuals other
    than differences at measured times. In co-simulation, rows are at times of samples, which are
    communication points. Inputs are then kept if the FMU has a fixed communication step.

    Parameters
    ----------
    problem
        A problem whose records have no outliers.
    most
        Wanted number of rows of each output; None keeps all rows.
    fineness
        Accuracy of the thinned records.
    """
    nothing = tuple((None,) * len(e.outputs) for e in problem.experiments)
    plain = problem.plain and all(o.is_plain for e in problem.experiments for o in e.outputs)
    if most is None or not plain or noise_names(problem):
        return ThinnedProblem(problem, problem, nothing, "")
    fineness = fineness or Fineness()
    each = [_Thinning(problem, e, most, fineness) for e in problem.experiments]
    looked = [one.lengths() for one in each]
    coloured = _mostly_coloured(problem, looked)
    parts = [one.run(own, coloured) for one, own in zip(each, looked, strict=True)]
    rows = tuple(tuple(None if t is None else t.matrix for t in own) for _, own in parts)
    changed = replace(problem, experiments=tuple(e for e, _ in parts))
    noise: dict[str, list[tuple[float, float]]] = {}
    for e in problem.indices("train"):
        for thin in parts[e][1]:
            if thin is not None:
                noise.setdefault(thin.output.variable, []).append((thin.noise, thin.within))
    roots = {name: np.sqrt(np.mean(own, axis=0)).tolist() for name, own in noise.items()}
    largest, least = ({name: own[i] for name, own in roots.items()} for i in (0, 1))
    sentence = _sentence(problem, changed)
    return ThinnedProblem(problem, changed, rows, sentence, largest, least)


def rows_of(experiment: Experiment) -> int:
    """Return the largest number of rows of an output."""
    return max((len(output.times) for output in experiment.outputs), default=0)


def looked_at_in_parts(problem: Problem, most: int | None) -> list[int]:
    """Return the training experiments with so many rows that a part of each is sufficient."""
    if most is None:
        return []
    runs = problem.experiments
    return [e for e in problem.indices("train") if rows_of(runs[e]) > IN_PARTS * most]


@dataclass(frozen=True)
class _Rows:
    """The blocks and the single samples from which the rows of some outputs are computed.

    Attributes
    ----------
    values
        Number of rows per block; 1 for coloured noise.
    """

    blocks: IntArray
    samples: IntArray
    values: int = NODES

    @property
    def count(self) -> int:
        return self.values * len(self.blocks) + len(self.samples)


@dataclass(frozen=True)
class _BlockLength:
    """The length of blocks of outputs that were measured at the same times; 0 for no blocks.

    Attributes
    ----------
    own, times
        Indices of the outputs, and their times.
    stretches : (s, 2)
        Ranges of samples between the jumps of inputs.
    coloured
        Whether the noise of each output is probably coloured.
    """

    own: list[int]
    times: FloatArray = field(repr=False)
    length: int
    stretches: IntArray = field(default_factory=lambda: np.zeros((0, 2), int), repr=False)
    coloured: tuple[bool, ...] = ()


@dataclass(frozen=True)
class _ThinnedOutput:
    """A thinned output, its matrix, and two variances of its noise: total, and within blocks."""

    output: Output
    matrix: csr_array = field(repr=False)
    noise: float
    within: float


@dataclass(frozen=True)
class _Thinning:
    """The thinning of one experiment."""

    problem: Problem
    experiment: Experiment
    most: int
    fineness: Fineness

    def lengths(self) -> list[_BlockLength]:
        """Return the length of blocks for each group of outputs with the same times."""
        groups = _of_equal_times(self.experiment.outputs)
        return [self._length(times, own) for times, own in groups]

    def run(
        self, lengths: Sequence[_BlockLength], coloured: Collection[str]
    ) -> tuple[Experiment, tuple[_ThinnedOutput | None, ...]]:
        """Thin the outputs, separately for white and coloured noise, and the inputs."""
        experiment = self.experiment
        made: list[_ThinnedOutput | None] = [None] * len(experiment.outputs)
        for group, colour in product(lengths, (False, True)):
            own = [i for i in group.own if (experiment.outputs[i].variable in coloured) is colour]
            alike = group if own == group.own else self._length(group.times, own)
            rows = self._rows(alike, coloured=colour) if own else None
            if rows is not None:
                for i in own:
                    output = experiment.outputs[i]
                    made[i] = _of_rows(output, rows, at_samples=not self._exchanged)
        if not any(made):
            return experiment, tuple(made)
        outputs = [
            whole if thin is None else thin.output
            for whole, thin in zip(experiment.outputs, made, strict=True)
        ]
        shorter = replace(experiment, outputs=tuple(outputs))
        if self._exchanged or (self.fineness.tolerance and self._any_step):
            shorter = self._driven(shorter)
        return shorter, tuple(made)

    @property
    def _exchanged(self) -> bool:
        """Whether rows may be at any time; in co-simulation, they are communication points."""
        return self.problem.model.interface == "model_exchange"

    @property
    def _any_step(self) -> bool:
        """Whether the FMU allows communication steps between the samples of thinned inputs."""
        return describe_model(self.problem.model).variable_steps

    def _rows(self, group: _BlockLength, *, coloured: bool) -> _Rows | None:
        """Choose the rows of some outputs; None if all are kept."""
        if not group.length:
            return None
        stretches, times = group.stretches, group.times
        long = _long(stretches)
        short = _single(stretches[np.diff(stretches)[:, 0] < SHORTEST_BLOCK])
        length = group.length // (NODES if coloured else 1) // self.fineness.shorter
        blocks = _long(even_blocks(long, max(length, SHORTEST_BLOCK)))
        if coloured:
            found = _Rows(blocks, short, 1)
        else:
            signals = [self.experiment.outputs[i].values for i in group.own]
            slow = [_slow(BlockFits.of(blocks, times, y)) for y in signals]
            found = _with_windows(_refined(blocks, times, signals, slow), short, self.most)
        return found if found.count < MOST_LEFT * len(times) else None

    def _stretches(self, times: FloatArray) -> IntArray:
        """Return the ranges of samples between the jumps of inputs: (s, 2)."""
        jumps = [jump_times(given) for given in self.experiment.inputs]
        at = np.searchsorted(times, np.concatenate([np.zeros(0), *jumps]), side="right")
        edges = np.unique(np.concatenate([[0], at, [len(times)]]))
        return np.column_stack([edges[:-1], edges[1:]])

    def _length(self, times: FloatArray, own: list[int]) -> _BlockLength:
        """Find the largest length of blocks for some outputs.

        Noise is coloured if the fourth coefficient is large in blocks of a third of this length.
        A signal has no such coefficient there.
        """
        if len(times) <= LONG * self.most:
            return _BlockLength(own, times, 0)
        stretches, signals = (
            self._stretches(times),
            [self.experiment.outputs[i].values for i in own],
        )
        long = _long(stretches)
        length = max(int(NODES * len(times) / (FEWEST * self.most)), SHORTEST_BLOCK)
        while not self._short_enough(length, long, times, signals):
            length //= 2
        if length < SHORTEST_BLOCK:
            return _BlockLength(own, times, 0)
        blocks = _some(even_blocks(long, max(length // NODES, SHORTEST_BLOCK)))
        coloured = tuple(_is_coloured(BlockFits.of(blocks, times, y)) for y in signals)
        return _BlockLength(own, times, length, stretches, coloured)

    def _short_enough(
        self, length: int, long: IntArray, times: FloatArray, signals: Sequence[FloatArray]
    ) -> bool:
        """Return whether parabolas follow the signals in blocks of this length."""
        if length < SHORTEST_BLOCK:
            return True
        for y in signals:
            fits = BlockFits.of(_some(even_blocks(long, length)), times, y)
            if fits.noise > FAST * unpredicted(y):
                return False
            if length < 2 * SHORTEST_BLOCK:
                continue
            half = BlockFits.of(_some(even_blocks(long, length // 2)), times, y)
            most = max(MOST_BENT, 1.0 + BY_CHANCE / np.sqrt(len(fits.bounds)))
            if length >= 4 * SHORTEST_BLOCK:
                quarter = BlockFits.of(_some(even_blocks(long, length // 4)), times, y)
                most *= min(max(half.bent / quarter.bent, 1.0), OF_SLOW_NOISE)
            if fits.bent > most * half.bent:
                return False
        return True

    def _driven(self, experiment: Experiment) -> Experiment:
        """Return the experiment with fewer samples of inputs and signals."""
        knots = np.unique(np.concatenate([o.times for o in experiment.outputs]))
        holds = describe_model(self.problem.model).holds
        changed = {
            key: tuple(
                self._shorter(given, knots, held=holds(given.variable))
                for given in getattr(experiment, key)
            )
            for key in ("inputs", "signals")
        }
        return replace(experiment, inputs=changed["inputs"], signals=changed["signals"])

    def _shorter(self, given: Input, knots: FloatArray, *, held: bool) -> Input:
        times, values, kind = given.times, given.values, given.interpolation
        if kind == "hold":
            times, values = without_repeats(times, values)
            if held or len(times) < self.most or not self.fineness.tolerance:
                return replace(given, times=times, values=values)
            # lines through the middles of the steps approximate steps at all times
            times, kind = np.append(times[:1], 0.5 * (times[1:] + times[:-1])), "linear"
            values = np.append(values[:1], values[:-1])
        if held or len(times) <= len(knots) or not self.fineness.tolerance:
            return given
        times, values = fewer_knots(times, values, knots, self.fineness.tolerance)
        return replace(given, times=times, values=values, interpolation=kind)


def _mostly_coloured(problem: Problem, looked: Sequence[Sequence[_BlockLength]]) -> set[str]:
    """Return the outputs whose noise is coloured in most of the thinned records."""
    votes: dict[str, list[bool]] = {}
    for run, groups in zip(problem.experiments, looked, strict=True):
        for group in (each for each in groups if each.length):
            for i, each in zip(group.own, group.coloured, strict=True):
                votes.setdefault(run.outputs[i].variable, []).append(each)
    return {name for name, own in votes.items() if np.mean(own) > 0.5}


def _of_equal_times(outputs: Sequence[Output]) -> Iterator[tuple[FloatArray, list[int]]]:
    """Yield each set of times, and the indices of the outputs measured at these times."""
    found: dict[bytes, list[int]] = {}
    for i, output in enumerate(outputs):
        found.setdefault(output.times.tobytes(), []).append(i)
    for own in found.values():
        yield outputs[own[0]].times, own


def _long(blocks: IntArray) -> IntArray:
    return blocks[np.diff(blocks)[:, 0] >= SHORTEST_BLOCK]


def _some(blocks: IntArray) -> IntArray:
    """Return some evenly spread blocks, enough for a median."""
    return _long(blocks)[:: 1 + len(blocks) // MOST_COMPARED]


def _single(blocks: IntArray) -> IntArray:
    """Return the indices of all samples in some blocks."""
    parts = [np.arange(first, last) for first, last in blocks.tolist()]
    return np.concatenate([np.zeros(0, int), *parts])


def _is_coloured(fits: BlockFits) -> bool:
    by_chance = 1.0 + BY_CHANCE / np.sqrt(max(len(fits.bounds), 1))
    return bool(fits.bent > COLOURED * by_chance * fits.noise > 0.0)


def _slow(fits: BlockFits) -> float:
    """Return the variance of noise in a coefficient; for coloured noise, that of the fourth."""
    return fits.bent if fits.bent > COLOURED * fits.noise else fits.noise


def _refined(
    blocks: IntArray, times: FloatArray, signals: Sequence[FloatArray], slow: Sequence[float]
) -> list[tuple[IntArray, IntArray]]:
    """Halve the blocks in which a parabola does not suffice, down to single samples.

    Returns the smaller blocks and the single samples of each block.
    """
    pieces: list[tuple[list[list[int]], list[int]]] = [([], []) for _ in blocks]
    left, owners = blocks, np.arange(len(blocks))
    while len(left):
        fits = [BlockFits.of(left, times, y) for y in signals]
        poor = np.any([f.poor(s) for f, s in zip(fits, slow, strict=True)], axis=0)
        for owner, block in zip(owners[~poor].tolist(), left[~poor].tolist(), strict=True):
            pieces[owner][0].append(block)
        middle = (left[poor].sum(axis=1) + 1) // 2
        halves = np.vstack(
            [
                np.column_stack([left[poor][:, 0], middle]),
                np.column_stack([middle, left[poor][:, 1]]),
            ]
        )
        owners = np.tile(owners[poor], 2)
        enough = np.diff(halves)[:, 0] >= SHORTEST_BLOCK
        for owner, block in zip(owners[~enough].tolist(), halves[~enough].tolist(), strict=True):
            pieces[owner][1].extend(range(*block))
        left, owners = halves[enough], owners[enough]
    return [(np.array(b, int).reshape(-1, 2), np.array(s, int)) for b, s in pieces]


def _with_windows(pieces: Sequence[tuple[IntArray, IntArray]], short: IntArray, most: int) -> _Rows:
    """Keep the rows of all coarse blocks, and those of as many dense blocks as `most` allows.

    If all dense blocks have more rows, only every second, third or further dense block is kept.
    The fast part of the response is fully resolved in the dense blocks that are kept.
    """
    counts = np.array([_Rows(*piece).count for piece in pieces], int)
    dense = np.flatnonzero(counts > NODES)
    every = 1
    while every < len(dense) and len(short) + int(counts[dense[::every]].sum()) > most:
        every += 1
    gone = set(np.setdiff1d(dense, dense[::every]).tolist())
    chosen = [piece for i, piece in enumerate(pieces) if i not in gone]
    blocks = np.concatenate([np.zeros((0, 2), int), *(b for b, _ in chosen)])
    return _Rows(blocks, np.concatenate([short, *(s for _, s in chosen)]))


def _of_rows(output: Output, rows: _Rows, *, at_samples: bool) -> _ThinnedOutput:
    """Return the output at its rows, with the noise that remains in each row.

    White noise stays white in the three values of a parabola. Coloured noise is correlated between
    these values, so only the middle value is used. The rows are then evenly spaced, and
    autocorrelations can be used as for samples.
    """
    nodes, weights = block_values(rows.blocks, output.times, at_samples=at_samples)
    fits = BlockFits.of(rows.blocks, output.times, output.values)
    memory = fits.noise_memory if rows.values == 1 else None
    if memory is not None:
        nodes, weights = nodes[1::NODES], weights[1::NODES]
    single = eye_array(len(output.times), format="csr")[rows.samples]
    matrix = csr_array(vstack([weights, single]).tocsr())
    times = np.concatenate([nodes, output.times[rows.samples]])
    factors = np.sqrt(np.asarray(matrix.power(2).sum(axis=1)).ravel())
    if memory is not None:  # correlated single samples count no more than the block they are in
        count = float(np.median(np.diff(rows.blocks)))
        factors[: len(nodes)] = np.sqrt(memory.middle)
        factors[len(nodes) :] = np.sqrt(count * memory.middle)
    order = np.argsort(times, kind="stable")
    matrix = csr_array(matrix[order])
    thin = replace(
        output,
        times=times[order],
        values=matrix @ output.values,
        noise_factors=factors[order],
    )
    rounding = quantisation_step(output.values) ** 2 / 12.0
    within = float(np.quantile(fits.variances, NOISY)) if len(fits.variances) else np.inf
    noise = within if memory is None else within / memory.within
    return _ThinnedOutput(thin, matrix, max(noise, rounding), max(within, rounding))


def _sentence(before: Problem, after: Problem) -> str:
    """Return a sentence on the numbers of rows before and after thinning."""
    pairs = [
        (len(old.times), len(new.times))
        for one, other in zip(before.experiments, after.experiments, strict=True)
        for old, new in zip(one.outputs, other.outputs, strict=True)
        if new.noise_factors is not old.noise_factors
    ]
    if not pairs:
        return ""
    old, new = (_range([pair[i] for pair in pairs]) for i in (0, 1))
    return (
        f"long records are thinned from {old} to {new} rows: a parabola is fitted in each block of "
        "rows, and the rows are denser where the outputs change fast"
    )


def _range(counts: Sequence[int]) -> str:
    low, high = min(counts), max(counts)
    return f"{low:,}" if low == high else f"{low:,}-{high:,}"
