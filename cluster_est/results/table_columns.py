"""What every column of every table of a run means; the documentation is made from this.

A test compares it with the tables that runs write.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Column:
    """A column: its Arrow type, its unit ("" where it has none), and what it means."""

    name: str
    type: str
    unit: str
    meaning: str


@dataclass(frozen=True)
class TableMeaning:
    """A table: its name, what a row is, when it is there, and its columns."""

    name: str
    row: str
    there: str
    columns: tuple[Column, ...]


TEXT, WHOLE, NUMBER, TRUTH = "string", "int64", "double", "bool"
TEXTS, NUMBERS = "list<item: string>", "list<item: double>"
ALWAYS, IN_LOOPS = "always", "in runs of close-loop"
OWN = "the parameter's"
OF_OUTPUT = "the output's"

_EXPERIMENT = Column("experiment", TEXT, "", "id of the experiment")
_ROLE = Column("role", TEXT, "", '"train", or "test" for a held-out one')
_OUTPUT = Column("output", TEXT, "", "the FMU's name of the output, or the curve")
_TIME = Column("time", NUMBER, "s", "simulated time; nothing for a point of a curve")
_LABEL = Column("label", TEXT, "", '"k", or "x0[exp5]" where it has a value of its own there')
_COST = Column("cost", NUMBER, "", "its cost; for the sum of squares, in sigmas squared")
_ENDING = Column("ending", TEXT, "", 'how its search ended, such as "converged"')
_BEFORE = Column(
    "simulated_before",
    NUMBER,
    OF_OUTPUT,
    "at the start values; in a closed loop by the declared model fitted; null if that is too much",
)

PARAMETERS = TableMeaning(
    "parameters",
    "estimated or known number",
    ALWAYS,
    (
        _LABEL,
        Column("parameter", TEXT, "", "the parameter that it belongs to"),
        Column("variable", TEXT, "", "the FMU's variable"),
        Column("unit", TEXT, "", "of all numbers of the row"),
        Column("scope", TEXT, "", '"shared", or the experiment or group that it is for'),
        Column("value", NUMBER, OWN, "the estimate"),
        Column("start", NUMBER, OWN, "where the search began"),
        Column("lower", NUMBER, OWN, "lower bound"),
        Column("upper", NUMBER, OWN, "upper bound"),
        Column("scale", TEXT, "", '"linear" or "log"'),
        Column("at_bound", TEXT, "", '"lower" or "upper" where the estimate stands there, else ""'),
        Column("std_error", NUMBER, OWN, "standard error; NaN where the data do not determine it"),
        Column("lower95", NUMBER, OWN, "lower end of the 95 % interval, to first order"),
        Column("upper95", NUMBER, OWN, "its upper end"),
        Column("difference_step", NUMBER, "", "last finite difference, in search coordinates"),
        Column("estimated_on", TEXT, "", '"train", "test", "known" (fixed) or "derived"'),
    ),
)
BEFORE = (
    Column("value_before", NUMBER, OWN, "the estimate without the effects; NaN if new"),
    Column("std_error_before", NUMBER, OWN, "its standard error"),
    Column("lower95_before", NUMBER, OWN, "lower end of its interval"),
    Column("upper95_before", NUMBER, OWN, "upper end of its interval"),
)
"""What parameters.parquet has besides in runs of close-loop."""

TABLES = (
    PARAMETERS,
    TableMeaning(
        "errors",
        "output of each experiment",
        ALWAYS,
        (
            _EXPERIMENT,
            _ROLE,
            _OUTPUT,
            Column("unit", TEXT, "", "of the output"),
            Column("samples", WHOLE, "", "measured values that count"),
            Column("rmse_before", NUMBER, OF_OUTPUT, "root mean square error at the start values"),
            Column("rmse_after", NUMBER, OF_OUTPUT, "at the estimates"),
            Column("relative_before", NUMBER, "", "the same over the signal's standard deviation"),
            Column("relative_after", NUMBER, "", "at the estimates"),
            Column("normalised_before", NUMBER, "", "the same over sigma, or estimated noise"),
            Column("normalised_after", NUMBER, "", "at the estimates"),
        ),
    ),
    TableMeaning(
        "residuals",
        "measured value",
        ALWAYS,
        (
            _EXPERIMENT,
            _ROLE,
            _OUTPUT,
            _TIME,
            Column("measured", NUMBER, OF_OUTPUT, "as in the data"),
            Column("simulated", NUMBER, OF_OUTPUT, "at the estimates"),
            Column("residual", NUMBER, "", "(measured - simulated) / sigma"),
            _BEFORE,
        ),
    ),
    TableMeaning(
        "trajectories",
        "simulated value",
        ALWAYS,
        (
            _EXPERIMENT,
            _OUTPUT,
            Column("time", NUMBER, "s", "simulated time"),
            Column("simulated", NUMBER, OF_OUTPUT, "at the estimates"),
            _BEFORE,
        ),
    ),
    TableMeaning(
        "searches",
        "iteration of each search, its end last",
        ALWAYS,
        (
            Column("search", TEXT, "", '"train", "start 3", "test" and the like'),
            Column("iteration", WHOLE, "", "0 is the start"),
            Column("cost", NUMBER, "", "of the best point so far"),
            Column("step", NUMBER, "", "length of the step, in each unknown's own scale"),
            Column("optimality", NUMBER, "", "how far from a minimum; 0 at one"),
            Column("damping", NUMBER, "", "the method's damping, mesh or simplex size"),
            Column("violation", NUMBER, "", "largest violation of a constraint; NaN without any"),
            Column("ending", TEXT, "", "of its last line: how it ended"),
            Column("evaluations", WHOLE, "", "points asked for so far"),
        ),
    ),
    TableMeaning(
        "workers",
        "worker",
        ALWAYS,
        (
            Column("worker", TEXT, "", "its name"),
            Column("simulations", NUMBER, "", "how many it did"),
            Column("failures", NUMBER, "", "how many of them failed"),
            Column("busy_seconds", NUMBER, "s", "in which it simulated"),
            Column("seconds", NUMBER, "s", "since the workers stood ready"),
        ),
    ),
    TableMeaning(
        "correlations",
        "pair of estimates",
        "where there is more than one estimate",
        (
            _LABEL,
            Column("other", TEXT, "", "label of the other"),
            Column("correlation", NUMBER, "", "of the two estimates, from -1 to 1"),
        ),
    ),
    TableMeaning(
        "directions",
        "parameter in a direction that the data do not determine",
        "where there is such a direction",
        (
            Column("direction", WHOLE, "", "its number"),
            Column("kind", TEXT, "", "what is the matter with it"),
            _LABEL,
            Column("weight", NUMBER, OWN, "how it moves for each 1 that the first one moves"),
            Column("relative", NUMBER, "", "the same as parts of the estimates"),
            Column("ratio", NUMBER, "", "singular value over the largest"),
            Column("limit", NUMBER, "", "below which the ratio counts as undetermined"),
            Column("sentence", TEXT, "", "the direction in words"),
        ),
    ),
    TableMeaning(
        "constraints",
        "constraint",
        "where there are constraints",
        (
            Column("constraint", TEXT, "", "its name, with the experiment's if it is on a signal"),
            Column("kind", TEXT, "", '"<= 0" or "= 0"'),
            Column("before", NUMBER, "", "at the start, over the constraint's scale"),
            Column("after", NUMBER, "", "at the estimates"),
            Column("satisfied", TRUTH, "", "at the estimates"),
        ),
    ),
    TableMeaning(
        "starts",
        "start of a multi-start",
        "where multistart.n is more than 1",
        (
            Column("start", WHOLE, "", "its number; 0 is the parameters' own"),
            _COST,
            _ENDING,
            Column("iterations", WHOLE, "", "of its search"),
            Column("minimum", WHOLE, "", "which minimum it reached, 0 being the best; -1: none"),
        ),
    ),
    TableMeaning(
        "minima",
        "value at each different minimum",
        "where multistart.n is more than 1",
        (
            Column("point", WHOLE, "", "number of the minimum, the best first"),
            _LABEL,
            Column("value", NUMBER, OWN, "there"),
            _COST,
            Column("objectives", "list", "", "empty"),
        ),
    ),
    TableMeaning(
        "front",
        "value at each point that no other beats in all objectives",
        "with the method nsga2",
        (
            Column("point", WHOLE, "", "number of the point, the one of least cost first"),
            _LABEL,
            Column("value", NUMBER, OWN, "there"),
            _COST,
            Column("objectives", "list", "", "its costs, kept apart"),
        ),
    ),
    TableMeaning(
        "intervals",
        "interval that took refits",
        "with uncertainty.profiles or uncertainty.bootstrap",
        (
            _LABEL,
            Column(
                "source", TEXT, "", '"profile", "bootstrap", "bootstrap percentile" or "... basic"'
            ),
            Column("confidence", NUMBER, "", "0.95 for 95 %"),
            Column("value", NUMBER, OWN, "the estimate"),
            Column("lower", NUMBER, OWN, "lower end"),
            Column("upper", NUMBER, OWN, "upper end"),
            Column("open_lower", TEXT, "", "why a profile has no lower end; else empty"),
            Column("open_upper", TEXT, "", "why it has no upper end"),
        ),
    ),
    TableMeaning(
        "profiles",
        "unknown at each point of a profile",
        "with uncertainty.profiles",
        (
            Column("label", TEXT, "", "whose profile it is"),
            Column("point", WHOLE, "", "its number"),
            Column("value", NUMBER, OWN, "at which the profiled one was held"),
            Column("cost", NUMBER, "", "least cost with that"),
            Column("root", NUMBER, "", "signed root of what the cost rises by"),
            Column("unknown", TEXT, "", "label of the unknown that the row is about"),
            Column("estimate", NUMBER, OWN, "where the refit moved it"),
        ),
    ),
    TableMeaning(
        "bootstrap",
        "shared parameter in each draw",
        "with uncertainty.bootstrap",
        (
            Column("draw", WHOLE, "", "its number"),
            _LABEL,
            Column("estimate", NUMBER, OWN, "refitted to the drawn experiments"),
            _COST,
            _ENDING,
            Column("experiments", TEXT, "", "those that were drawn"),
        ),
    ),
    TableMeaning(
        "effects",
        "coefficient of each effect that was added",
        IN_LOOPS,
        (
            Column("effect", TEXT, "", "its name"),
            Column("family", TEXT, "", 'its kind, such as "friction"'),
            Column("site", TEXT, "", 'where it acts, such as "der(v)"'),
            Column("form", TEXT, "", "the form of the library"),
            Column("variables", TEXTS, "", "what it is a function of"),
            Column("equation", TEXT, "", "in the FMU's names"),
            Column("coefficient", TEXT, "", "name of the number that the row is about"),
            Column("value", NUMBER, "", "its estimate, in `unit`"),
            Column("unit", TEXT, "", "of the numbers of the row"),
            Column("std_error", NUMBER, "", "standard error, in `unit`"),
            Column("lower95", NUMBER, "", "lower end of the 95 % interval, in `unit`"),
            Column("upper95", NUMBER, "", "its upper end"),
            Column("fixed", TRUTH, "", "whether it was held rather than estimated"),
        ),
    ),
    TableMeaning(
        "findings",
        "candidate of each step",
        IN_LOOPS,
        (
            Column("step", WHOLE, "", "1 for the search for the first effect, and so on"),
            Column("site", TEXT, "", "where it would act"),
            Column("form", TEXT, "", "the form of the library"),
            Column("family", TEXT, "", "its kind"),
            Column("variables", TEXTS, "", "what it is a function of"),
            Column("statistic", NUMBER, "", "score statistic"),
            Column("freedom", WHOLE, "", "its degrees of freedom"),
            Column("log_p", NUMBER, "", "natural logarithm of its own p-value, uncorrected"),
            Column("explained", NUMBER, "", "share of the residual's squares that it carries"),
            Column("distinct", NUMBER, "", "what is left of it beside the declared parameters"),
            Column("stage", TEXT, "", '"screened", "tried", "refitted", "accepted" or "set aside"'),
            Column("criterion", NUMBER, "", "information criterion, less that without it"),
            Column("imitated_by", TEXT, "", "for one set aside: the parameter that imitates it"),
        ),
    ),
    TableMeaning(
        "shapes",
        "effect that was added, and place where it acts",
        IN_LOOPS,
        (
            Column("effect", TEXT, "", "its name"),
            Column("part", TEXT, "", 'where it acts, such as "der(v)"'),
            Column("variable", TEXT, "", "what it is a function of"),
            Column("variable_unit", TEXT, "", "unit of that"),
            Column("unit", TEXT, "", "unit of what it adds"),
            Column("x", NUMBERS, "the variable's", "points over the range that the data visited"),
            Column("y", NUMBERS, "", "what it adds there, in `unit`"),
            Column("lower", NUMBERS, "", "lower end of its 95 % band, in `unit`"),
            Column("upper", NUMBERS, "", "its upper end"),
            Column("edges", NUMBERS, "the variable's", "of the histogram of the training data"),
            Column("counts", NUMBERS, "", "samples between two edges"),
            Column("why_not", TEXT, "", "why it has no shape; the lists are empty then"),
        ),
    ),
    TableMeaning(
        "evaluations",
        "simulation, in the files evaluations/*.arrows",
        ALWAYS,
        (
            Column("key", TEXT, "", "hash of all that the answer depends on"),
            Column("want", TEXT, "", '"residuals", "squares", "absolutes", "trajectory", ...'),
            Column("search", TEXT, "", "which search asked"),
            Column("evaluation", WHOLE, "", "number of the point in that search"),
            Column("purpose", TEXT, "", '"start", "jacobian", "trial", "trajectory", ...'),
            _EXPERIMENT,
            Column("values", NUMBERS, "the FMU's", "physical values, as in the model's parameters"),
            Column("effects", TEXTS, "", "what was added to the model"),
            Column("status", TEXT, "", '"ok", or how it failed'),
            Column("message", TEXT, "", "why it failed"),
            Column("cost", NUMBER, "", "sum of the squares of its residuals"),
            Column("residuals", NUMBERS, "", "over sigma, output after output"),
            Column("constraints", NUMBERS, "", "of signals, over their scales"),
            Column("seconds", NUMBER, "s", "what it took"),
            Column("worker", TEXT, "", "who did it"),
            Column("ended", NUMBER, "s", "when its answer came, since 1970, UTC"),
            Column("variables", TEXTS, "", "of the trajectory"),
            Column("times", NUMBERS, "s", "of the trajectory"),
            Column("trajectory", NUMBERS, "the FMU's", "(times, variables), row after row"),
        ),
    ),
    TableMeaning(
        "summary",
        "run of a sweep, in the sweep's folder",
        "in sweeps; with a column for each axis and for each shared parameter",
        (
            Column("run", TEXT, "", "its name, which is that of its folder"),
            Column("config", TEXT, "", "the config that it is made from"),
            Column("status", TEXT, "", '"done", "failed", "not converged", "not run", ...'),
            Column("message", TEXT, "", "why it ended"),
            Column("cost_before", NUMBER, "", "at the start"),
            Column("cost", NUMBER, "", "at the estimates"),
            Column("rmse_train", NUMBER, "", "root mean square error over sigma"),
            Column("rmse_test", NUMBER, "", "of the held-out experiments; null without any"),
            Column("iterations", WHOLE, "", "of the search"),
            Column("evaluations", WHOLE, "", "points that were asked for"),
            Column("simulations", WHOLE, "", "of one experiment each"),
            Column("failures", WHOLE, "", "simulations that failed"),
            Column("seconds", NUMBER, "s", "what it took"),
            Column("seed", WHOLE, "", "of the method"),
            Column("started", TEXT, "", "date and time, UTC"),
        ),
    ),
)
