"""Programs as C99: one operation a statement, so that no compiler may contract or reorder what the bits depend on."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping

import numpy as np

from malta.errors import InputError
from malta.firmware.elementary import Precision
from malta.firmware.program import TRUTHS, Operation, Program

_FORMS = {
    "ADD": "{0} + {1}",
    "SUB": "{0} - {1}",
    "MUL": "{0} * {1}",
    "DIV": "{0} / {1}",
    "NEG": "-{0}",
    "FABS": "({0} < {zero}) ? -{0} : {0}",
    "SQRT": "{root}({0})",
    "FMIN": "({0} < {1}) ? {0} : {1}",
    "FMAX": "({0} > {1}) ? {0} : {1}",
    "LT": "{0} < {1}",
    "LE": "{0} <= {1}",
    "EQ": "{0} == {1}",
    "NE": "{0} != {1}",
    "NOT": "!{0}",
    "AND": "{0} && {1}",
    "OR": "{0} || {1}",
    "IF_ELSE_ZERO": "{0} ? {1} : {zero}",
    "PICK": "{0} ? {1} : {2}",
}
HEADERS = (  # of C's library, which NAME.h may not hide
    *("assert", "complex", "ctype", "errno", "features", "fenv", "float", "inttypes", "iso646"),
    *("limits", "locale", "math", "setjmp", "signal", "stdarg", "stdbool", "stddef", "stdint"),
    *("stdio", "stdlib", "string", "tgmath", "time", "wchar", "wctype"),
)
_CONDITIONS = {"NOT": 1, "AND": 2, "OR": 2, "IF_ELSE_ZERO": 1, "PICK": 1}  # operands that are true or false


def c_name(text: str) -> str:
    """A text as part of a C identifier."""
    name = re.sub(r"\W+", "_", text.lower(), flags=re.ASCII).strip("_")
    return f"m_{name}" if not name or name[0].isdigit() or name in HEADERS else name


def c_number(value: float, precision: Precision) -> str:
    """A number as C reads it back to the bit. Raises InputError for one that the precision does not hold."""
    if precision == "float":
        with np.errstate(over="ignore"):
            single = np.float32(value)
        if not np.isfinite(single):
            raise InputError("export", "precision", f"float for a number of {float(value):g}", "double")
        return _with_point(str(single)) + "f"
    return _with_point(repr(float(value)))


def _with_point(text: str) -> str:
    return text if any(mark in text for mark in ".e") else f"{text}.0"


def signature(p: Program, prefix: str) -> str:
    """The declaration of a program's function, without its end."""
    takes = [f"const {prefix}_real {name}[{size}]" for name, size in p.arguments if size]
    gives = [f"{prefix}_real {name}[{size}]" for name, size in p.results if size]
    text = f"void {prefix}_{p.name}({', '.join([*takes, *gives])})"
    return "\n".join(textwrap.wrap(text, 118, subsequent_indent="    ", break_long_words=False))


def function_text(p: Program, prefix: str, precision: Precision, *, static: bool = False) -> str:
    """The C function of a program. All arguments are read before a result is written: they may be the same arrays."""
    zero = c_number(0.0, precision)
    inputs = {k for k, o in enumerate(p.operations) if o.op == "INPUT"}
    names = {k: f"t{k}" for k, o in enumerate(p.operations) if o.op != "CONST"}
    lines = []
    for k, operation in enumerate(p.operations):
        if k in inputs:
            argument, entry = operation.place
            lines.append(f"  const {prefix}_real t{k} = {p.arguments[argument][0]}[{entry}];")
        elif operation.op != "CONST":
            of = kind(operation, prefix)
            lines.append(f"  const {of} t{k} = {value_text(p, k, names, prefix, precision)};")
    own = [o for o in p.outputs if o[0] < len(p.results)]
    for i, j, k in own:
        lines.append(f"  {p.results[i][0]}[{j}] = {operand_text(p, k, names, precision)};")
    written = {(i, j) for i, j, _ in own}
    for i, (name, size) in enumerate(p.results):
        lines += [f"  {name}[{j}] = {zero};" for j in range(size) if (i, j) not in written]
    head = f"{'static ' if static else ''}{signature(p, prefix)} {{"
    used = {p.operations[k].place[0] for k in inputs}
    unused = [f"  (void){name};" for i, (name, size) in enumerate(p.arguments) if size and i not in used]
    return "\n".join([head, *unused, *lines, "}", ""])


def kind(operation: Operation, prefix: str) -> str:
    """The type of an operation's value."""
    return "bool" if operation.op in TRUTHS else f"{prefix}_real"


def value_text(p: Program, k: int, names: Mapping[int, str], prefix: str, precision: Precision) -> str:
    """An operation on operands that have these names; one without a name is a constant."""
    operation = p.operations[k]
    conditions = _CONDITIONS.get(operation.op, 0)
    operands = [
        operand_text(p, a, names, precision, condition=i < conditions)
        for i, a in enumerate(operation.operands)
    ]
    form = _FORMS[operation.op]
    return form.format(*operands, zero=c_number(0.0, precision), root=f"{prefix}_root")


def operand_text(
    p: Program, k: int, names: Mapping[int, str], precision: Precision, *, condition: bool = False
) -> str:
    """The value of an operation as a number, or as a condition. Names with brackets are entries of arrays: numbers."""
    zero, one = c_number(0.0, precision), c_number(1.0, precision)
    if p.operations[k].op == "CONST" and k not in names:
        number = c_number(p.operations[k].value, precision)
        return f"({number} != {zero})" if condition else _bracketed(number)
    name = names[k]
    if p.operations[k].op in TRUTHS and not name.endswith("]"):
        return name if condition else f"({name} ? {one} : {zero})"
    return f"({name} != {zero})" if condition else name


def _bracketed(number: str) -> str:
    return f"({number})" if number.startswith("-") else number
