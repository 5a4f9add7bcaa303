import pytest
from support.spoiled import REMOVED, write_input

A = "experiments.0"
STEP = {"final": 1.0, "rise_time": 0.1, "settling_time": 0.2}
UNMEASURED = {f"{A}.{key}": REMOVED for key in ("data", "time", "inputs", "outputs")}


def output(**keys):
    return {f"{A}.outputs.y": {"column": "position", **keys}}


def options(name, **keys):
    return {"method": {"name": name, "options": keys}}


def constraint(**keys):
    return {"constraints": [keys]}


def on_y(**keys):
    return constraint(signal="y", **keys)


def step(**keys):
    return on_y(step_response=STEP | keys)


def curve(columns=REMOVED, **keys):
    given = {} if columns is REMOVED else {"columns": columns}
    return {f"{A}.curve": given | keys}


METHODS = [
    (options("least_squares", trails=3), "trails.*least_squares has no such option.*'trials'"),
    (options("least_squares", trials=0), "method.options.trials: .*at least 1.*0"),
    (options("least_squares", trials=2.5), "trials: .*whole number.*2.5"),
    (options("least_squares", trials=True), "trials: .*whole number.*true"),
    (options("least_squares", ftol="x"), "method.options.ftol: .*number.*'x'"),
    (options("least_squares", ftol=float("inf")), "ftol: .*finite.*inf"),
    (options("least_squares", ftol=-1e-9), "ftol: .*at least 0.*-1e-09"),
    (options("least_squares", differences="fwd"), "differences: .*'sensitivities'.*'fwd'"),
    (options("scipy_least_squares", algorithm="lm"), "options.algorithm.*does not support bounds"),
    (options("pattern_search", contraction=1.5), "method.options.contraction: .*1.5"),
    (options("sqp", algorithm="ipopt"), "method.options.algorithm: .*'native'.*'ipopt'"),
]
SUITABLE = [
    (
        options("scipy_least_squares") | constraint(expression="m <= k"),
        "method.name: scipy_least_squares does not support constraints.*'m <= k'.*choose",
    ),
    (
        options("scipy_least_squares") | on_y(upper=1.0),
        r"scipy_least_squares does not support constraints.*'y upper \[a\]'.*or remove the "
        "constraints",
    ),
    (
        options("scipy_least_squares") | {"cost.name": "sae"},
        "method.name: scipy_least_squares needs residuals.*cost.name is 'sae'",
    ),
    ({"cost.name": "sae"}, "method.name: least_squares needs residuals.*'sae'.*change one"),
    (options("nelder_mead"), r'm.bounds: .*\[0.1, 10\].*bounds = "enforce"'),
    (options("de") | {"parameters.m.bounds": REMOVED}, "parameters.m.bounds: .*finite"),
]
COSTS = [
    ({"cost": {"name": "huber", "options": {"scal": 1}}}, "cost.options.scal: huber.*'scale'"),
    ({"cost": {"name": "huber", "options": {"scale": 0}}}, "options.scale: .*1e-100.*0"),
    ({"cost": {"name": "cauchy", "options": {"scale": "x"}}}, "options.scale: .*number.*'x'"),
    ({"cost.name": "total"}, "cost.name: .*cost.function is missing; add it, or choose another"),
    ({"cost.time_base": "simulated"}, "cost.step is missing.*seconds.*'simulated'"),
    ({"cost.time_base": "both", "cost.step": 1e-12}, "cost.step: .*10000000 .*0.3 s.*1e-12 s"),
    ({"cost.weights": {"z": 1.0}}, "cost.weights.z: .*an output.*'y'"),
    (output(interpolation="cubic"), "outputs.y.interpolation: .*'linear' or 'hold'.*'cubic'"),
    (output(weight=-1), "outputs.y.weight: .*greater than 0.*-1"),
]
KINDS = [
    (constraint(), r"constraints\[0\]: .*one of expression, signal and function.*none"),
    (
        constraint(expression="m <= k", signal="y", upper=1),
        r"constraints\[0\]: .*one of expression, signal and function.*has expression and signal",
    ),
    (constraint(expression="m <= k", upper=1), r"\[0\].upper: .*left out with expression"),
    (constraint(expression="m <= k", equality=True), r"\[0\].equality: .*left out"),
    (constraint(expression="m <= k", experiments=["a"]), r"\[0\].experiments: .*left out"),
    (constraint(name="mass", expression="m <= q"), r"constraints\[mass\].*unknown.*'q'.*'m', 'k'"),
    (constraint(expression=5), r"\[0\].expression: .*text in quotes.*5"),
]
SIGNALS = [
    (constraint(signal="q", upper=1.0), r"\[0\].signal.*no variable 'q'.*'x', 'v'"),
    (constraint(signal="m", upper=1.0), "causality is 'parameter'.*choose an output"),
    (constraint(signal="F", upper=1.0), "causality is 'input'.*choose an output"),
    (on_y(), r"\[0\].signal: .*a limit.*none; add one of lower, upper"),
    (on_y(name="box"), r"constraints\[box\].signal: .*a limit"),
    (on_y(uper=1.0), r"unknown key constraints\[0\].uper.*'upper'"),
    (on_y(upper="high"), r"\[0\].upper: .*finite number or \[\[time, value\], ...\].*'high'"),
    (on_y(upper=[[0]]), r"\[0\].upper\[0\]: .*two numbers.*\[0\]"),
    (on_y(upper=10**400), r"\[0\].upper: .*finite number.*1000"),
    (on_y(upper=[[1, 0], [0, 1]]), r"\[0\].upper: .*times must not decrease.*sort"),
    (on_y(upper=[[7, 1], [8, 1]]), r"\[0\].upper: .*limit the signal.*0 and 0.3 s"),
    (on_y(upper=1, lower=2), r"\[0\].lower: .*not be above upper.*0 s.*swap them"),
    (on_y(lower=[[0, 0], [0.3, 3]], upper=2), r"\[0\].lower: .*not be above upper.*at 0.2"),
    (on_y(upper=1, between=[5, 6]), r"\[0\].between: .*overlap the simulation.*0 to 0.3.*\[5.0, 6"),
    (on_y(upper=1, between=[4, 3]), r"\[0\].between: .*\[from, to\].*\[4.0, 3.0\]"),
    (on_y(final=1, between=[0, 1]), r"\[0\].between: .*left out with final"),
    (on_y(upper=1, experiments=["b"]), r"constraints\[0\].experiments: there is no 'b'; .*'a'"),
    (on_y(upper=1, equality=True), r"\[0\].equality: .*left out"),
    (on_y(upper=1, samples=1), r"\[0\].samples: .*greater than 1.*1"),
    (on_y(upper=1, samples=2**62), r"\[0\].samples: .*at most 1e\+07.*46"),
    (on_y(upper=1, scale=0), r"\[0\].scale: .*greater than 0.*0"),
    (on_y(final=1, upper=2), r"\[0\].final: .*be the only limit.*upper and final"),
    (on_y(final=1, tolerance=-1), r"\[0\].tolerance: .*at least 0.*-1"),
    (on_y(upper=2, tolerance=1), r"\[0\].tolerance: .*used with final"),
    (on_y(upper=2, step_response=STEP), r"\[0\].step_response: .*be the only limit"),
    (on_y(step_response=3), r"\[0\].step_response: .*a table.*3"),
    (step(rise=120), "step_response.rise: .*less than 100.*120"),
    (step(rise_tme=1), "unknown key .*step_response.rise_tme.*'rise_time'"),
    (step(time=9.0), r"\[0\].step_response: .*limit the signal.*move its times"),
    (step(rise_time=0.2, settling_time=0.1), "step_response.settling_time: .*before rise_time"),
    (step(initial=1.0), "step_response.initial: must differ from final"),
    (constraint(signal="v", tracking={}), r"\[0\].signal: .*no experiment measures 'v'.*'y'"),
    (on_y(tracking={"relative": -1}), "tracking.relative: .*at least 0.*-1"),
]
DERIVED = [
    (
        {"parameters.m": {"start": 1.0, "expression": "2*k"}},
        "m.start: .*not be used with expression",
    ),
    (
        {"parameters.m": {"expression": "2*k"}, "parameters.k.fixed": True},
        "parameters: at least one must be free",
    ),
]
CURVES = [
    (curve(), r"experiments\['a'\].curve.columns is missing"),
    (curve({}), "curve.columns: .*at least one entry"),
    (curve({"y": "pos"}), "no column 'pos'.*'position'"),
    (
        curve({"y": "position"}, tolerance={"q": 1.0}),
        "tolerance.q: .*one of the names in curve.columns.*'y'",
    ),
    (curve({"y": "position"}, tolerance={"y": -1}), "curve.tolerance.y: .*at least 0.*-1"),
    (curve({"y": "position"}, samples=1), "curve.samples: .*greater than 1.*1"),
    (curve({"y": "position"}, samples=2**62), r"curve.samples: .*at most 1e\+07.*46"),
    (
        UNMEASURED | on_y(upper=1.0),
        r"experiments\['a'\]: .*start and stop \(in seconds\).*both",
    ),
]
STARTS = [
    ({"multistart.points": [{"q": 1.0}]}, "no unknown 'q'.*'m', 'k'"),
    ({"multistart.points": [{"m": 99.0}]}, r"m must lie within its bounds \[0.1, 10\].*99"),
    (
        {"multistart.n": 3, "parameters.m.bounds": REMOVED},
        r"m.bounds: .*finite.*\[-inf, inf\].*multistart.points instead",
    ),
    (
        {"multistart.n": 3, "parameters.k.bounds": [0.0, 99.0]},
        r"parameters.k.bounds: .*finite.*positive.*\[0, 99\]",
    ),
    ({"uncertainty.profiles": ["q"]}, "uncertainty.profiles: .*'m', 'k'"),
    ({"uncertainty.bootstrap": 5}, "uncertainty.bootstrap: .*at least 5 training exp.* 1"),
]
EVERY = (METHODS, SUITABLE, COSTS, KINDS, SIGNALS, DERIVED, CURVES, STARTS)


@pytest.mark.parametrize(("changes", "pattern"), [case for cases in EVERY for case in cases])
def test_it_is_refused_in_one_line(refuse, changes, pattern):
    refuse(changes, pattern)


@pytest.mark.parametrize(("changes", "pattern"), [cases[0] for cases in EVERY])
def test_a_fit_refuses_it_in_the_same_words(tmp_path, refused, changes, pattern):
    """Nothing may be simulated, and no folder written, before it is seen."""
    write_input(tmp_path, changes)
    fit = refused(["fit", "config.toml", "--out", "out"], pattern)
    assert fit == refused(["check", "config.toml"])


@pytest.mark.parametrize("key", ["upper", "lower", "scale"])
def test_a_function_says_all_of_a_constraint(tmp_path, refuse, key):
    (tmp_path / "mine.py").write_text("def f(run):\n    return 0.0\n")
    changes = constraint(function="mine:f", **{key: 1})
    refuse(changes, r"constraints\[0\].function: 'mine:f' names Python code.*add --allow-code")
    refuse(changes, rf"constraints\[0\].{key}: .*left out with", more=("--allow-code",))
