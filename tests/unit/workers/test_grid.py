import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from workers.grid import build_grid
from workers.messages import Experiment, FloatArray, Input, Output

START, STOP = -1.0, 3.0

values = st.floats(-1e3, 1e3)


def moments(first: float, last: float, least: int) -> st.SearchStrategy[list[float]]:
    """Times on a lattice that is fine but far above rounding, so that slopes stay meaningful."""
    ticks = st.integers(int(first * 1024), int(last * 1024))
    return st.lists(ticks, min_size=least, max_size=12, unique=True).map(
        lambda found: [tick / 1024 for tick in sorted(found)]
    )


@st.composite
def inputs(draw: st.DrawFn) -> Input:
    """A signal that may start before or after the experiment, and end before or after it."""
    times = draw(moments(START - 1.0, STOP + 1.0, 1))
    samples = draw(st.lists(values, min_size=len(times), max_size=len(times)))
    kind = draw(st.sampled_from(["linear", "hold"]))
    return Input("u", np.array(times), np.array(samples), kind)


@st.composite
def outputs(draw: st.DrawFn) -> Output:
    times = draw(moments(START, STOP, 0))
    samples = draw(st.lists(values, min_size=len(times), max_size=len(times)))
    name = draw(st.sampled_from(["y", "z", "v"]))
    return Output(name, np.array(times), np.array(samples), draw(st.floats(0.1, 10.0)))


experiments = st.builds(
    lambda given, measured: Experiment("e", START, STOP, tuple(given), tuple(measured)),
    st.lists(inputs(), max_size=3),
    st.lists(outputs(), max_size=3, unique_by=lambda output: output.variable),
)


def signal(given: Input, at: FloatArray) -> FloatArray:
    """The signal at some times, one by one and from its definition."""
    if given.interpolation == "linear":
        return np.interp(at, given.times, given.values)
    latest = [given.values[given.times <= t] for t in at]
    return np.array([before[-1] if len(before) else given.values[0] for before in latest])


@settings(max_examples=50)
@given(experiments, st.floats(0.0, 0.999))
def test_every_signal_is_on_the_grid_as_it_was_measured(experiment, part):
    grid = build_grid(experiment)
    times = grid.times
    assert (times[0], times[-1]) == (START, STOP)
    assert (np.diff(times) > 0.0).all()
    for output in experiment.outputs:
        assert np.isin(output.times, times).all()
    lengths = part * np.diff(times)
    for column, known in enumerate(experiment.inputs):
        values, slopes = grid.inputs[:, column], grid.slopes[:, column]
        inside = (known.times >= START) & (known.times <= STOP)
        assert np.isin(known.times[inside], times).all()
        at_knots = np.searchsorted(times, known.times[inside])
        np.testing.assert_array_equal(values[at_knots], known.values[inside], strict=True)
        rebuilt = values[:-1] + lengths * slopes[:-1]
        between = signal(known, times[:-1] + lengths)
        np.testing.assert_allclose(rebuilt, between, rtol=0, atol=1e-9)
        if known.interpolation == "hold":  # right-continuous
            assert (slopes == 0.0).all()
            np.testing.assert_array_equal(values, signal(known, times), strict=True)
        early, late = times < known.times[0], times >= known.times[-1]
        assert (values[early] == known.values[0]).all()
        assert (values[late] == known.values[-1]).all()
        assert (slopes[late] == 0.0).all()


@settings(max_examples=30)
@given(experiments)
def test_gather_picks_each_output_at_its_own_times(experiment):
    grid = build_grid(experiment)
    names = experiment.recorded
    width = len(names)
    record = np.empty((len(grid.times), width, 2))
    record[:, :, 0] = grid.times[:, None]
    record[:, :, 1] = np.arange(width)
    picked = record.reshape(-1, 2)[grid.gather]
    expected = [(t, names.index(o.variable)) for o in experiment.outputs for t in o.times]
    np.testing.assert_array_equal(picked, np.array(expected).reshape(-1, 2))
    for found, name in ((grid.measured, "values"), (grid.sigmas, "sigma")):
        whole = [np.full(len(o.times), getattr(o, name)) for o in experiment.outputs]
        np.testing.assert_array_equal(found, np.concatenate([np.zeros(0), *whole]))


def test_shapes_without_inputs():
    output = Output("y", np.array([0.0, 1.0]), np.zeros(2))
    grid = build_grid(Experiment("e", START, STOP, (), (output,)))
    np.testing.assert_array_equal(grid.times, [START, 0.0, 1.0, STOP])
    assert grid.inputs.shape == grid.slopes.shape == (4, 0)


def test_jump_of_a_held_input_stands_after_it_and_a_linear_kink_on_it():
    held = Input("a", np.array([0.0, 1.0]), np.array([1.0, 5.0]), "hold")
    linear = Input("b", np.array([0.0, 2.0]), np.array([0.0, 4.0]))
    grid = build_grid(Experiment("e", 0.0, 3.0, (held, linear), ()))
    np.testing.assert_array_equal(grid.times, [0.0, 1.0, 2.0, 3.0])
    np.testing.assert_array_equal(grid.inputs, [[1, 0], [5, 2], [5, 4], [5, 4]])
    np.testing.assert_array_equal(grid.slopes, [[0, 2], [0, 2], [0, 0], [0, 0]])
