"""Effects as Modelica: declarations and equations that a modeller can put into the source."""

from __future__ import annotations

import re
from collections.abc import Iterator

import sympy as sp
from sympy.printing.precedence import precedence
from sympy.printing.str import StrPrinter

from cluster_est.export.repaired_model import EstimatedValue, RepairedModel
from workers.effects.definition import SIGNAL, TIME, EffectDefinition, variable_symbol

_NO_FUNCTION = {
    "backlash": "the play operator: no function of Modelica, see Modelica.Blocks",
    **dict.fromkeys(
        ("rate_limit", "rate_limit_from_rest"),
        "no function of Modelica, see Modelica.Blocks.Nonlinear.SlewRateLimiter",
    ),
}
_FUNCTIONS = {"Abs": "abs", "sign": "sign", "Min": "min", "Max": "max", "sqrt": "sqrt"}


class _ModelicaPrinter(StrPrinter):  # type: ignore[misc]
    """Expressions of Modelica."""

    def _print_Pow(self, expr: sp.Expr) -> str:  # noqa: N802 - SymPy's name
        base, exponent = expr.args
        if exponent == sp.Rational(1, 2):
            return f"sqrt({self._print(base)})"
        if exponent == -1:
            return f"1/{self.parenthesize(base, precedence(expr))}"
        power = precedence(expr)
        return f"{self.parenthesize(base, power + 1)}^{self.parenthesize(exponent, power + 1)}"

    def _print_Function(self, expr: sp.Expr) -> str:  # noqa: N802
        name = type(expr).__name__
        arguments = [self._print(argument) for argument in expr.args]
        return f"{_FUNCTIONS.get(name, name)}({', '.join(arguments)})"

    def _print_Min(self, expr: sp.Expr) -> str:  # noqa: N802
        return self._nested("min", expr)

    def _print_Max(self, expr: sp.Expr) -> str:  # noqa: N802
        return self._nested("max", expr)

    def _nested(self, name: str, expr: sp.Expr) -> str:
        """Modelica's min and max take two numbers."""
        first, *rest = (str(self._print(argument)) for argument in expr.args)
        for argument in rest:
            first = f"{name}({first}, {argument})"
        return first

    def _print_Piecewise(self, expr: sp.Expr) -> str:  # noqa: N802
        *chosen, (last, _) = expr.args
        arms = [f"if {self._print(when)} then {self._print(value)} else " for value, when in chosen]
        return f"({''.join(arms)}{self._print(last)})"

    def _print_Relational(self, expr: sp.Expr) -> str:  # noqa: N802
        left, right = (self._print(side) for side in (expr.lhs, expr.rhs))
        return f"{left} {expr.rel_op} {right}"

    def _print_Rational(self, expr: sp.Rational) -> str:  # noqa: N802
        return f"{expr.p}/{expr.q}"


def modelica(repair: RepairedModel) -> str:
    """The effects as declarations and equations, and the parameters as modifiers."""
    lines = [f"// {repair.description.file} with what run {repair.run} has found"]
    if repair.parameters:
        lines.append("// parameters and initial states of the model:")
        lines += [f"//   {f.name} = {f.value!r}{_comment(f)}" for f in repair.parameters]
    if not repair.effects:
        return "\n".join([*lines, "// no effects were added", ""])
    declared, equations = [], []
    for effect, values in zip(repair.effects, repair.coefficients, strict=True):
        declared += [*_declarations(effect, values)]
        equations += [f"  // {effect.form.name} at {effect.site}", *_equations(effect)]
    return "\n".join([*lines, *declared, "equation", *equations, ""])


def _comment(found: EstimatedValue) -> str:
    unit = f" [{found.unit}]" if found.unit else ""
    return unit + (f", {found.interval}" if found.interval else "")


def _name(*parts: str) -> str:
    """An identifier of Modelica."""
    return re.sub(r"\W+", "_", "_".join(parts)).strip("_")


def _declarations(effect: EffectDefinition, values: tuple[EstimatedValue, ...]) -> Iterator[str]:
    for value in values:
        unit = f'(unit="{value.unit}")' if value.unit else ""
        said = f' "{value.interval}"' if value.interval else ""
        yield f"  parameter Real {_name(value.name)}{unit} = {value.value!r}{said};"
    for state in effect.form.states:
        yield f'  Real {_name(effect.effect.name, state.name)} "state of {effect.form.name}";'
    for target in effect.site.targets:
        yield f"  Real {_result(effect, target)};"


def _result(effect: EffectDefinition, target: str) -> str:
    return _name(effect.effect.name, "at", target)


def _equations(effect: EffectDefinition) -> Iterator[str]:
    name = effect.effect.name
    meaning = {s: sp.Symbol(_name(str(s))) for s in effect.coefficients}
    pairs = zip(effect.states, effect.form.states, strict=True)
    meaning |= {symbol: sp.Symbol(_name(name, own.name)) for symbol, own in pairs}
    meaning |= {variable_symbol(used): sp.Symbol(used) for used in effect.uses}
    meaning |= {TIME: sp.Symbol("time"), SIGNAL: sp.Symbol(effect.site.target)}

    def text(expression: sp.Expr) -> str:
        return str(_ModelicaPrinter().doprint(expression.xreplace(meaning)))

    for target, equation in effect.equations:
        result, site = _result(effect, target), effect.site
        if effect.form.memory:
            size = _name(str(effect.coefficients[0]))
            if effect.form.memory == "delay":
                yield f"  {result} = delay({target}, {size});"
            else:
                yield f"  {result} = {effect.form.memory}({target}, {size});"
                yield f"  // {_NO_FUNCTION[effect.form.memory]}"
        else:
            yield f"  {result} = {text(equation)};"
        if site.at_rates:
            yield f"  // add {result} to the right side of der({target})"
        else:
            yield f"  // put {result} in the place of {target}"
    for own, slope in zip(effect.form.states, effect.derivatives, strict=True):
        yield f"  der({_name(name, own.name)}) = {text(slope)};"
    starts = zip(effect.form.states, effect.starts, strict=True)
    for own, start in starts:
        yield f"  // initial equation: {_name(name, own.name)} = {text(start)};"
