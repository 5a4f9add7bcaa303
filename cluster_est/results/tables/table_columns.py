"""The meaning of every column of every table of a run; the documentation is made from this.

A test compares it with the tables that runs write.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ColumnDescription:
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
    columns: tuple[ColumnDescription, ...]


TEXT, WHOLE, NUMBER, TRUTH = "string", "int64", "double", "bool"
TEXTS, NUMBERS = "list<item: string>", "list<item: double>"
ALWAYS, IN_LOOPS = "always", "in runs of close-loop"
IN_ANALYSES = "in runs of sensitivity"
IN_DESIGNS = "in runs of design"
OWN = "the parameter's"
OF_OUTPUT = "the output's"

_EXPERIMENT = ColumnDescription("experiment", TEXT, "", "id of the experiment")
_ROLE = ColumnDescription("role", TEXT, "", '"train", or "test" for a held-out one')
_OUTPUT = ColumnDescription("output", TEXT, "", "the FMU's name of the output, or the curve")
_TIME = ColumnDescription("time", NUMBER, "s", "simulated time; nothing for a point of a curve")
_LABEL = ColumnDescription(
    "label", TEXT, "", '"k", or "x0[exp5]" where it has a value of its own there'
)
_COST = ColumnDescription("cost", NUMBER, "", "its cost; for the sum of squares, in sigmas squared")
_ENDING = ColumnDescription("ending", TEXT, "", 'how its search ended, such as "converged"')
_BEFORE = ColumnDescription(
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
        ColumnDescription("parameter", TEXT, "", "the parameter that it belongs to"),
        ColumnDescription("variable", TEXT, "", "the FMU's variable"),
        ColumnDescription("unit", TEXT, "", "of all numbers of the row"),
        ColumnDescription("scope", TEXT, "", '"shared", or the experiment or group that it is for'),
        ColumnDescription("value", NUMBER, OWN, "the estimate"),
        ColumnDescription("start", NUMBER, OWN, "where the search began"),
        ColumnDescription("lower", NUMBER, OWN, "lower bound"),
        ColumnDescription("upper", NUMBER, OWN, "upper bound"),
        ColumnDescription("scale", TEXT, "", '"linear" or "log"'),
        ColumnDescription(
            "at_bound", TEXT, "", '"lower" or "upper" where the estimate stands there, else ""'
        ),
        ColumnDescription(
            "std_error", NUMBER, OWN, "standard error; NaN where the data do not determine it"
        ),
        ColumnDescription("lower95", NUMBER, OWN, "lower end of the 95 % interval, to first order"),
        ColumnDescription("upper95", NUMBER, OWN, "its upper end"),
        ColumnDescription("error_white", NUMBER, OWN, "standard error if the noise is white"),
        ColumnDescription(
            "error_autoregression",
            NUMBER,
            OWN,
            "standard error if it is correlated in time; NaN where the residuals are not",
        ),
        ColumnDescription(
            "error_experiments",
            NUMBER,
            OWN,
            "standard error from the scatter of the experiments; NaN where they are too few",
        ),
        ColumnDescription(
            "difference_step", NUMBER, "", "last finite difference, in search coordinates"
        ),
        ColumnDescription(
            "estimated_on", TEXT, "", '"train", "test", "known" (fixed) or "derived"'
        ),
    ),
)
_REFERENCES = (
    ColumnDescription(
        "random", NUMBER, "", "the same with a random input within the limits: the median one"
    ),
    ColumnDescription("recorded", NUMBER, "", "the same with the best input that was recorded"),
)
BEFORE = (
    ColumnDescription("value_before", NUMBER, OWN, "the estimate without the effects; NaN if new"),
    ColumnDescription("std_error_before", NUMBER, OWN, "its standard error"),
    ColumnDescription("lower95_before", NUMBER, OWN, "lower end of its interval"),
    ColumnDescription("upper95_before", NUMBER, OWN, "upper end of its interval"),
)
"""The further columns of parameters.parquet in runs of close-loop."""

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
            ColumnDescription(
                "unit",
                TEXT,
                "",
                'of the output; "" of an ordinal one, whose errors are distances to its categories '
                "over the standard deviation of the simulated signal",
            ),
            ColumnDescription("samples", WHOLE, "", "measured values that count"),
            ColumnDescription(
                "rmse_before", NUMBER, OF_OUTPUT, "root mean square error at the start values"
            ),
            ColumnDescription("rmse_after", NUMBER, OF_OUTPUT, "at the estimates"),
            ColumnDescription(
                "relative_before", NUMBER, "", "the same over the signal's standard deviation"
            ),
            ColumnDescription("relative_after", NUMBER, "", "at the estimates"),
            ColumnDescription(
                "normalised_before", NUMBER, "", "the same over sigma, or estimated noise"
            ),
            ColumnDescription("normalised_after", NUMBER, "", "at the estimates"),
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
            ColumnDescription(
                "measured",
                NUMBER,
                OF_OUTPUT,
                "as in the data; of an ordinal output the value of its category that is nearest to "
                "the simulated one",
            ),
            ColumnDescription("simulated", NUMBER, OF_OUTPUT, "at the estimates"),
            ColumnDescription(
                "residual",
                NUMBER,
                "",
                "(measured - simulated) / sigma; of an ordinal output also over the standard "
                "deviation of the simulated signal",
            ),
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
            ColumnDescription("time", NUMBER, "s", "simulated time"),
            ColumnDescription("simulated", NUMBER, OF_OUTPUT, "at the estimates"),
            _BEFORE,
        ),
    ),
    TableMeaning(
        "searches",
        "iteration of each search, its end last",
        ALWAYS,
        (
            ColumnDescription("search", TEXT, "", '"train", "start 3", "test" and the like'),
            ColumnDescription("iteration", WHOLE, "", "0 is the start"),
            ColumnDescription("cost", NUMBER, "", "of the best point so far"),
            ColumnDescription(
                "step", NUMBER, "", "length of the step, in each unknown's own scale"
            ),
            ColumnDescription("optimality", NUMBER, "", "how far from a minimum; 0 at one"),
            ColumnDescription("damping", NUMBER, "", "the method's damping, mesh or simplex size"),
            ColumnDescription(
                "violation", NUMBER, "", "largest violation of a constraint; NaN without any"
            ),
            ColumnDescription("ending", TEXT, "", "of its last line: how it ended"),
            ColumnDescription("evaluations", WHOLE, "", "points asked for so far"),
        ),
    ),
    TableMeaning(
        "workers",
        "worker",
        ALWAYS,
        (
            ColumnDescription("worker", TEXT, "", "its name"),
            ColumnDescription("simulations", NUMBER, "", "how many it did"),
            ColumnDescription("failures", NUMBER, "", "how many of them failed"),
            ColumnDescription("busy_seconds", NUMBER, "s", "in which it simulated"),
            ColumnDescription("seconds", NUMBER, "s", "since the workers stood ready"),
        ),
    ),
    TableMeaning(
        "correlations",
        "pair of estimates",
        "where there is more than one estimate",
        (
            _LABEL,
            ColumnDescription("other", TEXT, "", "label of the other"),
            ColumnDescription("correlation", NUMBER, "", "of the two estimates, from -1 to 1"),
        ),
    ),
    TableMeaning(
        "directions",
        "parameter in a direction that the data do not determine",
        "where there is such a direction",
        (
            ColumnDescription("direction", WHOLE, "", "its number"),
            ColumnDescription("kind", TEXT, "", "what is the matter with it"),
            _LABEL,
            ColumnDescription(
                "weight", NUMBER, OWN, "how it moves for each 1 that the first one moves"
            ),
            ColumnDescription("relative", NUMBER, "", "the same as parts of the estimates"),
            ColumnDescription("ratio", NUMBER, "", "singular value over the largest"),
            ColumnDescription("limit", NUMBER, "", "below which the ratio counts as undetermined"),
            ColumnDescription("sentence", TEXT, "", "the direction in words"),
        ),
    ),
    TableMeaning(
        "constraints",
        "constraint",
        "where there are constraints",
        (
            ColumnDescription(
                "constraint", TEXT, "", "its name, with the experiment's if it is on a signal"
            ),
            ColumnDescription("kind", TEXT, "", '"<= 0" or "= 0"'),
            ColumnDescription("before", NUMBER, "", "at the start, over the constraint's scale"),
            ColumnDescription("after", NUMBER, "", "at the estimates"),
            ColumnDescription("satisfied", TRUTH, "", "at the estimates"),
        ),
    ),
    TableMeaning(
        "starts",
        "start of a multi-start",
        "where multistart.n is more than 1",
        (
            ColumnDescription("start", WHOLE, "", "its number; 0 is the parameters' own"),
            _COST,
            _ENDING,
            ColumnDescription("iterations", WHOLE, "", "of its search"),
            ColumnDescription(
                "minimum", WHOLE, "", "which minimum it reached, 0 being the best; -1: none"
            ),
        ),
    ),
    TableMeaning(
        "minima",
        "value at each different minimum",
        "where multistart.n is more than 1",
        (
            ColumnDescription("point", WHOLE, "", "number of the minimum, the best first"),
            _LABEL,
            ColumnDescription("value", NUMBER, OWN, "there"),
            _COST,
            ColumnDescription("objectives", "list", "", "empty"),
        ),
    ),
    TableMeaning(
        "front",
        "value at each point that no other beats in all objectives",
        "with the method nsga2",
        (
            ColumnDescription(
                "point", WHOLE, "", "number of the point, the one of least cost first"
            ),
            _LABEL,
            ColumnDescription("value", NUMBER, OWN, "there"),
            _COST,
            ColumnDescription("objectives", "list", "", "its costs, kept apart"),
        ),
    ),
    TableMeaning(
        "intervals",
        "interval that took refits or draws",
        "with uncertainty.profiles, uncertainty.bootstrap or uncertainty.posterior",
        (
            _LABEL,
            ColumnDescription(
                "source",
                TEXT,
                "",
                '"profile", "bootstrap", "bootstrap percentile", "... basic" or "posterior"',
            ),
            ColumnDescription("confidence", NUMBER, "", "0.95 for 95 %"),
            ColumnDescription("value", NUMBER, OWN, "the estimate; of a posterior the median"),
            ColumnDescription("lower", NUMBER, OWN, "lower end"),
            ColumnDescription("upper", NUMBER, OWN, "upper end"),
            ColumnDescription("open_lower", TEXT, "", "why a profile has no lower end; else empty"),
            ColumnDescription("open_upper", TEXT, "", "why it has no upper end"),
        ),
    ),
    TableMeaning(
        "profiles",
        "unknown at each point of a profile",
        "with uncertainty.profiles",
        (
            ColumnDescription("label", TEXT, "", "whose profile it is"),
            ColumnDescription("point", WHOLE, "", "its number"),
            ColumnDescription("value", NUMBER, OWN, "at which the profiled one was held"),
            ColumnDescription("cost", NUMBER, "", "least cost with that"),
            ColumnDescription("root", NUMBER, "", "signed root of what the cost rises by"),
            ColumnDescription("unknown", TEXT, "", "label of the unknown that the row is about"),
            ColumnDescription("estimate", NUMBER, OWN, "where the refit moved it"),
        ),
    ),
    TableMeaning(
        "bootstrap",
        "shared parameter in each draw",
        "with uncertainty.bootstrap",
        (
            ColumnDescription("draw", WHOLE, "", "its number"),
            _LABEL,
            ColumnDescription("estimate", NUMBER, OWN, "refitted to the drawn experiments"),
            _COST,
            _ENDING,
            ColumnDescription("experiments", TEXT, "", "those that were drawn"),
        ),
    ),
    TableMeaning(
        "posterior",
        "parameter in each draw; nearly independent draws, where the chains have mixed",
        "with uncertainty.posterior",
        (
            ColumnDescription("draw", WHOLE, "", "its number"),
            ColumnDescription("walker", WHOLE, "", "the walker that drew it"),
            _LABEL,
            ColumnDescription("value", NUMBER, OWN, "that was drawn"),
            ColumnDescription(
                "log_density", NUMBER, "", "logarithm of the posterior density, but for a constant"
            ),
        ),
    ),
    TableMeaning(
        "predictions",
        "measured time, of outputs by some 200 draws of the posterior",
        "with uncertainty.posterior, where its chains have mixed",
        (
            _EXPERIMENT,
            _ROLE,
            _OUTPUT,
            _TIME,
            ColumnDescription(
                "lower", NUMBER, OF_OUTPUT, "lower end of the band, without the noise of a sensor"
            ),
            ColumnDescription("median", NUMBER, OF_OUTPUT, "half of the draws lie below"),
            ColumnDescription("upper", NUMBER, OF_OUTPUT, "upper end of the band"),
        ),
    ),
    TableMeaning(
        "effects",
        "coefficient of each effect that was added",
        IN_LOOPS,
        (
            ColumnDescription("effect", TEXT, "", "its name"),
            ColumnDescription("family", TEXT, "", 'its kind, such as "friction"'),
            ColumnDescription("site", TEXT, "", 'where it acts, such as "der(v)"'),
            ColumnDescription("form", TEXT, "", "the form of the library"),
            ColumnDescription("variables", TEXTS, "", "what it is a function of"),
            ColumnDescription("equation", TEXT, "", "in the FMU's names"),
            ColumnDescription(
                "words",
                TEXT,
                "",
                'what it is called where the units say so, such as "dry friction"',
            ),
            ColumnDescription("coefficient", TEXT, "", "name of the number that the row is about"),
            ColumnDescription("value", NUMBER, "", "its estimate, in `unit`"),
            ColumnDescription("unit", TEXT, "", "of the numbers of the row"),
            ColumnDescription("std_error", NUMBER, "", "standard error, in `unit`"),
            ColumnDescription("lower95", NUMBER, "", "lower end of the 95 % interval, in `unit`"),
            ColumnDescription("upper95", NUMBER, "", "its upper end"),
            ColumnDescription("fixed", TRUTH, "", "whether it was held rather than estimated"),
        ),
    ),
    TableMeaning(
        "findings",
        "candidate of each step",
        IN_LOOPS,
        (
            ColumnDescription(
                "step", WHOLE, "", "1 for the search for the first effect, and so on"
            ),
            ColumnDescription("site", TEXT, "", "where it would act"),
            ColumnDescription("form", TEXT, "", "the form of the library"),
            ColumnDescription("family", TEXT, "", "its kind"),
            ColumnDescription("variables", TEXTS, "", "what it is a function of"),
            ColumnDescription("statistic", NUMBER, "", "score statistic"),
            ColumnDescription("freedom", WHOLE, "", "its degrees of freedom"),
            ColumnDescription(
                "log_p", NUMBER, "", "natural logarithm of its own p-value, uncorrected"
            ),
            ColumnDescription(
                "explained", NUMBER, "", "share of the residual's squares that it carries"
            ),
            ColumnDescription(
                "distinct", NUMBER, "", "what is left of it beside the declared parameters"
            ),
            ColumnDescription(
                "stage", TEXT, "", '"screened", "tried", "refitted", "accepted" or "set aside"'
            ),
            ColumnDescription(
                "criterion", NUMBER, "", "information criterion, less that without it"
            ),
            ColumnDescription(
                "imitated_by", TEXT, "", "for one set aside: the parameter it is confounded with"
            ),
        ),
    ),
    TableMeaning(
        "structures",
        "set of effects that was refitted, and if the verdict is found for the declared model "
        "(step 0, no effects)",
        IN_LOOPS,
        (
            ColumnDescription("step", WHOLE, "", "the round of the search that refitted it"),
            ColumnDescription(
                "effects",
                TEXTS,
                "",
                'such as "coulomb at der(v)"; "coulomb(w) at der(v)" of another variable',
            ),
            ColumnDescription(
                "criterion", NUMBER, "", "information criterion, less the declared model's"
            ),
            ColumnDescription(
                "closed", NUMBER, "", "share of the gap between error and noise, in training"
            ),
            ColumnDescription(
                "converged",
                TRUTH,
                "",
                "whether its refit went on to convergence; the others fell behind",
            ),
            ColumnDescription(
                "accepted",
                TRUTH,
                "",
                "whether it passed every gate, or came from such a one by revision",
            ),
            ColumnDescription(
                "relative_steps",
                NUMBER,
                "",
                "steps of the solver over those of the declared model, for one simulation of all",
            ),
            ColumnDescription(
                "probability",
                NUMBER,
                "",
                "of the set among all that were compared, if the verdict is found; NaN in its "
                "other rows",
            ),
            ColumnDescription(
                "chosen",
                NUMBER,
                "",
                "share of the draws of experiments in which the set is the best; NaN where it was "
                "not among the leading ones",
            ),
        ),
    ),
    TableMeaning(
        "shapes",
        "effect that was added or declared, and place where it acts",
        "in runs of close-loop, and in fits with `[[effects]]`",
        (
            ColumnDescription("effect", TEXT, "", "its name"),
            ColumnDescription("part", TEXT, "", 'where it acts, such as "der(v)"'),
            ColumnDescription("variable", TEXT, "", "what it is a function of"),
            ColumnDescription("variable_unit", TEXT, "", "unit of that"),
            ColumnDescription("unit", TEXT, "", "unit of what it adds"),
            ColumnDescription(
                "x", NUMBERS, "the variable's", "points over the range that the data visited"
            ),
            ColumnDescription("y", NUMBERS, "", "what it adds there, in `unit`"),
            ColumnDescription("lower", NUMBERS, "", "lower end of its 95 % band, in `unit`"),
            ColumnDescription("upper", NUMBERS, "", "its upper end"),
            ColumnDescription(
                "edges", NUMBERS, "the variable's", "of the histogram of the training data"
            ),
            ColumnDescription("counts", NUMBERS, "", "samples between two edges"),
            ColumnDescription("free_x", NUMBERS, "the variable's", "a few places; empty in a fit"),
            ColumnDescription(
                "free_y", NUMBERS, "", "what the residuals ask for there without a form, in `unit`"
            ),
            ColumnDescription("free_error", NUMBERS, "", "its standard error, in `unit`"),
            ColumnDescription("why_not", TEXT, "", "why it has no shape; the lists are empty then"),
        ),
    ),
    TableMeaning(
        "evaluations",
        "simulation, in the files evaluations/*.arrows",
        ALWAYS,
        (
            ColumnDescription("key", TEXT, "", "hash of all that the answer depends on"),
            ColumnDescription(
                "want", TEXT, "", '"residuals", "squares", "absolutes", "trajectory", ...'
            ),
            ColumnDescription("search", TEXT, "", "which search asked"),
            ColumnDescription("evaluation", WHOLE, "", "number of the point in that search"),
            ColumnDescription(
                "purpose", TEXT, "", '"start", "jacobian", "trial", "trajectory", ...'
            ),
            _EXPERIMENT,
            ColumnDescription(
                "values", NUMBERS, "the FMU's", "physical values, as in the model's parameters"
            ),
            ColumnDescription("effects", TEXTS, "", "what was added to the model"),
            ColumnDescription("status", TEXT, "", '"ok", "ended early", or how it failed'),
            ColumnDescription("message", TEXT, "", "why it failed, or ended early"),
            ColumnDescription("cost", NUMBER, "", "sum of the squares of its residuals"),
            ColumnDescription(
                "residuals",
                NUMBERS,
                "",
                "over sigma, output after output; left out when the run is done, but with "
                "log.keep_residuals",
            ),
            ColumnDescription("residuals_hash", TEXT, "", "hash of their bits, which stays"),
            ColumnDescription("constraints", NUMBERS, "", "of signals, over their scales"),
            ColumnDescription("seconds", NUMBER, "s", "what it took"),
            ColumnDescription("worker", TEXT, "", "who did it"),
            ColumnDescription("ended", NUMBER, "s", "when its answer came, since 1970, UTC"),
            ColumnDescription(
                "bound", NUMBER, "", "sum of squares above which it was to end early; none if empty"
            ),
            ColumnDescription("variables", TEXTS, "", "of the trajectory"),
            ColumnDescription("times", NUMBERS, "s", "of the trajectory"),
            ColumnDescription(
                "trajectory", NUMBERS, "the FMU's", "(times, variables), row after row"
            ),
            ColumnDescription("steps", WHOLE, "", "of the solver; 0 where nobody counts them"),
        ),
    ),
    TableMeaning(
        "ranking",
        "unknown, the one that moves the cost the most first",
        IN_ANALYSES,
        (
            _LABEL,
            ColumnDescription("value", NUMBER, "", "the index of the cost that ranks it"),
            ColumnDescription("half_width", NUMBER, "", "of the 95 % interval of that"),
            ColumnDescription(
                "size",
                NUMBER,
                "sigma",
                "rms of the sensitivities of the residuals at the start, for a noticeable change",
            ),
            ColumnDescription(
                "position", WHOLE, "", "in the order of estimation, from 0; -1: not known"
            ),
            ColumnDescription(
                "collinearity", NUMBER, "", "index of it with those before it in that order"
            ),
            ColumnDescription(
                "together", TRUTH, "", "whether it may be estimated together with those before it"
            ),
        ),
    ),
    TableMeaning(
        "indices",
        "index of one unknown for one quantity",
        IN_ANALYSES,
        (
            _LABEL,
            ColumnDescription("index", TEXT, "", '"mu*" and "sigma", or "first order" and "total"'),
            ColumnDescription(
                "output",
                TEXT,
                "",
                '"log(cost)", or "cost" where that is not always positive, or an output',
            ),
            ColumnDescription("experiment", TEXT, "", 'of an output; "" for the cost'),
            ColumnDescription("time", NUMBER, "s", "of an output; NaN for the cost"),
            ColumnDescription(
                "value", NUMBER, "", "for mu* and sigma in the unit of the output or the cost"
            ),
            ColumnDescription("half_width", NUMBER, "", "of its 95 % interval"),
        ),
    ),
    TableMeaning(
        "scales",
        "output of an experiment that is compared up to scale or offset",
        "where outputs have free_scale or free_offset",
        (
            ColumnDescription("experiment", TEXT, "", "its id"),
            ColumnDescription("role", TEXT, "", '"train" or "test"'),
            ColumnDescription("output", TEXT, "", "of the FMU"),
            ColumnDescription("scale", NUMBER, "", "the factor of what was simulated"),
            ColumnDescription("offset", NUMBER, "the output's", "what was added to it"),
        ),
    ),
    TableMeaning(
        "categories",
        "category of an ordinal output in an experiment",
        "where outputs have ordinal",
        (
            ColumnDescription("experiment", TEXT, "", "its id"),
            ColumnDescription("role", TEXT, "", '"train" or "test"'),
            ColumnDescription("output", TEXT, "", "of the FMU"),
            ColumnDescription("category", NUMBER, "", "the measured value"),
            ColumnDescription(
                "samples", WHOLE, "", "how often, of a held-out part in the training part"
            ),
            ColumnDescription(
                "lower", NUMBER, "the output's", "simulated value that it begins at, or -inf"
            ),
            ColumnDescription("upper", NUMBER, "the output's", "and ends at, or inf"),
        ),
    ),
    TableMeaning(
        "segments",
        "state at the start of a segment of a record",
        "where method.shooting is given",
        (
            ColumnDescription("experiment", TEXT, "", "id of the record"),
            ColumnDescription("segment", WHOLE, "", "its place in the record, counted from 1"),
            ColumnDescription("time", NUMBER, "s", "at which it begins"),
            ColumnDescription("state", TEXT, "", "of the FMU"),
            ColumnDescription("unit", TEXT, "", "of the state"),
            ColumnDescription("guess", NUMBER, "the state's", "that the search began with"),
            ColumnDescription("value", NUMBER, "the state's", "that the segment begins with"),
            ColumnDescription(
                "jump", NUMBER, "the state's", "from the end of the segment before to that"
            ),
            ColumnDescription(
                "relative_jump", NUMBER, "", "the same over the state's spread along the records"
            ),
        ),
    ),
    TableMeaning(
        "candidates",
        "input that was looked at",
        IN_DESIGNS,
        (
            ColumnDescription("candidate", TEXT, "", "its name"),
            ColumnDescription("waveform", TEXT, "", "its family"),
            ColumnDescription("origin", TEXT, "", '"random", "recorded" or "improved"'),
            ColumnDescription("duration", NUMBER, "s", "of the experiment"),
            ColumnDescription(
                "value", NUMBER, "", "what the criterion says of it; NaN where it was put aside"
            ),
            ColumnDescription(
                "violation", NUMBER, "", "of its limits, in their range; NaN if it failed"
            ),
            ColumnDescription("why", TEXT, "", "the limit that it leaves, or why it failed"),
            ColumnDescription("chosen", TRUTH, "", "whether it is the next experiment"),
        ),
    ),
    TableMeaning(
        "probabilities",
        "model that may be the right one, the one that was found first",
        IN_DESIGNS,
        (
            ColumnDescription("model", TEXT, "", "labels of its effects"),
            ColumnDescription(
                "before",
                NUMBER,
                "",
                "its probability so far, among itself and the rivals that some input tells from it",
            ),
            ColumnDescription("after", NUMBER, "", "expected after the experiment, if it is right"),
            *_REFERENCES,
        ),
    ),
    TableMeaning(
        "evidence",
        "pair of such models",
        IN_DESIGNS,
        (
            ColumnDescription("true_model", TEXT, "", "the one that is right"),
            ColumnDescription("rival", TEXT, "", "the other"),
            ColumnDescription(
                "evidence", NUMBER, "", "expected difference of their log likelihoods"
            ),
            *_REFERENCES,
            ColumnDescription("best", NUMBER, "", "the largest with any input looked at"),
        ),
    ),
    TableMeaning(
        "precision",
        "parameter that counts",
        IN_DESIGNS,
        (
            _LABEL,
            ColumnDescription("unit", TEXT, "", "of the parameter"),
            ColumnDescription("value", NUMBER, "the FMU's", "its estimate"),
            ColumnDescription("std_error_before", NUMBER, "the FMU's", "its standard error so far"),
            ColumnDescription("std_error_after", NUMBER, "the FMU's", "with the experiment"),
            *_REFERENCES,
        ),
    ),
    TableMeaning(
        "prediction_precision",
        "output that is to be predicted",
        'in runs of design with criterion = "v"',
        (
            ColumnDescription("experiment", TEXT, "", "that is predicted"),
            ColumnDescription("output", TEXT, "", "of the FMU"),
            ColumnDescription("unit", TEXT, "", "of the output"),
            ColumnDescription(
                "std_error_before",
                NUMBER,
                "the FMU's",
                "what the uncertainty of the parameters makes of it so far, root mean square",
            ),
            ColumnDescription("std_error_after", NUMBER, "the FMU's", "with the experiment"),
            *_REFERENCES,
        ),
    ),
    TableMeaning(
        "next_input",
        "sample of the next experiment",
        "in runs of design; with a column for each input, and an empty one for each output",
        (ColumnDescription("time", NUMBER, "s", "from its beginning"),),
    ),
    TableMeaning(
        "expected",
        "sample of an output, for each model",
        IN_DESIGNS,
        (
            ColumnDescription("model", TEXT, "", "labels of its effects"),
            ColumnDescription("output", TEXT, "", "of the FMU"),
            ColumnDescription("time", NUMBER, "s", "from the beginning"),
            ColumnDescription("expected", NUMBER, "the FMU's", "what the model predicts"),
            ColumnDescription(
                "std_error", NUMBER, "the FMU's", "what the uncertainty of its parameters adds"
            ),
        ),
    ),
    TableMeaning(
        "summary",
        "run of a sweep, in the sweep's folder",
        "in sweeps; with a column for each axis and for each shared parameter",
        (
            ColumnDescription("run", TEXT, "", "its name, which is that of its folder"),
            ColumnDescription("config", TEXT, "", "the config that it is made from"),
            ColumnDescription(
                "status", TEXT, "", '"done", "failed", "not converged", "not run", ...'
            ),
            ColumnDescription("message", TEXT, "", "why it ended"),
            ColumnDescription("doubts", TEXT, "", "what is doubtful of its solution"),
            ColumnDescription("cost_before", NUMBER, "", "at the start"),
            ColumnDescription("cost", NUMBER, "", "at the estimates"),
            ColumnDescription("rmse_train", NUMBER, "", "root mean square error over sigma"),
            ColumnDescription(
                "rmse_test", NUMBER, "", "of the held-out experiments; null without any"
            ),
            ColumnDescription("iterations", WHOLE, "", "of the search"),
            ColumnDescription("evaluations", WHOLE, "", "points that were asked for"),
            ColumnDescription("simulations", WHOLE, "", "of one experiment each"),
            ColumnDescription("failures", WHOLE, "", "simulations that failed"),
            ColumnDescription("seconds", NUMBER, "s", "what it took"),
            ColumnDescription("seed", WHOLE, "", "of the method"),
            ColumnDescription("started", TEXT, "", "date and time, UTC"),
        ),
    ),
)
