"""The parameters of a machine from plain matrices, as its gain file stores them: checked, and equal by content."""

from __future__ import annotations

import keyword
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, make_dataclass
from functools import cache
from numbers import Real
from typing import Any, TypedDict, Unpack, cast

import numpy as np

from malta.arguments import require_real
from malta.arrays import FloatArray
from malta.errors import InputError
from malta.model.linear.formulas import value_of
from malta.model.machines import machine_names
from malta.model.parameters import Parameters, check_parameters, si, symbolic_names
from malta.model.signals import Signal

Rows = tuple[tuple[float, ...], ...]
LETTERS = "ABC"
CALLER = "linear_machine"
RESERVED_FIELDS = ("system", "preset")  # fields of the parameters beside their own
PLACE = re.compile(r"([ABC])_([1-9]\d{0,3})_([1-9]\d{0,3})")  # an entry of a matrix


@dataclass(frozen=True)
class LinearSystem:
    """A linear machine without the values of its parameters, as its gain file stores it. Equal by content."""

    states: tuple[Signal, ...]  # n
    inputs: tuple[Signal, ...]  # m
    outputs: tuple[Signal, ...]  # p
    matrices: tuple[Rows, Rows, Rows]  # A0 n x n, B0 n x m, C0 p x n
    terms: tuple[tuple[str, tuple[Rows, Rows, Rows]], ...]  # by parameter: its factors in A, B, C
    limit: tuple[float, ...]  # m, of each input, its unit; inf: none
    noise: tuple[float, ...]  # p, rms of a sample, the unit of each output
    dead_time: float  # s, from measurement to force, half a sample of hold included
    formulas: tuple[tuple[str, str], ...] = ()  # added to an entry: ("A_2_1", "-b / J")
    limits: tuple[tuple[str, float, float], ...] = ()  # of parameters: name, above, below; inf: none
    computation_time: float = 0.0  # s, from a sample to its new force
    range: tuple[float, ...] = ()  # p, largest reading either way, the unit of each output; 0: not declared


class Details(TypedDict, total=False):
    """The optional arguments of `linear_machine`, which says what they are."""

    name: str
    states: Sequence[str | Signal]
    inputs: Sequence[str | Signal]
    outputs: Sequence[str | Signal]
    nominal: Mapping[str, float]
    terms: Mapping[str, Sequence[Any]]
    formulas: Mapping[str, str]
    limits: Mapping[str, tuple[float, float]]
    limit: float | Sequence[float]
    noise: float | Sequence[float]
    dead_time: float
    computation_time: float
    range: float | Sequence[float]


def linear_parameters(A: Any, B: Any, C: Any, **details: Unpack[Details]) -> Parameters:
    """The parameters of the machine x' = A x + B (u + d), y = C x, with the details of `linear_machine`.

    Raises InputError for shapes, names and values that do not fit.
    """
    for key in details:
        if key not in Details.__annotations__:
            known = " ".join(Details.__annotations__)
            raise InputError(CALLER, key, "an unknown detail", f"one of {known}")
    matrices = (_matrix("A", A), _matrix("B", B), _matrix("C", C))
    n, m, p = len(matrices[0]), matrices[1].shape[1], len(matrices[2])
    for letter, M, shape in zip(LETTERS, matrices, ((n, n), (n, m), (p, n)), strict=True):
        if M.shape != shape or not M.size:
            raise InputError(CALLER, letter, f"shape {M.shape}", f"{shape}, at least 1 x 1")
    nominal, formulas = details.get("nominal", {}), details.get("formulas", {})
    system = LinearSystem(
        _signals("states", details.get("states"), "x", n),
        _signals("inputs", details.get("inputs"), "u", m),
        _signals("outputs", details.get("outputs"), "y", p),
        _rows(matrices),
        _terms(nominal, details.get("terms", {}), matrices, formulas),
        _numbers("limit", details.get("limit", math.inf), m, zero=False),
        _numbers("noise", details.get("noise", 0.0), p),
        _numbers("dead_time", details.get("dead_time", 0.0), 1)[0],
        _formulas(formulas, nominal, matrices),
        _limits(details.get("limits", {}), nominal),
        _numbers("computation_time", details.get("computation_time", 0.0), 1)[0],
        _numbers("range", details.get("range", 0.0), p),
    )
    if not math.isfinite(sum(system.noise) + system.dead_time + system.computation_time):
        raise InputError(CALLER, "noise, dead_time, computation_time", "infinity", "finite numbers")
    if len({math.isinf(limit) for limit in system.limit}) > 1:
        raise InputError(CALLER, "limit", str(system.limit), "one for each of the inputs, or none")
    return record_of(system, nominal, details.get("name", "linear"))


def record_of(system: LinearSystem, values: Mapping[str, float], name: str) -> Parameters:
    """The parameters of a linear machine: a field for each, the system, and the machine's name as the preset."""
    if not isinstance(name, str) or not name or name in machine_names():
        raise InputError(CALLER, "name", repr(name), "a name that no other machine has")
    numbers = [float(v) if isinstance(v, Real) and not isinstance(v, bool) else v for v in values.values()]
    return cast("Parameters", _record(tuple(values), system.limits)(*numbers, system, name))


@cache
def _record(names: tuple[str, ...], limits: tuple[tuple[str, float, float], ...]) -> Callable[..., Any]:
    """The class of parameters with these names, one for all machines with equal names and limits."""
    ends = {name: [end if math.isfinite(end) else None for end in own] for name, *own in limits}
    sides = {name: ends.get(name, (None, None)) for name in names}
    entries: list[Any] = [
        (name, float, si("1", above=above, below=below)) for name, (above, below) in sides.items()
    ]
    entries.append(("system", LinearSystem, field(metadata={"shapes": True})))
    entries.append(("preset", str, "linear"))
    own = {
        "__module__": __name__,  # beside which `plant` stands
        "__post_init__": lambda record: check_parameters(record, CALLER),
        "__reduce__": _reduce,
    }
    return make_dataclass("Parameters", entries, frozen=True, namespace=own)


def _reduce(record: Any) -> tuple[Any, ...]:
    """The arguments with which pickle rebuilds a record, because its class has no name in this module."""
    values = {name: getattr(record, name) for name in symbolic_names(record)}
    return record_of, (record.system, values, record.preset)


def is_linear(parameters: Any) -> bool:
    """Whether these are the parameters of a linear machine."""
    return isinstance(getattr(parameters, "system", None), LinearSystem)


def _matrix(name: str, value: Any) -> FloatArray:
    try:
        found = np.array(require_real(CALLER, name, value), dtype=float)
    except InputError:
        raise
    except (TypeError, ValueError) as error:
        raise InputError(CALLER, name, f"a {type(value).__name__}", "a matrix of numbers") from error
    if found.ndim != 2 or not np.isfinite(found).all():
        what = "NaN or infinity" if found.ndim == 2 else f"{found.ndim} dimensions"
        raise InputError(CALLER, name, what, "a matrix of finite numbers, as [[0, 1], [2, 0]]")
    return found


def _rows(matrices: Sequence[FloatArray]) -> tuple[Rows, Rows, Rows]:
    A, B, C = (tuple(tuple(map(float, row)) for row in M + 0.0) for M in matrices)
    return A, B, C


def _formulas(
    given: Mapping[str, str], nominal: Mapping[str, float], matrices: Sequence[FloatArray]
) -> tuple[tuple[str, str], ...]:
    """The formulas, whose places and values at the nominal parameters are checked. Raises InputError."""
    for place, text in given.items():
        field = f"formulas.{place}"
        known = PLACE.fullmatch(str(place))
        shape = matrices[LETTERS.index(known[1])].shape if known else (0, 0)
        if not known or int(known[2]) > shape[0] or int(known[3]) > shape[1]:
            raise InputError(CALLER, field, "no entry of A, B or C", "A_2_1 for row 2 and column 1 of A")
        if not isinstance(text, str):
            raise InputError(CALLER, field, f"a {type(text).__name__}", 'a formula, as "-b / J"')
        try:
            value_of(text, {name: float(value) for name, value in nominal.items()})
        except (TypeError, ValueError) as error:
            raise InputError(CALLER, field, str(error), 'a formula of the parameters, as "-b / J"') from error
    return tuple(sorted(given.items()))


def _limits(given: Any, nominal: Mapping[str, float]) -> tuple[tuple[str, float, float], ...]:
    """Limits by parameter, without those that are infinite on both sides. Raises InputError."""
    found = []
    for name, ends in (given if isinstance(given, Mapping) else {"": given}).items():
        if name not in nominal:
            raise InputError(CALLER, f"limits.{name}", "an unknown parameter", " ".join(nominal) or "none")
        try:
            above, below = map(float, ends)
        except (TypeError, ValueError) as error:
            raise InputError(CALLER, f"limits.{name}", repr(ends), "(above, below), two numbers") from error
        if not above < below:
            raise InputError(CALLER, f"limits.{name}", repr(ends), "(above, below), the lower one first")
        if math.isfinite(above) or math.isfinite(below):
            found.append((name, above, below))
    return tuple(found)


def _terms(
    nominal: Any, terms: Any, base: Sequence[FloatArray], formulas: Any
) -> tuple[tuple[str, tuple[Rows, Rows, Rows]], ...]:
    """The terms in the order of the nominal values. Raises InputError for names and shapes that do not fit."""
    for what, given in (("nominal", nominal), ("terms", terms), ("formulas", formulas)):
        if not isinstance(given, Mapping):
            raise InputError(CALLER, what, f"a {type(given).__name__}", "a table by parameter")
    for name in {**nominal, **terms}:
        if name not in nominal or (name not in terms and not formulas):
            where = "nominal" if name not in nominal else "terms"
            raise InputError(CALLER, f"{where}.{name}", "nothing", "a nominal value and its terms")
        if not str(name).isidentifier() or keyword.iskeyword(name) or name in RESERVED_FIELDS:
            raise InputError(CALLER, f"nominal.{name}", "this name", "a name as Python has them")
    found = []
    for name in [one for one in nominal if one in terms]:
        parts = (
            list(terms[name]) if isinstance(terms[name], tuple | list) else [terms[name], None, None, None]
        )
        parts += [None] * (len(base) - len(parts))
        if len(parts) != len(base):
            raise InputError(CALLER, f"terms.{name}", f"{len(parts)} matrices", "(A1, B1, C1)")
        own = [
            np.zeros_like(M) if part is None else _matrix(f"terms.{name}", part)
            for M, part in zip(base, parts, strict=True)
        ]
        for letter, M, part in zip(LETTERS, base, own, strict=True):
            if M.shape != part.shape:
                raise InputError(CALLER, f"terms.{name}: {letter}", f"shape {part.shape}", f"{M.shape}")
        found.append((name, _rows(own)))
    return tuple(found)


def _signals(what: str, given: Any, letter: str, count: int) -> tuple[Signal, ...]:
    if given is None:
        return tuple(Signal(f"{letter}{k + 1}", "1") for k in range(count))
    if isinstance(given, str) or not isinstance(given, Sequence) or len(given) != count:
        found = f"{len(given)} names" if isinstance(given, Sequence) else repr(given)
        raise InputError(CALLER, what, found, f"{count} names in a list")
    return tuple(_signal(what, one) for one in given)


def _signal(what: str, given: Any) -> Signal:
    text = given.name if isinstance(given, Signal) else given
    if not isinstance(text, str) or not text.strip() or "." in text.partition(" [")[0]:
        raise InputError(CALLER, what, repr(given), 'a name without dots, or "z [m]"')
    name, opened, unit = text.rpartition(" [")
    if isinstance(given, Signal):
        return given
    return Signal(name, unit[:-1]) if opened and unit.endswith("]") else Signal(text, "1")


def _numbers(what: str, given: Any, count: int, *, zero: bool = True) -> tuple[float, ...]:
    """`count` numbers of at least 0, or above 0 unless `zero`; one number stands for all. Raises InputError."""
    wanted = f"a number {'of at least' if zero else 'above'} 0, or {count} of them"
    try:
        found = np.broadcast_to(np.asarray(require_real(CALLER, what, given), dtype=float), (count,))
    except InputError:
        raise
    except (TypeError, ValueError) as error:
        raise InputError(CALLER, what, repr(given), wanted) from error
    if not (found >= 0 if zero else found > 0).all():  # or NaN
        raise InputError(CALLER, what, repr(given), wanted)
    return tuple(found.tolist())
