import os
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

from support.problems.springs import spring_problem

from cluster_est.run_folder.run_folder import RunFolder
from cluster_est.run_folder.run_identity import RunIdentity, RunKind
from cluster_est.studies.fit import fit

HOSTILE = '</script><img src=x onerror="alert(1)"><b>&amp;'


def fitted_run(folder: Path, **options) -> Path:
    """The run folder of a fit of two or more springs, the last of them held out."""
    problem = spring_problem(noise=0.01, **options).problem
    *others, last = problem.experiments
    problem = replace(problem, experiments=(*others, replace(last, role="test")))
    written = RunFolder(folder, RunIdentity(RunKind.FIT, problem, f"# {HOSTILE}\n", "hash", 0))
    result = fit(problem, record=written.record, progress=written.show, callback=written.note)
    written.write(result)
    return folder


def chromium() -> str | None:
    """Where a Chromium is, if there is one."""
    return os.environ.get("CLUSTER_EST_CHROMIUM") or shutil.which("chromium")


class Page(HTMLParser):
    """The elements and the texts of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[str] = []
        self.scripts: list[tuple[dict[str, str | None], str]] = []
        self.within: tuple[str, dict[str, str | None]] = ("", {})
        self.feed(path.read_text(encoding="utf-8"))

    @property
    def text(self) -> str:
        """All that is read on it."""
        return " ".join(" ".join(self.texts).split())

    def of(self, tag: str) -> list[dict[str, str | None]]:
        """The attributes of all elements of a kind."""
        return [attributes for name, attributes in self.elements if name == tag]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        self.within = (tag, dict(attrs))

    def handle_endtag(self, tag: str) -> None:
        self.within = ("", {})

    def handle_data(self, data: str) -> None:
        tag, attributes = self.within
        if tag == "script":
            self.scripts.append((attributes, data))
        elif tag != "style":
            self.texts.append(data)
