from dataclasses import replace

import numpy as np
import pytest
from support.exported import (
    Exported,
    co_simulated,
    finely_co_simulated,
    output_of,
    repair_of,
    unpacked,
)
from support.problems.driven_spring import driven, model_of
from support.simulated import simulated
from support.thinning import thinned
from support.truth.springs_with_effects import FORCE, SITES, TIMES, C, K, M

from workers.effects.forms import FORMS, FormCondition
from workers.messages import Effect, Input, Output, Solver

SOLVERS = {
    "dormand_prince": Solver("dormand_prince"),
    "rk4": Solver("rk4", step=0.005),
    "fmu": Solver("fmu", step=0.005),
}
LAGGARDS = ("lag", "delay")
LIMITED = ("rate_limit", "rate_limit_from_rest")
FINE = tuple(
    (kind, name, "dormand_prince")
    for (kind, name), form in FORMS.items()
    if kind in ("input", "output") and form.finer_than
)
"""Fine curves of a signal, each alone: one of another would be an equation of pages."""
GROUPS = {
    "input": ("function", "late", "limited", "curve", "force"),
    "derivative": ("function", "states"),
}
CASES = [
    (kind, group, solver)
    for kind in SITES
    for group in GROUPS.get(kind, ("function",))
    for solver in SOLVERS
    if (solver == "dormand_prince")
    or (solver == "rk4" and kind in ("derivative", "input"))
    or (solver == "fmu" and kind not in ("derivative", "pair"))
]
CASES = thinned(
    [*CASES, *FINE],
    lambda kind, group, solver: kind,
    lambda kind, group, solver: group.rstrip("_0123456789"),
    lambda kind, group, solver: solver,
)


def group_of(form):
    """At inputs, where one effect enlarges how those before it are rounded, what goes together."""
    if form.name in LAGGARDS:
        return "late"
    if form.free:
        return form.name if form.finer_than else "curve"
    if form.name in LIMITED:
        return "limited"
    return "force" if FormCondition.FORCE in form.when else "function"


def is_in(form, kind, group):
    """Whether a form of a kind of site is one of those that are exported together."""
    if kind == "input":
        return group_of(form) == group
    if kind == "derivative":  # all at once would run away
        return ("states" if form.states else "function") == group
    return (form.name if kind == "output" and form.finer_than else "function") == group


def effects_of(kind, group="function"):
    """An effect of each form of a kind, and the values of their coefficients."""
    limit = 2.0 if kind == "input" else 0.05
    known = {"low": -0.5, "limit": limit, "tau": 0.03, "width": 0.05, "high": 0.5, "rate": 20.0}
    known["zero"] = 1.0 if kind == "derivative" else 10.0  # of a larger one it runs away
    forms = [f for k, f in FORMS if k == kind and is_in(FORMS[k, f], kind, group)]
    effects, values = [], []
    for number, name in enumerate(forms):
        form = FORMS[kind, name]
        variables = ("v", "x") if kind == "derivative" else ("F", "F")
        if name == "switch":  # of the state itself it is a friction that pushes
            variables = ("x",)
        effects.append(Effect(f"e{number}", SITES[kind], name, variables[: form.variables]))
        shape = 2.0 if name == "hysteresis" else 0.04  # slow: its steps follow the whole record
        own = known | ({"width": 0.5} if name == "exponential" else {})  # else it runs away
        own |= {"n": 2.0} if name == "hill_power" else {}  # of a smaller one it is a step at zero
        if (kind, name) == ("output", "backlash"):  # a larger one is never crossed
            own |= {"k": 0.01}
        values += [own.get(c.name, 0.3 if c.neutral == 0.0 else shape) for c in form.coefficients]
    return effects, values


@pytest.mark.parametrize(("kind", "group", "name"), CASES)
def test_every_form_is_the_same_in_c(kind, group, name, tmp_path):
    """All forms of a kind at one site, one after the other."""
    solver = SOLVERS[name]
    effects, values = effects_of(kind, group)
    repair = repair_of(model_of(solver), driven(), (M, K, C), effects, values)
    exported = Exported(unpacked(repair, tmp_path))
    exported.begin({"F": FORCE[0]})
    follow, bar = (finely_co_simulated, 3e-5) if kind == "output" else (co_simulated, 1e-6)
    found = follow(exported, TIMES, {"F": FORCE}, "y")
    exported.close()
    expected = simulated(model_of(solver), driven(), (M, K, C, *values), effects)
    np.testing.assert_allclose(found, expected[:, 0], rtol=1e-9, atol=bar)


ALONE = {
    "none": ((), ()),
    "derivative": ((Effect("drag", "der(v)", "quadratic"),), (0.5,)),
    "input": ((Effect("more", "input F", "gain"), Effect("late", "input F", "lag")), (0.2, 0.05)),
    "output": ((Effect("bent", "output y", "cubic"),), (0.3,)),
}
"""Effects whose bits depend on nothing that a step does not know: no delays, no own states at
outputs, which are linear within a step."""
SIXTY_FOURTHS = np.arange(129) / 64.0
"""Times whose differences are exact, as an importer adds them up."""


@pytest.mark.parametrize("hold", [False, True])
@pytest.mark.parametrize("name", [*SOLVERS, "halves"])
@pytest.mark.parametrize("where", ALONE)
def test_its_bits_are_those_of_a_simulation(where, name, hold, tmp_path):
    solver = Solver("rk4", step=1.0 / 128.0) if name == "halves" else Solver(name)
    if name == "fmu" and where == "derivative":
        pytest.skip("there are none in co-simulation")
    force = 2.0 * np.sin(3.0 * SIXTY_FOURTHS) + np.cos(7.0 * SIXTY_FOURTHS)
    measured = replace(
        driven(),
        start=0.0,
        stop=float(SIXTY_FOURTHS[-1]),
        inputs=(Input("F", SIXTY_FOURTHS, force, "hold" if hold else "linear"),),
        outputs=(Output("y", SIXTY_FOURTHS, np.zeros(len(force))),),
    )
    effects, values = ALONE[where]
    folder = unpacked(repair_of(model_of(solver), measured, (M, K, C), effects, values), tmp_path)
    found = output_of(folder, SIXTY_FOURTHS, {"F": force}, "y", hold=hold)
    expected = simulated(model_of(solver), measured, (M, K, C, *values), effects)[:, 0]
    assert found.tobytes() == expected.tobytes()
