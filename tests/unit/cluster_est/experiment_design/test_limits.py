import math

import pytest

from cluster_est.config.limits_file import read_limits
from cluster_est.errors import ConfigError, ProblemError
from cluster_est.experiment_design.limits import ExperimentLimits, InputLimits

PLAIN = """
duration = 10.0
sample_time = 0.02
[inputs.F]
lower = -8.0
upper = 8.0
"""


def read(tmp_path, text):
    path = tmp_path / "limits.toml"
    path.write_text(text, encoding="utf-8")
    return read_limits(path)


def test_a_file_says_what_the_experiment_may_be(tmp_path):
    found = read(
        tmp_path,
        PLAIN.replace("10.0", "[5.0, 20.0]")
        + "rate = 100.0\nstart = 0.0\n[signals.x]\nupper = 1.0\n"
        + "[start.x0]\nlower = 0.0\nupper = 2.0\n",
    )
    limits = found.limits
    assert limits.duration == (5.0, 20.0)
    assert limits.inputs["F"] == InputLimits(-8.0, 8.0, 100.0, 0.0)
    assert (limits.signals["x"].lower, limits.signals["x"].upper) == (-math.inf, 1.0)
    assert limits.start["x0"].upper == 2.0
    assert found.settings.candidates == 120


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("upper = 8.0", "upper = -9.0", "inputs.F.lower.* must be below upper.*-9.*-8"),
        ("upper = 8.0", "uper = 8.0", "inputs.F.uper.*did you mean 'upper'"),
        ("10.0", "0.1", "sample_time.* at least 10 samples.* 0.1 s"),
        ("10.0", "1e5", "sample_time.* at most 200,000 samples"),
        ("10.0", "[9.0, 3.0]", "duration.* must be a positive number of seconds, or .short"),
        ("10.0", "nan", "duration: must be"),
        ("upper = 8.0", "upper = 8.0\nstart = 9.0", "inputs.F.start: must lie between lower"),
        ("upper = 8.0", "upper = 8.0\nrate = 0.0", "inputs.F.rate: must be greater than 0"),
        ("upper = 8.0", "upper = 8.0\nhold = 11.0", "inputs.F.hold: must be at most the duration"),
        ("duration", 'criterion = "e"\nduration', "criterion: must be one of 'discriminate', 'd'"),
        (
            "duration",
            'waveforms = ["saw"]\nduration',
            "waveforms: each must be one of steps, ramps,",
        ),
        ("duration", "candidates = 3\nduration", "candidates: must be at least 10, but is 3"),
        ("[inputs.F]\nlower = -8.0\nupper = 8.0\n", "", "inputs: must name at least one input"),
        ("upper = 8.0", "upper = 8.0\n[signals.x]", "signals.x: must have lower or upper"),
        ("duration = 10.0\n", "", "duration is missing"),
        ("duration = 10.0", "duration = ", "must be TOML, but is not"),
    ],
)
def test_what_no_experiment_can_keep_is_refused_in_a_sentence(tmp_path, old, new, sentence):
    with pytest.raises(ConfigError, match=sentence) as raised:
        read(tmp_path, PLAIN.replace(old, new))
    assert "limits.toml" in str(raised.value)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(ConfigError, match="--limits: there is no file"):
        read_limits(tmp_path / "none.toml")


def test_limits_from_python_are_checked_as_those_of_a_file():
    with pytest.raises(ProblemError, match=r"inputs\.F\.lower: must be below upper"):
        ExperimentLimits({"F": InputLimits(1.0, 0.0)}, (1.0, 1.0), 0.01)
    assert ExperimentLimits({"F": InputLimits(0.0, 1.0)}, 1.0, 0.01).duration == (1.0, 1.0)
