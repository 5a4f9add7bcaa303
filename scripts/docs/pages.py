"""The pages of the reference as Markdown, from the code: keys, forms, commands, Python.

It is a hook of mkdocs: the pages are made at the time of the build. In the repository a page of the
same name says so, so that links lead somewhere there too.
"""

from __future__ import annotations

import argparse
import re
import types
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

import cluster_est as ce
from cluster_est.cli.document import COMMON_FIELDS, FIELDS, DocumentField
from cluster_est.cli.forms_command import (
    EVERY_FORM,
    SITES,
    SYMBOLS,
    coefficient_in_words,
    equations,
)
from cluster_est.cli.parser import CODES_IN_WORDS, make_parser
from cluster_est.config.limits_file import LimitsSections
from cluster_est.config.sections import Config
from cluster_est.settings import Settings, keys_of
from cluster_est.sweep.matrix import SweepSections
from cluster_est.toml import inline
from workers.effects.kinds import EffectForm, FormCoefficient, SiteKind

REFERENCE = Path(__file__).parents[2] / "configs" / "reference.toml"
KINDS = {float: "number", int: "whole number", str: "text", bool: "true or false", Any: "value"}


def keys_page() -> str:
    """Every key of a config and of a sweep: its type, default and meaning."""
    parts = [
        "# Keys of a config",
        "Made from the code that reads a config. Paths start from the config's folder. `KEY=VALUE` "
        "on the command line overrides a key, with dots between its parts. Where the default is "
        "empty, a key that is left out says nothing.",
        *_section("", Config, "##", "At the top"),
        "## Every key in one file",
        f"```toml\n{REFERENCE.read_text(encoding='utf-8').strip()}\n```",
        "## Keys of a sweep",
        *_section("", SweepSections, "###", "At the top of a sweep"),
        "## Limits of the next experiment",
        "",
        *_section("", LimitsSections, "###", "At the top of a file of limits"),
    ]
    return "\n\n".join(parts) + "\n"


def forms_page() -> str:
    """Every form of an effect: its equation and its coefficients."""
    parts = [
        "# Forms of effects",
        "Made from the code. [Adding what the model lacks](adding_effects.md) says how to declare "
        "an effect; `cluster-est forms` prints the same as this page, and `cluster-est forms NAME` "
        f"one form with a block for a config. {SYMBOLS}",
        "![The shapes of forms at each kind of site](form_shapes.svg)",
    ]
    for kind, (site, meaning) in SITES.items():
        rows = [_form(kind, form) for (at, _), form in EVERY_FORM.items() if at == kind]
        parts += [f"## {site}", meaning, _table(("form", "equation", "coefficients"), rows)]
    return "\n\n".join(parts) + "\n"


def _form(kind: SiteKind, form: EffectForm) -> tuple[str, str, str]:
    said = equations(kind, form)
    equation = said[0] if form.values else "; ".join(f"`{part}`" for part in said)
    return f"`{form.name}`", equation, "; ".join(map(_coefficient, form.coefficients))


def _coefficient(coefficient: FormCoefficient) -> str:
    return coefficient_in_words(coefficient).replace(coefficient.name, f"`{coefficient.name}`", 1)


def commands_page() -> str:
    """Every command with its arguments, as argparse knows them, and the fields of its document."""
    parts = [
        "# Command line",
        f"Exit codes: {CODES_IN_WORDS}.",
        "[From scripts](from_scripts.md) says how programs use `--json` and `--fail-if`. The "
        "document of every command has these fields:",
        _fields(COMMON_FIELDS),
    ]
    for name, parser in _commands().items():
        usage = re.sub(r"\s+", " ", parser.format_usage().removeprefix("usage: ").strip())
        parts += [f"## {name}", f"{parser.description}.", f"```text\n{usage}\n```"]
        parts.append(_table(("argument", "meaning"), _arguments(parser)))
        examples = [line.strip() for line in str(parser.epilog).splitlines()[1:]]
        parts += ["```text\n" + "\n".join(examples) + "\n```", "Fields with `--json`:"]
        parts.append(_fields(FIELDS[name]))
    return "\n\n".join(parts) + "\n"


def _fields(fields: Sequence[DocumentField]) -> str:
    rows = []
    for each in fields:
        words = ", ".join(f"`{word}`" for word in each.words())
        rows.append((f"`{each.name}`", each.kind, each.meaning + (f": {words}" if words else "")))
    return _table(("field", "kind", "meaning"), rows)


def python_page() -> str:
    """What `import cluster_est as ce` offers, in the words of its docstrings."""
    parts = [
        "# Python",
        "`import cluster_est as ce` offers these names. What else there is, such as further "
        "methods in `cluster_est.methods`, is imported from its own module.",
    ]
    for name in sorted(ce.__all__, key=str.casefold):
        found = getattr(ce, name)
        parts.append(f"::: {found.__module__}.{found.__qualname__}")
        if isinstance(found, type) and issubclass(found, Settings):
            table, inside = _keys(found)
            parts += [table, *(part for each in inside for part in _section(*each, "####"))]
    return "\n\n".join(parts) + "\n"


def _section(path: str, section: type[BaseModel], level: str, title: str = "") -> Iterator[str]:
    """A table of a section's own keys, then the sections inside it."""
    yield f"{level} {title or path}"
    table, inside = _keys(section, path)
    yield table
    for below, nested in inside:
        yield from _section(below, nested, level)


def _keys(
    section: type[BaseModel], path: str = ""
) -> tuple[str, list[tuple[str, type[BaseModel]]]]:
    """A table of a section's keys, and the sections inside it."""
    rows, inside = [], []
    for name, field in keys_of(section):
        key = f"{path}.{name}" if path else name
        nested, many, named = _nested(field.annotation)
        if nested is not None:
            below = f"{key}.NAME" if named else key
            inside.append((below, nested))
            kind = f"[section](#{_anchor(below)}){', several' if many else ''}"
        else:
            kind = _kind(field.annotation)
        rows.append((f"`{name}`", kind, _default(field), field.description or ""))
    return _table(("key", "type", "default", "meaning"), rows), inside


def _nested(annotation: Any) -> tuple[type[BaseModel] | None, bool, bool]:
    """The section inside an annotation, if there is one; in a list; under names."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation, False, False
    origin = get_origin(annotation)
    for inner in get_args(annotation):
        found, _, _ = _nested(inner)
        if found is not None:
            return found, origin is list, origin is dict
    return None, False, False


def _kind(annotation: Any) -> str:
    """A type in words."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if annotation in KINDS:
        return KINDS[annotation]
    if set(inner) == {float, int, bool, str}:
        return "number, true, false or text"
    if origin is Literal:
        return " or ".join(f"`{inline(choice)}`" for choice in inner)
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(_kind(a) for a in inner if a is not type(None)))
    if origin is list:
        return f"list of: {_kind(inner[0])}" if inner else "list"
    if origin is tuple:
        return f"[{', '.join(_kind(each) for each in inner)}]"
    if origin is dict:
        return f"name = {_kind(inner[1])}"
    return _kind(inner[0]) if inner else str(getattr(annotation, "__name__", annotation))


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "needed"
    default = field.get_default(call_default_factory=True)
    if default is None or default is PydanticUndefined or isinstance(default, BaseModel):
        return ""
    return f"`{inline(default)}`" if default not in ({}, [], ()) else ""


def _commands() -> dict[str, argparse.ArgumentParser]:
    """The parser of each command by its name."""
    for action in make_parser()._actions:
        if isinstance(action, argparse._SubParsersAction):
            return dict(action.choices)
    return {}


def _arguments(parser: argparse.ArgumentParser) -> list[tuple[str, str]]:
    rows = []
    for action in parser._actions:
        names = ", ".join(action.option_strings) or str(action.metavar)
        value = f" {action.metavar or action.dest.upper()}" if _takes_value(action) else ""
        rows.append((f"`{names}{value}`", str(action.help)))
    return rows


def _takes_value(action: argparse.Action) -> bool:
    return bool(action.option_strings) and action.nargs != 0


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join(f"| {' | '.join(cell(c) for c in line)} |" for line in lines)


def cell(text: str) -> str:
    """A text that is safe inside a table."""
    return text.replace("|", "\\|").replace("<", "&lt;") if "`" not in text else text


def _anchor(title: str) -> str:
    """As the toc extension makes it of a heading."""
    return re.sub(r"[^\w\s-]", "", title).strip().lower().replace(" ", "-")


PAGES = {
    "keys.md": keys_page,
    "forms.md": forms_page,
    "commands.md": commands_page,
    "python.md": python_page,
}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Put them in the place of the files that only say where they are made."""
    for name, page in PAGES.items():
        stand_in = files.get_file_from_path(name)
        if stand_in is not None:
            files.remove(stand_in)
        files.append(File.generated(config, name, content=page()))
    return files
