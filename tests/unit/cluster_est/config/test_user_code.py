"""Functions of the user's: found beside the config or installed, and only where they may run."""

import re
import sys

import pytest
from support.spoiled import write_input

from cluster_est import ClusterEstError, read_problem
from workers.residuals.functions import load

SOURCE = "import math\n\ndef cost(run):\n    return math.pi\n"
TYPED = """from __future__ import annotations
from dataclasses import dataclass, field
@dataclass
class Weights:
    values: list[float] = field(default_factory=lambda: [2.0])
def cost(run) -> float:
    return Weights().values[0]
"""


@pytest.fixture
def function(tmp_path):
    """The cost function of a config, beside which there is a file mine.py."""

    def call(text, source=SOURCE, allow=True):
        content = source.encode() if isinstance(source, str) else source
        (tmp_path / "mine.py").write_bytes(content)
        path = write_input(tmp_path, {"cost.function": text})
        found = read_problem(path, allow_code=allow).experiments[0].cost_function
        assert found is not None
        return found

    return call


def refused(function, *given, pattern, **how):
    with pytest.raises(ClusterEstError) as error:
        function(*given, **how)
    said = str(error.value)
    assert "\n" not in said
    assert re.search(pattern, said), said


@pytest.mark.parametrize(("source", "value"), [(SOURCE, 3.14159265), (TYPED, 2.0)])
def test_a_file_beside_the_config_travels_as_text(function, source, value):
    found = function("mine:cost", source)
    assert (found.module, found.name, found.source) == ("mine", "cost", source)
    assert load(found)(None) == pytest.approx(value)
    assert "mine" not in sys.modules  # nor is it importable by anybody else


def test_an_installed_module_travels_by_name(function):
    found = function("math:fsum")
    assert (found.module, found.source, found.equality) == ("math", "", False)
    assert load(found)([1.0, 2.0]) == 3.0
    assert function("os.path:join").module == "os.path"


def test_a_file_of_the_users_wins_over_an_installed_module(tmp_path, function):
    (tmp_path / "colorsys.py").write_text(SOURCE)
    assert load(function("colorsys:cost"))(None) == pytest.approx(3.14159265)
    import colorsys

    assert hasattr(colorsys, "rgb_to_hls")  # for everybody else it is what it was


def test_two_configs_may_have_files_of_one_name(function):
    sources = [f"def cost(run):\n    return {number}\n" for number in (1, 2)]
    found = [function("mine:cost", source) for source in sources]
    assert [load(each)(None) for each in found] == [1, 2]


@pytest.mark.parametrize("text", ["mine:cost", "math:fsum", "no_such_module:cost"])
def test_nothing_runs_where_code_is_not_allowed(tmp_path, function, text):
    source = f"open({str(tmp_path / 'ran')!r}, 'w').close()\n{SOURCE}"
    pattern = f"cost.function: '{text}' names Python code.*if you trust.*add --allow-code"
    refused(function, text, source, pattern=pattern, allow=False)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    "text",
    ["mine", "mine:", ":cost", "mine.cost", "mine:cost.more", "mine:cost()", "a b:c", "1:2",
     "../mine:cost", "mine:cost ", "mine:cost\n", "/etc/x:y", "mine::cost", "mine:a:b"],
)  # fmt: skip
def test_it_is_written_as_module_and_name(function, text):
    refused(function, text, pattern='must be "module:name", but is')


@pytest.mark.parametrize(
    ("text", "source", "pattern"),
    [
        ("mine:cost", "def cost(run:\n", "mine:cost: .*SyntaxError"),
        ("mine:cost", "raise RuntimeError('no licence')\n", "mine:cost: .*RuntimeError: no lic"),
        ("mine:cost", "import sys\nsys.exit(0)\n", "mine:cost: .*SystemExit"),
        ("mine:cost", "import no_such_module\n", "mine:cost: .*No module named 'no_such_module'"),
        ("mine:cost", "def other(run):\n    return 1\n", "mine:cost: .*AttributeError.*cost"),
        ("mine:cost", "cost = 3.0\n", "mine:cost: must be a function, but is a float"),
        ("mine:cost", b"\xff\xfe\x00", "cost.function: .*mine.py cannot be read.*correct the path"),
        ("no_such_module:cost", "", "no_such_module:cost: must be a function that can"),
        ("math:no_such", "", "math:no_such: must be a function that can"),
        ("os.no_such:cost", "", "os.no_such:cost: must be a function that can"),
    ],
)
def test_what_cannot_be_used_is_refused_at_once(function, text, source, pattern):
    refused(function, text, source, pattern=pattern)
