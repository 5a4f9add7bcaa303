import pytest

from cluster_est.cli.criterion import Criterion
from cluster_est.errors import ConfigError

DOCUMENT = {
    "status": "done",
    "verdict": "none",
    "cost": 2.5,
    "rmse_test": None,
    "too_narrow": True,
    "failures": 0,
    "effects": ["coulomb_v", "lag_u"],
    "doubts": [],
    "parameters": {
        "motor.R": {"value": 1.5, "unit": "Ohm"},
        "motor": {"value": 9.0},
        "x[2]": {"value": -3.0},
        "a b": {"value": 4.0},
    },
    "notes": ["one"],
}


@pytest.mark.parametrize(
    ("expression", "met"),
    [
        ("cost > 2", True),
        ("2 < cost <= 2.5", True),
        ("2 < cost < 2.5", False),
        ("cost == 2.5 and failures == 0", True),
        ("cost > 9 or failures > 0", False),
        ("not (cost > 9)", True),
        ("verdict != none", False),
        ('verdict == "none"', True),
        ("verdict in [found, partial]", False),
        ("verdict not in [none, 'none (coloured noise)']", False),
        ("too_narrow", True),
        ("too_narrow == true", True),
        ("doubts", False),
        ("'coulomb_v' in effects", True),
        ("'gap' in effects", False),
        ("effects[1] == 'lag_u'", True),
        ("parameters.motor.R.value > 1", True),
        ("parameters.motor.value > 8", True),
        ("parameters.x[2].value < -2.5", True),
        ("parameters['x[2]'].value > 0", False),
        ("parameters['a b'].value == 4", True),
        ("parameters.motor.R.unit == 'Ohm'", True),
        ("rmse_test == null", True),
        ("rmse_test != null and rmse_test > 1.5", False),
    ],
)
def test_an_expression_is_judged(expression, met):
    judged = Criterion(expression, "show").judge(DOCUMENT)
    assert (judged.met, judged.why) == (met, "")


@pytest.mark.parametrize("expression", ["rmse_test > 1.5", "cost > 9 or rmse_test < 1"])
def test_what_has_no_value_counts_as_met_and_says_so(expression):
    judged = Criterion(expression, "show").judge(DOCUMENT)
    assert judged.met
    assert "rmse_test has no value" in judged.sentence


@pytest.mark.parametrize(
    ("expression", "said"),
    [
        ("rmse_tst > 1", "did you mean 'rmse_test'?"),
        ("verdict == fund", "did you mean 'found'?"),
        ("verdict == whatever", "one of none, none (coloured noise), found"),
        ("", "not a valid expression"),
        ("cost >", "not a valid expression"),
        ("cost = 3", "not a valid expression"),
        ("cost is 3", "contains another comparison"),
        ("cost + 1 > 2", "'cost + 1'"),
        ("__import__('os').system('true')", "but contains"),
        ("max(cost, 1)", "'max(cost, 1)'"),
        ("cost ** 99999999 > 1", "cost ** 99999999"),
        ("[x for x in effects]", "but contains"),
        ("(lambda: 1)()", "but contains"),
        ("f'{cost}' == '1'", "but contains"),
        ("effects[0:1]", "but contains"),
        ("cost if failures else 1", "but contains"),
        ("(" * 500 + "cost" + ")" * 500, "must have at most"),
    ],
)
def test_anything_else_is_refused_before_there_is_a_document(expression, said):
    with pytest.raises(ConfigError) as refused:
        Criterion(expression, "show")
    assert said in str(refused.value)


@pytest.mark.parametrize(
    ("expression", "said"),
    [
        ("parameters.mtor.value > 1", "did you mean 'motor'?"),
        ("parameters.motor.R.vlue > 1", "did you mean 'value'?"),
        ("effects[7] == 'a'", "there is no entry [7], because the list has 2 entries"),
        ("effects.coulomb_v.k > 1", "there is no field 'coulomb_v', because the value is a list"),
        (
            "effects[0].family == 'a'",
            "has no fields",
        ),
        ("verdict > 1", "cannot be compared"),
        ("-verdict == 1", "not a number"),
    ],
)
def test_what_this_document_lacks_is_said(expression, said):
    with pytest.raises(ConfigError) as refused:
        Criterion(expression, "show").judge(DOCUMENT)
    assert said in str(refused.value)
