"""Functions of the user's: found beside the config or installed, and only where they may run."""

from __future__ import annotations

import sys

import pytest

from cluster_est.config.user_code import UserCode
from cluster_est.errors import ClusterEstError, ConfigError, ModelError
from workers.residuals.functions import load

SOURCE = "import math\n\ndef cost(run):\n    return math.pi\n"


def refused(code: UserCode, text: str, kind: type[ClusterEstError], *phrases: str) -> None:
    with pytest.raises(kind) as error:
        code.function(text, "cost.function")
    said = str(error.value)
    assert "\n" not in said
    for phrase in phrases:
        assert phrase in said


def test_a_file_beside_the_config_travels_as_text(tmp_path):
    (tmp_path / "mine.py").write_text(SOURCE)
    found = UserCode(tmp_path, allowed=True).function("mine:cost", "cost.function", equality=True)
    assert (found.module, found.name, found.source, found.equality) == (
        "mine", "cost", SOURCE, True
    )  # fmt: skip
    assert load(found)(None) == pytest.approx(3.14159265)


def test_an_installed_module_travels_by_name(tmp_path):
    found = UserCode(tmp_path, allowed=True).function("math:fsum", "cost.function")
    assert (found.module, found.source, found.equality) == ("math", "", False)
    assert load(found)([1.0, 2.0]) == 3.0
    dotted = UserCode(tmp_path, allowed=True).function("os.path:join", "cost.function")
    assert dotted.module == "os.path"


def test_a_file_of_the_users_wins_over_an_installed_module(tmp_path):
    (tmp_path / "colorsys.py").write_text(SOURCE)
    found = UserCode(tmp_path, allowed=True).function("colorsys:cost", "cost.function")
    assert load(found)(None) == pytest.approx(3.14159265)
    import colorsys

    assert hasattr(colorsys, "rgb_to_hls")  # for everybody else it is what it was


def test_two_configs_may_have_files_of_one_name(tmp_path):
    answers = []
    for number in (1, 2):
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / "same_name_twice.py").write_text(f"def cost(run):\n    return {number}\n")
        found = UserCode(folder, allowed=True).function("same_name_twice:cost", "cost.function")
        answers.append(load(found)(None))
    assert answers == [1, 2]


def test_a_file_with_dataclasses_and_notes_on_types(tmp_path):
    (tmp_path / "typed.py").write_text(
        "from __future__ import annotations\n"
        "from dataclasses import dataclass, field\n"
        "@dataclass\n"
        "class Weights:\n"
        "    values: list[float] = field(default_factory=lambda: [2.0])\n"
        "def cost(run) -> float:\n"
        "    return Weights().values[0]\n"
    )
    found = UserCode(tmp_path, allowed=True).function("typed:cost", "cost.function")
    assert load(found)(None) == 2.0


def test_nothing_runs_where_code_is_not_allowed(tmp_path):
    ran = tmp_path / "ran"
    (tmp_path / "mine.py").write_text(f"open({str(ran)!r}, 'w').close()\n" + SOURCE)
    for text in ("mine:cost", "math:fsum", "no_such_module:cost"):
        refused(
            UserCode(tmp_path, allowed=False), text, ConfigError,
            f"cost.function: {text!r} is Python code", "if you trust", "add --allow-code",
        )  # fmt: skip
    assert not ran.exists()


@pytest.mark.parametrize(
    "text",
    ["", "mine", "mine:", ":cost", "mine.cost", "mine:cost.more", "mine:cost()", "a b:c", "1:2",
     "../mine:cost", "mine:cost ", "mine:cost\n", "/etc/x:y", "mine::cost", "mine:a:b"],
)  # fmt: skip
def test_it_is_written_as_module_and_name(tmp_path, text):
    (tmp_path / "mine.py").write_text(SOURCE)
    refused(UserCode(tmp_path, allowed=True), text, ConfigError, 'must be "module:name" but is')


@pytest.mark.parametrize(
    ("source", "phrases"),
    [
        ("def cost(run:\n", ["SyntaxError"]),
        ("raise RuntimeError('no licence')\n", ["RuntimeError: no licence"]),
        ("import sys\nsys.exit(0)\n", ["SystemExit"]),
        ("import no_such_module\n", ["No module named 'no_such_module'"]),
        ("def other(run):\n    return 1\n", ["AttributeError", "cost"]),
        ("cost = 3.0\n", ["must be a function but is a float"]),
    ],
)
def test_a_file_that_cannot_be_used_is_refused_at_once(tmp_path, source, phrases):
    (tmp_path / "broken.py").write_text(source)
    refused(
        UserCode(tmp_path, allowed=True), "broken:cost", ModelError, "broken:cost: must", *phrases
    )


@pytest.mark.parametrize("text", ["no_such_module:cost", "math:no_such", "os.no_such:cost"])
def test_what_is_not_installed_is_refused(tmp_path, text):
    refused(
        UserCode(tmp_path, allowed=True), text, ModelError, f"{text}: must be a function that can"
    )


def test_a_file_that_is_no_text_is_refused(tmp_path):
    (tmp_path / "mine.py").write_bytes(b"\xff\xfe\x00")
    refused(UserCode(tmp_path, allowed=True), "mine:cost", ConfigError, "cannot be read", "mend it")


def test_no_file_of_the_users_becomes_importable(tmp_path):
    (tmp_path / "mine.py").write_text(SOURCE)
    UserCode(tmp_path, allowed=True).function("mine:cost", "cost.function")
    assert "mine" not in sys.modules
