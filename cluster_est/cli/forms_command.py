"""The command forms: the library's forms of effects, from its own entries.

The documentation of the forms uses the same texts.
"""

from __future__ import annotations

import math
import re
from argparse import Namespace
from collections.abc import Mapping, Sequence
from typing import Any

from cluster_est.cli.answer import Answer
from cluster_est.cli.parent_process import ExitCode
from cluster_est.config.config_text import FILL_IN
from cluster_est.errors import ConfigError
from cluster_est.toml import dotted, inline
from workers.effects.forms import FORMS, PROCESS_NOISE
from workers.effects.kinds import EffectForm, FormCoefficient, SiteKind
from workers.fmu.description import nearest

SITES: dict[SiteKind, tuple[str, str]] = {
    "derivative": ("der(STATE)", "The equation is added to the derivative of a state. `v` is that "
                   "state unless `variables` names another argument."),
    "pair": ("pair STATE,STATE", "The first equation is added to the first derivative, the second "
             "equation to the other derivative. `v` is the difference of the two states unless "
             "`variables` names another argument."),
    "input": ("input NAME", "The equation replaces the input `s`. `v` is a state or another signal "
              "that `variables` names."),
    "output": ("output NAME", "The equation replaces the output `s`: it is the reading of the "
               "sensor."),
    "parameter": ("parameter NAME", "The equation replaces the parameter `s` at every time."),
}  # fmt: skip
"""Notation of a site of each kind, and the meaning of an equation there."""
SYMBOLS = (
    "In the equations, `v` and `w` are the variables on which an effect depends, `t` is the time, "
    "and `z` (also `z1`, `z2` ...), `y` and `e` are internal states. In the units, `site` is the "
    "unit of the result of the equation, and `other` is the unit of the second derivative. A "
    "strength has no influence at 0, unless another value is given. A coefficient that is held "
    "keeps its value when `close-loop` fits the effect; a coefficient that you declare is fitted "
    "unless it has `fixed = true`."
)
EVERY_FORM = FORMS | PROCESS_NOISE
FormKey = tuple[SiteKind, str]


def equations(kind: SiteKind, form: EffectForm) -> tuple[str, ...]:
    """Return the equations of a form at a site of a kind; for a free curve, a description."""
    if form.values:
        before = {"parameter": "s times 1 plus ", "derivative": "", "pair": ""}
        return (
            f"{before.get(kind, 's plus ')}a curve of {'v' if form.variables else 's'}: straight "
            f"lines between values at {form.values} equally spaced points from low to high; "
            "a value without a coefficient is 0",
        )
    if form.memory:
        return (f"{form.memory}(s, {form.coefficients[0].name})",)
    own = [f"{z.name}' = {z.derivative}, from {z.start}" for z in form.states]
    return tuple(part for part in (form.equation, form.reaction, *own) if part)


def coefficient_in_words(coefficient: FormCoefficient) -> str:
    """Return a coefficient with its unit and special properties."""
    said = [coefficient.name, f"in {coefficient.unit}" if coefficient.unit != "1" else ""]
    if coefficient.neutral:
        said.append(f"(no influence at {coefficient.neutral:g})")
    said += ["(held)"] if coefficient.held else []
    return " ".join(filter(None, said))


def config_block(kind: SiteKind, form: EffectForm) -> str:
    """Return an entry of `[[effects]]` in which names and sizes must be filled in."""
    arguments = inline([f"{FILL_IN}: v", f"{FILL_IN}: w"][: form.variables])
    own = form.variables == 1 and kind in ("derivative", "pair")
    lines = [
        "[[effects]]",
        f"name = {inline(form.name)}",
        f"site = {inline(f'{FILL_IN}: {SITES[kind][0]}')}",
        f"form = {inline(form.name)}",
        *([f"variables = {arguments}"] if form.variables and not own else []),
        *([f"# variables = {arguments}  # if it depends on another argument"] if own else []),
        "[effects.parameters]",
    ]
    for each in form.coefficients:
        section = inline(_section(each))
        lines.append(f"{dotted(each.name)} = {section}  # {_comment(each)}")
    return "\n".join(lines)


def _section(coefficient: FormCoefficient) -> dict[str, Any]:
    neutral = coefficient.neutral
    has_size = coefficient.scale is not None  # a search that starts at 0 may stay there
    if neutral is not None and math.isfinite(neutral) and not (has_size and neutral == 0.0):
        return {"start": neutral}
    said: dict[str, Any] = {"start": f"{FILL_IN}: {_tried(coefficient)}"}
    return said | {"fixed": True} if coefficient.held else said


def _tried(coefficient: FormCoefficient) -> str:
    """Return the start of a coefficient in the closed loop, in words."""
    if coefficient.scale is None or not coefficient.grid:
        return "a number"
    values = ", ".join(f"{each:g}" for each in coefficient.grid[:3])
    scale = (
        ""
        if coefficient.scale.name in ("EXPONENT", "NUMBER", "DAMPING")
        else f" x {coefficient.scale.value}"
    )
    return f"such as {values}{scale}"


def _comment(coefficient: FormCoefficient) -> str:
    unit = "without a unit" if coefficient.unit == "1" else f"in {coefficient.unit}"
    still = f"; no influence at {coefficient.neutral:g}" if coefficient.neutral is not None else ""
    sign = "; positive" if coefficient.positive and not coefficient.if_own else ""
    return f"{unit}{still}{sign}"


def forms(options: Namespace, answer: Answer) -> int:
    """List the forms, or describe one with a block for a config."""
    here = {key: form for key, form in EVERY_FORM.items() if options.site in (None, key[0])}
    chosen = {key: form for key, form in here.items() if options.form in (None, key[1])}
    listed = options.form is None
    if not chosen:
        chosen, listed = _about(options.form, here), True
        if not chosen:
            known = dict.fromkeys(w for (_, name), f in here.items() for w in (name, f.family))
            where = f" at sites of the kind {options.site}" if options.site else ""
            raise ConfigError(
                f"forms: {options.form!r} must be a form{where}, or a word of its description, but "
                f"is not{nearest(str(options.form), known)}"
            )
        answer.say(f"no form is called {options.form!r}; its family or description contains it:")
    answer.add(forms=[_entry(kind, form) for (kind, _), form in chosen.items()])
    for kind, (site, meaning) in SITES.items():
        forms_here = [form for (at, _), form in chosen.items() if at == kind]
        if not forms_here:
            continue
        answer.say("")
        answer.tell(f"{site}: {meaning.replace('`', '')}")
        if listed:
            _list(answer, kind, forms_here)
        for form in () if listed else forms_here:
            _describe(answer, kind, form)
    answer.say("")
    answer.tell(SYMBOLS.replace("`", ""))
    if listed:
        answer.say("to describe one form, with a block for a config: cluster-est forms FORM")
    return ExitCode.DONE


def _about(word: str, forms: Mapping[FormKey, EffectForm]) -> dict[FormKey, EffectForm]:
    """Return the forms with a word in their name, family or description."""
    word = word.lower()
    return {
        key: form
        for key, form in forms.items()
        if word in f"{form.name} {form.family} {_law(form)}".lower()
    }


def _list(answer: Answer, kind: SiteKind, forms: Sequence[EffectForm]) -> None:
    answer.table(
        ["form", "family", "equation", "coefficients"],
        [
            (
                form.name,
                form.family,
                "; ".join(equations(kind, form)),
                "; ".join(map(coefficient_in_words, form.coefficients)),
            )
            for form in forms
        ],
        fitted=True,
    )


def _describe(answer: Answer, kind: SiteKind, form: EffectForm) -> None:
    answer.say(f"{form.name} ({form.family}): {_law(form)}")
    for equation in equations(kind, form):
        answer.say(f"  {equation}")
    for each in form.coefficients:
        answer.say(f"  {coefficient_in_words(each)}")
    answer.say("")
    answer.say(config_block(kind, form))


def _law(form: EffectForm) -> str:
    return re.sub(r"\{(\w)\}", r"\1", form.law.value)


def _entry(kind: SiteKind, form: EffectForm) -> dict[str, Any]:
    """Return a form for the document."""
    return {
        "form": form.name,
        "family": form.family,
        "site": SITES[kind][0],
        "site_kind": kind,
        "law": _law(form),
        "equations": list(equations(kind, form)),
        "variables": form.variables,
        "coefficients": [
            {
                "name": each.name,
                "unit": each.unit,
                "neutral": each.neutral,
                "positive": each.positive and not each.if_own,
                "held": each.held,
            }
            for each in form.coefficients
        ],
        "config": config_block(kind, form),
    }
