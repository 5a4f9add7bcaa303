"""A value with two names is given once: of two, whichever is set last would count."""

import numpy as np
import pytest

import cluster_est as ce
from cluster_est.errors import ProblemError
from cluster_est.preflight.draft import candidates
from cluster_est.preflight.subject import bare_problem
from workers.fmu.description import describe

BOTH = pytest.mark.parametrize("fmi", [2, 3])
TIMES = np.linspace(0.0, 2.0, 21)
DECAY = np.exp(-TIMES)


def problem(path, names, outputs=("y",), **given):
    parameters = tuple(ce.Parameter(name, 1.0, (0.1, 10.0)) for name in names)
    model = ce.read_model(path)
    measured = tuple(ce.Output(name, TIMES, DECAY) for name in outputs)
    inputs = given.pop("inputs", ())
    experiment = ce.Experiment("a", 0.0, 2.0, inputs, measured, **given)
    return ce.Problem(model, parameters, (experiment,))


@BOTH
@pytest.mark.parametrize(
    ("names", "given", "said"),
    [
        (
            ("k", "kk"),
            {},
            "parameters.kk: 'kk' is another name of 'k', which is",
        ),
        (("k",), {"values": (("kk", 2.0),)}, "'a'.values.kk: 'kk' is another name of 'k'"),
        (
            ("kk",),
            {"values": (("k", 2.0),)},
            "'kk', which is already in parameters.kk",
        ),
        (
            (),
            {"values": (("k", 1.0), ("kk", 2.0))},
            "another name of 'k', which is already in experiment 'a'",
        ),
        ((), {"inputs": ("u", "uu")}, "another name of 'u'"),
        (("u",), {"inputs": ("uu",)}, "another name of 'u'"),
        ((), {"inputs": ("u",), "values": (("uu", 1.0),)}, "another name of 'uu'"),
    ],
)
def test_two_names_of_one_value_are_refused(own_fmu, fmi, names, given, said):
    if "inputs" in given:
        signals = tuple(ce.Input(name, TIMES, 0.0 * TIMES) for name in given["inputs"])
        given = given | {"inputs": signals}
    asked = problem(own_fmu("two_names", fmi), names, **given)
    with pytest.raises(ProblemError, match="another name of") as refused:
        asked.describe()
    assert said in str(refused.value)


@BOTH
def test_one_of_two_names_is_enough_and_outputs_may_have_both(own_fmu, fmi):
    asked = problem(own_fmu("two_names", fmi), ("kk",), ("y", "xx", "x"))
    asked.describe()


@BOTH
def test_a_parameter_with_two_names_is_proposed_once(own_fmu, fmi):
    path = own_fmu("two_names", fmi)
    assert bare_problem(path).model.parameters == ("k",)
    bare_problem(path).describe()
    active = [c for c in candidates(describe(path.name, path.read_bytes())) if not c.why_not]
    assert [c.variable.name for c in active] == ["k"]
