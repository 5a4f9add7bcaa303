"""The page that `cluster-est check` prints."""

from __future__ import annotations

from rich.console import Console

from cluster_est.cli.display.run import say
from cluster_est.preflight import CheckPage


def print_page(console: Console, page: CheckPage) -> None:
    """A line for each check, and below it what can be done."""
    if not page.findings:
        return
    say(console, "")
    verdicts = max(len(each.verdict) for each in page.findings)
    names = max(len(each.check) for each in page.findings)
    for each in page.findings:
        say(console, f"{each.verdict:{verdicts}}  {each.check:{names}}  {each.found}")
        if each.do:
            say(console, f"{'':{verdicts}}  {'':{names}}  -> {each.do}")
    say(console, "")
    problems = sum(each.verdict == "problem" for each in page.findings)
    left = sum(each.verdict == "not done" for each in page.findings)
    notes = sum(each.verdict == "note" for each in page.findings)
    said = _counted(problems, "problem") if problems else "no problem was found"
    if notes:
        say_what = "says" if notes == 1 else "say"
        said += f"; {_counted(notes, 'note')} {say_what} what may be wrong"
    if 0 < left < len(page.findings):
        are = "was" if left == 1 else "were"
        said = f"{left} of {len(page.findings)} checks {are} not done; in the others {said}"
    elif left:
        said = "nothing was checked yet"
    say(console, said)


def _counted(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"
