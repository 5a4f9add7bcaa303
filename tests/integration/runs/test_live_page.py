import http.client
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path
from urllib.parse import urlencode, urlsplit

import numpy as np
import pyarrow.parquet as pq
import pytest
from support.problems.springs import spring_problem
from support.reported import chromium, fitted_run
from support.run_folders import change_facts

from cluster_est.cli import main
from cluster_est.methods.method import Progress
from cluster_est.run_folder.run_folder import RunFolder
from cluster_est.run_folder.run_identity import RunIdentity, RunKind
from cluster_est.run_folder.run_progress import ProgressFile, ProgressTail
from cluster_est.running.resources import BestPoint, RunSnapshot, SearchIteration, TaskOrigin
from cluster_est.watching.server import LivePage
from workers.messages import Outcome, Status, Task

SPRING = "configs/mass_spring_damper.toml"


@pytest.fixture
def begun(tmp_path):
    """The folder of a run that goes on."""
    problem = spring_problem(experiments=2, noise=0.01).problem
    folder = RunFolder(tmp_path / "run", RunIdentity(RunKind.FIT, problem, "", "hash", 0))
    yield folder
    folder.abandon("the test is over", "interrupted")


@pytest.fixture(scope="module")
def ended(tmp_path_factory) -> Path:
    return fitted_run(tmp_path_factory.mktemp("fit") / "run", experiments=3)


@pytest.fixture(scope="module")
def configured(tmp_path_factory) -> Path:
    """A run of a config that has ended."""
    out = tmp_path_factory.mktemp("configured") / "run"
    assert main(["fit", SPRING, "--out", str(out)]) == 0
    return out


class Visitor:
    """Asks a page, as its own script does unless told otherwise."""

    def __init__(self, page: LivePage) -> None:
        address = urlsplit(page.address)
        self.place, self.token = address.netloc, address.query.partition("=")[2]

    def ask(self, path, method="GET", headers=(), token=None, **query):
        given = {"token": self.token if token is None else token, **query}
        connection = http.client.HTTPConnection(self.place, timeout=60)
        sent = {"Host": self.place, **dict(headers)}
        connection.request(method, f"{path}?{urlencode(given)}", headers=sent)
        answer = connection.getresponse()
        content = answer.read()
        connection.close()
        return answer, content

    def state(self, path="/state", **query):
        answer, content = self.ask(path, **query)
        assert answer.status == 200, content
        return json.loads(content)


def test_who_has_the_address_sees_the_page(begun):
    with LivePage(begun.path) as page:
        answer, content = Visitor(page).ask("/")
        assert answer.status == 200
        assert b"Stop the run" in content
        assert answer.headers["Content-Type"] == "text/html; charset=utf-8"
        policy = answer.headers["Content-Security-Policy"]
        assert policy.startswith("default-src 'none'; script-src 'sha256-")
        assert "http" not in policy
        for name, value in {
            "Cache-Control": "no-store",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
        }.items():
            assert answer.headers[name] == value
        assert Visitor(page).ask("/other")[0].status == 404


WRONG = {
    "no token": {"token": ""},
    "another token": {"token": "x" * 43},
    "a token that is no ASCII": {"token": "\u00fc"},
    "another host": {"headers": {"Host": "evil.example"}},
    "another port": {"headers": {"Host": "127.0.0.1:1"}},
    "a page of another origin": {"headers": {"Origin": "http://evil.example"}},
    "a page without an origin": {"headers": {"Origin": "null"}},
}


@pytest.mark.parametrize("wrong", WRONG)
def test_everybody_else_is_refused(begun, wrong):
    asked = [("GET", "/"), ("GET", "/state"), ("GET", "/curves"), ("GET", "/x"), ("POST", "/stop")]
    with LivePage(begun.path) as page:
        for method, path in asked:
            answer, content = Visitor(page).ask(path, method, **WRONG[wrong])
            assert answer.status == 403, path
            assert b"the address that the command printed" in content
    assert not (begun.path / "stop").exists()


def test_its_own_origin_and_the_name_of_this_machine_are_allowed(begun):
    with LivePage(begun.path) as page:
        visitor = Visitor(page)
        host = f"localhost:{page.port}"
        own = {"Host": host, "Origin": f"http://{host}"}
        assert visitor.ask("/state", headers=own)[0].status == 200


def test_it_listens_at_this_machine_alone_and_says_nothing_of_requests(begun, capfd):
    with LivePage(begun.path) as page:
        assert page.host == "127.0.0.1"
        with pytest.raises(OSError, match=r"refused|address|timed out"):
            socket.create_connection(("127.0.0.2", page.port), timeout=10)
        Visitor(page).state()
    assert capfd.readouterr() == ("", "")


def test_two_pages_have_two_tokens_and_a_closed_one_answers_nobody(begun):
    with LivePage(begun.path) as page, LivePage(begun.path) as other:
        assert Visitor(page).token != Visitor(other).token
        assert len(Visitor(page).token) >= 43
    with pytest.raises(ConnectionRefusedError):
        Visitor(page).ask("/")


def test_a_stop_writes_the_file_by_which_a_run_ends(begun):
    with LivePage(begun.path) as page:
        visitor = Visitor(page)
        assert visitor.ask("/stop")[0].status == 404
        assert not (begun.path / "stop").exists()
        assert visitor.ask("/stop", "POST")[0].status == 200
        assert (begun.path / "stop").is_file()


def test_a_run_that_has_ended_is_not_stopped(ended):
    with LivePage(ended) as page:
        answer, content = Visitor(page).ask("/stop", "POST")
    assert answer.status == 409
    assert b"only a run in progress can be stopped, but this run is done" in content
    assert not (ended / "stop").exists()


def log(folder, numbers):
    for number in numbers:
        origin = TaskOrigin(Task(number, 0, np.zeros(4)), "train", number, "point")
        status = Status.TIMEOUT if number % 3 == 0 else Status.OK
        folder.record(origin, Outcome(number, status, None, None, "too long", 0.1, "w0"))


def test_its_figures_move_while_the_run_goes_on(begun, monkeypatch):
    monkeypatch.setattr("cluster_est.watching.page_sources.SECONDS_BETWEEN_LOOKS", 0.0)
    with LivePage(begun.path) as page:
        visitor = Visitor(page)
        first = visitor.state()
        assert (first["status"], first["simulations"], first["parameters"]) == ("running", 0, [])
        log(begun, range(9))
        for number, cost in enumerate((5.0, 7.0, 3.0)):
            best = BestPoint(min(5.0, cost), 0.0, {"k": cost, "m": float("nan")})
            begun.note(SearchIteration("train", Progress(number, cost), 3 * number, best))
        begun.show(RunSnapshot("train", Progress(2, 3.0), 6, 9, 3, 2, 4, 12.0, waiting=7))
        while (later := visitor.state())["simulations"] < 9:
            pass
        assert (later["failed"], later["cost"]) == (3, 3.0)
        assert (later["busy"], later["workers"], later["waiting"]) == (2, 4, 7)
        assert later["doing"] == "searching"
        assert later["costs"]["lines"] == [
            {"name": "train", "points": [[0, 5.0], [3, 7.0], [6, 3.0]]}
        ]
        k, m = later["parameters"]
        assert (k["label"], k["value"], k["line"]) == ("k", 3.0, [[0, 5.0], [1, 5.0], [2, 3.0]])
        assert m["value"] is None
        assert later["failures"][0] == {
            "count": 3, "status": "timeout", "message": "too long", "first": 0,
            "command": f"cluster-est replay {begun.path} 0",
        }  # fmt: skip
        assert [each["worker"] for each in later["busy_shares"]] == ["w0"]


def test_costs_of_other_models_and_of_refits_are_no_best_cost(begun):
    for search in ("bootstrap 3", "candidate"):
        best = BestPoint(0.1, 0.0, {"k": 1.0})
        begun.note(SearchIteration(search, Progress(0, 0.1), 3, best))
    begun.note(SearchIteration("start 1", Progress(0, 4.0), 3, BestPoint(4.0, 0.0, {"k": 2.0})))
    begun.note(SearchIteration("start 0", Progress(0, 2.0), 3, BestPoint(2.0, 0.5, {"k": 3.0})))
    with LivePage(begun.path) as page:
        state = Visitor(page).state()
    assert state["cost"] == 4.0  # the other start keeps no constraint
    assert [line["name"] for line in state["costs"]["lines"]] == ["start 0", "start 1"]


def test_a_closed_loop_shows_the_first_fit_of_its_declared_model(begun):
    """Later searches of that name fit parts of the records, so their costs are lower."""
    with LivePage(begun.path) as page:
        for number, (cost, k, ending) in enumerate(
            [(5.0, 1.0, ""), (2.0, 3.0, "converged"), (0.1, 9.0, ""), (0.05, 8.0, "converged")]
        ):
            best = BestPoint(cost, 0.0, {"k": k})
            begun.note(SearchIteration("base", Progress(number % 2, cost, ending=ending), 3, best))
        begun.note(SearchIteration("trial", Progress(0, 0.01), 3, BestPoint(0.01, 0.0, {"k": 7.0})))
        state = Visitor(page).state()
    assert (state["cost"], state["cost_of"]) == (2.0, "declared model")
    (k,) = state["parameters"]
    assert (k["label"], k["value"], k["line"]) == ("k", 3.0, [])
    assert (k["unit"], k["description"]) == ("N/m", "stiffness of the spring")


def test_curves_of_the_declared_model_are_shown_before_the_first_effect(configured, on_its_way):
    (on_its_way / "progress.jsonl").unlink()
    file = ProgressFile(on_its_way / "progress.jsonl")
    tail = ProgressTail(configured / "progress.jsonl")
    for line in tail.new():
        if line.search == "train" and line.best is not None:
            step = Progress(line.iteration, line.cost, ending=line.ending)
            file.iteration(SearchIteration("base", step, line.evaluations, line.best))
    with LivePage(on_its_way) as page:
        found = Visitor(page).state("/curves", experiment="exp2")
    assert found["said"].endswith("with the declared model, as it was fitted first.")
    (curve,) = found["outputs"]
    assert (curve["unit"], curve["description"]) == ("m", "measured displacement")
    table = pq.read_table(configured / "residuals.parquet").to_pandas()
    own = table[table.experiment == "exp2"].set_index("time")
    np.testing.assert_allclose(
        curve["after"], own.simulated[curve["fine"]], atol=1e-3 * own.measured.abs().max()
    )


@pytest.mark.parametrize("folder", ["configured", "on_its_way"])
def test_parameters_and_outputs_have_their_units_and_descriptions(folder, request):
    with LivePage(request.getfixturevalue(folder)) as page:
        rows = {row["label"]: row for row in Visitor(page).state()["parameters"]}
        (curve,) = Visitor(page).state("/curves")["outputs"]
    assert (rows["c"]["unit"], rows["c"]["description"]) == ("N.s/m", "viscous damping")
    assert (rows["x0[exp5]"]["unit"], curve["unit"]) == ("m", "m")


def test_the_best_point_in_the_folder_is_that_of_the_fit(configured):
    with LivePage(configured) as page:
        state = Visitor(page).state()
    facts = json.loads((configured / "run.json").read_text())
    assert state["cost"] == facts["cost"]
    rows = pq.read_table(configured / "parameters.parquet").to_pylist()
    for row, told in zip(rows, state["parameters"], strict=True):
        assert (told["label"], told["value"]) == (row["label"], row["value"])
        assert told["line"][-1][1] == pytest.approx(row["value"], rel=1e-3)


@pytest.fixture
def on_its_way(configured, tmp_path) -> Path:
    """The same run before it has written what it has found."""
    copy = Path(shutil.copytree(configured, tmp_path / "run"))
    for table in copy.glob("*.parquet"):
        table.unlink()
    change_facts(copy, status="running", cost=None, verdict=None)
    return copy


def test_curves_of_the_best_point_are_simulated_once_more(configured, on_its_way):
    with LivePage(on_its_way) as page:
        visitor = Visitor(page)
        found = visitor.state("/curves", experiment="exp2")
        assert (found["experiment"], len(found["experiments"])) == ("exp2", 5)
        assert "Simulated for this page" in found["said"]
        (curve,) = found["outputs"]
        assert visitor.state("/curves", experiment="none")["experiment"] == "exp1"
        starts = {row["label"]: row["start"] for row in visitor.state()["parameters"]}
    table = pq.read_table(configured / "residuals.parquet").to_pandas()
    own = table[table.experiment == "exp2"].set_index("time")
    size = own.measured.abs().max()
    np.testing.assert_allclose(curve["measured"], own.measured[curve["time"]], atol=1e-12 * size)
    np.testing.assert_allclose(curve["after"], own.simulated[curve["fine"]], atol=1e-3 * size)
    assert starts["k"] == 25.0


def test_the_folder_has_the_curves_of_a_run_that_has_ended(configured):
    with LivePage(configured) as page:
        found = Visitor(page).state("/curves", experiment="exp5")
    assert (found["experiment"], len(found["experiments"])) == ("exp5", 5)
    (curve,) = found["outputs"]
    assert len(curve["fine"]) == len(curve["after"]) == len(curve["before"]) > 100


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {"config_folder": "/nowhere"},
            "its config was in /nowhere, which does not exist on this machine",
        ),
        ({"config_folder": None}, "does not record the folder"),
    ],
)
def test_why_there_are_no_curves_is_said(on_its_way, change, said):
    change_facts(on_its_way, **change)
    with LivePage(on_its_way) as page:
        found = Visitor(page).state("/curves")
    assert said in found["said"]
    assert found["outputs"] == []


def test_simulations_that_take_long_are_not_repeated(on_its_way, monkeypatch):
    monkeypatch.setattr("cluster_est.watching.best_curves.MOST_SECONDS_TO_REPEAT", 0.0)
    with LivePage(on_its_way) as page:
        assert "too long for a repetition here" in Visitor(page).state("/curves")["said"]


def test_runs_of_a_folder_stand_side_by_side(ended, configured, tmp_path):
    shutil.copytree(ended, tmp_path / "a")
    shutil.copytree(configured, tmp_path / "b")
    change_facts(tmp_path / "b", status="running")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "run.json").write_text("{")
    (tmp_path / "no run").mkdir()
    with LivePage(tmp_path) as page:
        visitor = Visitor(page)
        a, b, broken = visitor.state()["runs"]
        assert (a["name"], a["status"], a["goes_on"]) == ("a", "done", False)
        assert (b["name"], b["status"], b["goes_on"]) == ("b", "running", True)
        assert broken["status"] == "unreadable"
        assert "is damaged" in broken["message"]
        assert a["simulations"] > 0
        assert b["age"] > 0.0
        assert set(b["values"]) == {"m", "k", "c", "x0[exp5]"}
        costs = [cost for _, cost in b["line"]]
        assert costs == sorted(costs, reverse=True)
        assert visitor.state(run="a")["name"] == "a"
        for name in ("..", "../a", "no run", "/etc"):
            answer, content = visitor.ask("/state", run=name)
            assert answer.status == 409
            assert b"has no run" in content


def test_a_run_that_has_not_begun_is_waited_for(tmp_path):
    with LivePage(tmp_path / "run") as page:
        assert Visitor(page).state()["status"] == "starting"
        assert Visitor(page).state("/curves")["outputs"] == []
        page.last_look(0.0)


def test_fit_does_what_it_does_and_says_where_its_page_is(tmp_path, capsys):
    out = tmp_path / "run"
    assert main(["fit", SPRING, "--out", str(out), "--browser", "--no-report"]) == 0
    said = capsys.readouterr()
    assert re.search(
        r"the page of the run is at http://127\.0\.0\.1:\d+/\?token=\S{43}\n", said.err
    )
    assert "token" not in said.out
    assert "token" not in (out / "run.json").read_text()


def test_watch_serves_the_page_until_ctrl_c(ended, capsys, monkeypatch):
    monkeypatch.setattr("time.sleep", lambda _: os.kill(os.getpid(), signal.SIGINT))
    assert threading.current_thread() is threading.main_thread()
    assert main(["watch", str(ended), "--browser"]) == 0
    said = capsys.readouterr()
    assert "http://127.0.0.1:" in said.err
    assert "the page was closed" in said.out


def test_watch_refuses_what_it_cannot_show(ended, tmp_path, capsys):
    assert main(["watch", str(tmp_path), "--browser"]) == 2
    assert "neither this folder nor a folder in it has a run.json" in capsys.readouterr().err
    assert main(["watch", str(ended), "--browser", "--json"]) == 2
    assert "must be used without --json" in capsys.readouterr().err
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert main(["watch", str(ended), "--browser", "--port", port]) == 2
    assert f"--port: {port} cannot be used" in capsys.readouterr().err


ENDLESS = ["method.name=pso", "method.options.max_generations=100000", "method.options.ftol=0.0"]


@pytest.fixture
def endless(tmp_path):
    """A fit that goes on until it is stopped, with its page; its process and the address."""
    command = [sys.executable, "-m", "cluster_est", "fit", SPRING, "--browser", *ENDLESS]
    with subprocess.Popen(
        [*command, "--out", str(tmp_path / "run")], stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        found = next(filter(None, (re.search(r"http\S+", line) for line in process.stderr)))
        yield process, found[0]
        process.kill()


@pytest.fixture
def browser():
    path = chromium()
    if path is None:
        pytest.skip("needs a Chromium, or its path in CLUSTER_EST_CHROMIUM")
    playwright = pytest.importorskip("playwright.sync_api")
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run"]
    with playwright.sync_playwright() as started:
        opened = started.chromium.launch(executable_path=path, args=flags)
        yield opened
        opened.close()


@pytest.fixture
def visit(browser):
    """Opens an address; no script of a page may fail, and none may ask anybody else."""
    said: list[str] = []
    asked: list[str] = []

    def opened(address, **options):
        page = browser.new_page(**options)
        page.set_default_timeout(60_000)
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda request: asked.append(urlsplit(request.url).hostname))
        page.on("dialog", lambda dialog: dialog.accept())
        page.goto(address)
        return page

    yield opened
    assert said == []
    assert set(asked) <= {"127.0.0.1", None}  # an icon is within the page


def seen(page, selector, text):
    """Wait until an element says something."""
    page.wait_for_function(
        "([selector, text]) => document.querySelector(selector)?.textContent.includes(text)",
        arg=[selector, text],
    )


def test_costs_of_different_models_or_data_have_no_best(ended, configured, tmp_path):
    for name, source in (("a", ended), ("b", configured), ("c", configured)):
        shutil.copytree(source, tmp_path / name)
    progress = tmp_path / "c" / "progress.jsonl"
    lines = progress.read_text()
    assert '"train"' in lines
    progress.write_text(lines.replace('"train"', '"candidate"'))  # as the searches of a closed loop
    with LivePage(tmp_path) as page:
        a, b, c = Visitor(page).state()["runs"]
    assert a["data"] != b["data"] == c["data"]
    assert b["line"]
    assert not c["line"]


@pytest.mark.slow
def test_in_a_browser_figures_move_and_the_button_stops_the_run(endless, tmp_path, visit):
    process, address = endless
    page = visit(address, viewport={"width": 390, "height": 844})
    for section in ("cost", "curves"):
        page.wait_for_selector(f"#{section} svg polyline")
    before = page.locator("[data-figure=Simulations]").text_content()
    page.wait_for_function(
        "before => document.querySelector('[data-figure=Simulations]').textContent !== before",
        arg=before,
    )
    assert page.locator("#parameters tbody tr").count() == 4
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.locator("#stop").click()
    seen(page, "#status", "interrupted")
    assert page.locator("#stop").is_hidden()
    assert process.wait(60) == 130
    assert json.loads((tmp_path / "run" / "run.json").read_text())["status"] == "interrupted"


@pytest.mark.slow
def test_in_a_browser_runs_are_sorted_and_lead_to_their_pages(ended, configured, tmp_path, visit):
    for name, source in (("a", ended), ("b", configured), ("c", configured)):
        shutil.copytree(source, tmp_path / name)
    change_facts(tmp_path / "c", cost=1e9, status="not converged")
    with LivePage(tmp_path) as served:
        page = visit(served.address, viewport={"width": 1440, "height": 900}, color_scheme="dark")
        page.wait_for_selector("#runs tbody tr")
        assert page.locator("#runs td a").all_text_contents() == ["a", "b", "c"]
        assert page.locator("#cost svg polyline").count() == 3
        for _ in range(2):
            page.locator("#runs .sort", has_text="cost").click()
        assert page.locator("#runs td a").first.text_content() == "c"
        assert page.evaluate("document.documentElement.scrollWidth") <= 1440
        page.locator("#runs td a", has_text="b").click()
        seen(page, "#status", "done")
        page.wait_for_selector("#curves polyline.before")
        page.locator("#curves select").select_option("exp5")
        seen(page, "#curves .controls", "At the estimates")
        page.locator("#all").click()
        page.wait_for_selector("#runs tbody tr")
        page.goto(served.address.partition("?")[0])
        assert "with the address that the command printed" in page.content()
