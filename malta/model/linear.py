"""A machine from plain matrices: x' = A x + B (u + d), y = C x, with entries that may be uncertain.

    A = A0 + sum of p_i A_i + F(p), and B, C likewise      parameters p by name; none where all entries are known

F has formulas of p, as "-b / J", for entries that an uncertain system has in its parameters.

Such a machine is designed for, verified, simulated and flown in campaigns as any other. Its currents are its inputs, d
are its disturbances. Its gain file carries the matrices, so that reading the file back needs no module.

Formulas: functions of named parameters as text, "-b / J", which a file can hold and which can only compute.

A formula has numbers, names, + - * / **, brackets and the functions of FUNCTIONS. It is read by a grammar of its own
over Python's syntax tree: nothing else of Python is run.
"""

from __future__ import annotations

import ast
import keyword
import math
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, make_dataclass
from functools import cache
from numbers import Real
from typing import Any, TypedDict, Unpack, cast

import casadi as ca
import numpy as np
from scipy import linalg

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.linear.matrices import system_matrix
from malta.model.actuator import Actuator
from malta.model.data import plant_of
from malta.model.machines import machine_names
from malta.model.parameters import check_parameters, si, symbolic_names
from malta.model.plant import Parameters, Plant, Signal
from malta.model.sensors import Sensors

MAX_FORMULA_LENGTH = 4000  # characters of a formula
FUNCTIONS = {
    name: getattr(ca, name)
    for name in ("sqrt", "exp", "log", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh")
}
_OPERATORS: dict[type[ast.AST], Any] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
}

# How tightly a text binds: a sum, a product, a sign, a power, a name.
SUM, PRODUCT, SIGN, POWER, NAME = range(5)
_BINARY_OPERATIONS = {  # operation: sign, how tightly it binds, and its left and right side must bind
    ca.OP_ADD: (" + ", SUM, SUM, PRODUCT),
    ca.OP_SUB: (" - ", SUM, SUM, PRODUCT),
    ca.OP_MUL: (" * ", PRODUCT, PRODUCT, SIGN),
    ca.OP_DIV: (" / ", PRODUCT, PRODUCT, SIGN),
    ca.OP_POW: ("**", POWER, NAME, NAME),
    ca.OP_CONSTPOW: ("**", POWER, NAME, NAME),
}
_CALLS = {getattr(ca, f"OP_{name.upper()}"): name for name in FUNCTIONS}

Text = tuple[str, int]  # and how tightly it binds


def formula(expression: Any, p: Any, names: Sequence[str]) -> str:
    """Write a scalar expression of the parameters p as a formula of their names; `value_of` gives it back exactly.

    expression : casadi.SX, 1 x 1
    p : casadi.SX, the vector of the parameters

    Raises ValueError for operations that formulas do not have, and beyond MAX_FORMULA_LENGTH characters.

    >>> k, m = ca.SX.sym("k"), ca.SX.sym("m")
    >>> formula(-2 * k / (m + 1) ** 2, ca.vertcat(k, m), ["k", "m"])
    '-2.0 * k / (m + 1.0)**2'
    """
    f = ca.Function("formula", [p], [ca.densify(expression)])
    cells: dict[int, Text] = {}
    found = ""
    for k in range(f.n_instructions()):
        into, out, code = f.instruction_input(k), f.instruction_output(k), f.instruction_id(k)
        if code == ca.OP_OUTPUT:
            found = cells[into[0]][0]
        elif code == ca.OP_INPUT:
            cells[out[0]] = names[into[1]], NAME
        elif code == ca.OP_CONST:
            cells[out[0]] = _constant(f.instruction_constant(k))
        else:
            cells[out[0]] = _text(code, [cells[i] for i in into])
        if max(map(len, (text for text, _ in cells.values())), default=0) > MAX_FORMULA_LENGTH:
            raise ValueError(f"an expression of more than {MAX_FORMULA_LENGTH} characters")
    return found


def _constant(value: float) -> Text:
    if not math.isfinite(value):
        raise ValueError(f"the constant {value}")
    text = repr(float(value))
    return text, SIGN if text.startswith("-") else NAME


def _text(code: int, sides: list[Text]) -> Text:
    def side(k: int, least: int) -> str:
        text, binds = sides[k]
        return text if binds >= least else f"({text})"

    if code in _BINARY_OPERATIONS:
        sign, binds, left, right = _BINARY_OPERATIONS[code]
        return side(0, left) + sign + side(1, right), binds
    if code in _CALLS:
        return f"{_CALLS[code]}({sides[0][0]})", NAME
    unary = {
        ca.OP_ASSIGN: sides[0],
        ca.OP_NEG: (f"-{side(0, POWER)}", SIGN),
        ca.OP_SQ: (f"{side(0, NAME)}**2", POWER),
        ca.OP_TWICE: (f"2 * {side(0, SIGN)}", PRODUCT),
        ca.OP_INV: (f"1 / {side(0, SIGN)}", PRODUCT),
    }
    if code not in unary:
        raise ValueError(f"operation {code} of CasADi, which formulas do not have")
    return unary[code]


def value_of(text: str, values: Mapping[str, Any]) -> Any:
    """Compute a formula at values by name, numbers or CasADi symbols.

    Raises ValueError for what formulas do not have, unknown names, and results that are not finite.

    >>> value_of("-b / J", {"b": 0.1, "J": 2e-3})
    -50.0
    """
    if len(text) > MAX_FORMULA_LENGTH:
        raise ValueError(f"{len(text)} characters, of at most {MAX_FORMULA_LENGTH}")
    try:
        found = _evaluate(ast.parse(text.strip(), mode="eval").body, values)
    except SyntaxError as error:
        raise ValueError("no formula: numbers, names of parameters, + - * / ** and brackets") from error
    except (RecursionError, MemoryError) as error:
        raise ValueError("too many brackets in brackets") from error
    except (ZeroDivisionError, OverflowError) as error:
        raise ValueError(f"no value ({error})") from error
    if isinstance(found, complex) or (isinstance(found, float) and not math.isfinite(found)):
        raise ValueError(f"the value {found}, not a finite number")
    return found


def _evaluate(node: ast.AST, values: Mapping[str, Any]) -> Any:
    if (
        isinstance(node, ast.Constant)
        and isinstance(node.value, int | float)
        and type(node.value) is not bool
    ):
        return float(node.value)
    if isinstance(node, ast.Name) and node.id in values:
        return values[node.id]
    if isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS:
        return _OPERATORS[type(node.op)](_evaluate(node.left, values), _evaluate(node.right, values))
    if isinstance(node, ast.UnaryOp) and type(node.op) in _OPERATORS:
        return _OPERATORS[type(node.op)](_evaluate(node.operand, values))
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in FUNCTIONS:
        if len(node.args) == 1 and not node.keywords:
            return FUNCTIONS[node.func.id](_evaluate(node.args[0], values))
        raise ValueError(f"{node.func.id} of {len(node.args)} arguments")
    if isinstance(node, ast.Name):
        raise ValueError(f"{node.id!r}, which is none of the parameters {' '.join(values)}")
    raise ValueError(f"{ast.unparse(node)[:40]!r}, which no formula has")


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


def linear_machine(A: Any, B: Any = None, C: Any = None, **details: Unpack[Details]) -> Plant:
    """Make a machine x' = A x + B (u + d), y = C x from matrices, an uncertain system, or one of python-control.

    States of positions and then their rates, A = [[0, I], ...], make a machine of second order. An LQG and a margin
    work for other states as well. Their reference is the rest at which the outputs have the wanted values:
    [A B; C 0] (x*, u*) = (0, p*), in the least-squares sense; of a machine with more outputs than inputs the rest
    with the nearest outputs. u* is not fed forward: a machine that needs some stops short of the reference without
    integrals or observed disturbances.

    A : n x n; or in place of A, B and C a continuous control.StateSpace, or what `malta.uncertain` makes of a function
    B : n x m
    C : p x n
    details : by keyword, all optional:
    name : the machine's own name
    states, inputs, outputs : names, "z [m]" with a unit, or Signals; those of a StateSpace, else x1 x2 ..., u1, y1
    nominal : values of the parameters, as {"k": 1.5}
    terms : the factors of each parameter, as {"k": (A1, B1, C1)}; None, or left out at the end: zeros
    formulas : of the parameters, added to entries, as {"A_2_1": "-b / J"}; row and column from 1
    limits : of parameters, (above, below), exclusive
    limit : of the inputs, one number for all or one for each; default: infinite
    noise : of the sensors, rms of a sample, one number for all or one for each; default: 0
    dead_time, computation_time : s, as an `Actuator` has them: one of the two; default: 0

    Returns a Plant.

    Raises InputError for shapes and values that do not fit, a discrete system, and a system with D.

    >>> import malta
    >>> A, B, C = [[0, 1], [0, -0.1]], [[0], [2]], [[1, 0]]
    >>> cart = malta.linear_machine(A, B, C, name="cart", states=["z [m]", "v [m/s]"])
    >>> malta.linearize(cart, cart.at()).A.tolist()
    [[0.0, 1.0], [0.0, -0.1]]
    >>> motor = malta.uncertain(
    ...     lambda J, b: ([[-b / J]], [[1 / J]], [[1]]), {"J": 2e-3, "b": 0.1}
    ... )
    >>> malta.linear_machine(motor, name="motor").parameters.system.formulas
    (('A_1_1', '-(b / J)'), ('B_1_1', '1 / J'))
    """
    for key in details:
        if key not in Details.__annotations__:
            known = " ".join(Details.__annotations__)
            raise InputError(CALLER, key, "an unknown detail", f"one of {known}")
    if B is None and C is None:
        is_uncertain = all(hasattr(A, name) for name in ("matrices", "nominal", "limits", "approximate"))
        A, B, C, own = (_of_uncertain if is_uncertain else _of_state_space)(A)
        if both := sorted({"nominal", "terms", "formulas", "limits"} & own.keys() & details.keys()):
            raise InputError(CALLER, both[0], "beside an uncertain system, which has its own", "none")
        details = {**own, **details}
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
    )
    if not math.isfinite(sum(system.noise) + system.dead_time + system.computation_time):
        raise InputError(CALLER, "noise, dead_time, computation_time", "infinity", "finite numbers")
    if len({math.isinf(limit) for limit in system.limit}) > 1:
        raise InputError(CALLER, "limit", str(system.limit), "one for each of the inputs, or none")
    return plant_of(record_of(system, nominal, details.get("name", "linear")))


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
        "__module__": __name__,  # where `plant` stands
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


def plant(par: Any) -> Plant:
    """The linear machine with these parameters, which may be CasADi symbols."""
    s: LinearSystem = par.system
    A, B, C = (ca.sparsify(ca.DM(M)) for M in s.matrices)
    for name, terms in s.terms:
        p = getattr(par, name)
        A, B, C = (M + p * ca.sparsify(ca.DM(T)) for M, T in zip((A, B, C), terms, strict=True))
    if s.formulas:
        values = {name: getattr(par, name) for name in symbolic_names(par)}
        A, B, C = (_with_formulas(letter, M, s, values) for letter, M in zip(LETTERS, (A, B, C), strict=True))

    def position_of(y: Any) -> Any:
        a, b, c = (np.array(ca.DM(M)) for M in (A, B, C))
        return ca.DM(_states_at_rest(a, b, c, made.coordinates)) @ y

    made = Plant(
        name=par.preset,
        parameters=par,
        variant=plant,
        states=s.states,
        inputs=s.inputs,
        outputs=s.outputs,
        disturbances=tuple(Signal(f"d_{u.name}", u.unit) for u in s.inputs),
        f=lambda x, u, w: A @ x + B @ (u + w),
        h=lambda x, _: C @ x,
        position_of=position_of,
        actuator=Actuator(
            coils=s.inputs,
            force_constant=(1.0,) * len(s.inputs),
            current_limit=math.inf,
            force_limit=s.limit,
            dead_time=s.dead_time,
            computation_time=s.computation_time,
            limited=lambda i: i,
        ),
        sensors=Sensors(noise=s.noise),
    )
    return made


def _with_formulas(letter: str, M: Any, s: LinearSystem, values: Mapping[str, Any]) -> Any:
    """A matrix and the formulas that are added to its entries, at values of the parameters."""
    added = {place: value_of(text, values) for place, text in s.formulas if place.startswith(letter)}
    symbolic = next((type(v) for v in added.values() if isinstance(v, ca.SX | ca.MX)), None)
    found = M if symbolic is None else symbolic(M)
    for place, value in added.items():
        row, column = _place(place)
        found[row, column] += value
    return found


def _place(place: str) -> tuple[int, int]:
    """Row and column, from 0."""
    _, row, column = place.split("_")
    return int(row) - 1, int(column) - 1


def _states_at_rest(A: FloatArray, B: FloatArray, C: FloatArray, coordinates: int) -> FloatArray:
    """The matrix from outputs to states at rest; to the positions q of states (q, q')."""
    n, p, half = len(A), len(C), coordinates
    if p > B.shape[1]:  # no inputs hold all values: the nearest of those that some hold
        rests = linalg.null_space(np.hstack([A, B]))[:n]
        return np.asarray(rests @ np.linalg.pinv(C @ rests))[: half or n]
    if half and p == half and np.linalg.matrix_rank(C[:, :half]) == half:
        return np.asarray(np.linalg.inv(C[:, :half]))
    whole = system_matrix(A, B, C)
    asked = np.vstack([np.zeros((n, p)), np.eye(p)])
    return np.asarray(np.linalg.lstsq(whole, asked, rcond=None)[0][: half or n])


def _of_state_space(source: Any) -> tuple[Any, Any, Any, Details]:
    wanted = "matrices A, B, C, or a continuous control.StateSpace"
    if callable(source) and not hasattr(source, "state_labels"):
        found = "a function"
        raise InputError(CALLER, "A", found, "what malta.uncertain(function, nominal values) makes of it")
    if not all(hasattr(source, name) for name in ("A", "B", "C", "D", "dt", "state_labels")):
        raise InputError(CALLER, "A", f"a {type(source).__name__} alone", wanted)
    if source.dt not in (0, None):
        raise InputError(CALLER, "A", f"a discrete system, dt = {source.dt}", wanted)
    if np.any(source.D):
        raise InputError(CALLER, "D", "inputs that the outputs follow at once", "zeros")
    labels: Details = {} if re.fullmatch(r"sys\[\d+\].*", source.name) else {"name": source.name}
    if source.state_labels != [f"x[{k}]" for k in range(source.nstates)]:  # not the library's numbers
        labels["states"] = source.state_labels
    if source.input_labels != [f"u[{k}]" for k in range(source.ninputs)]:
        labels["inputs"] = source.input_labels
    if source.output_labels != [f"y[{k}]" for k in range(source.noutputs)]:
        labels["outputs"] = source.output_labels
    return source.A, source.B, source.C, labels


def _of_uncertain(system: Any) -> tuple[Any, Any, Any, Details]:
    """What `malta.uncertain` made: constant entries as they are, the others as formulas of the parameters."""
    if system.sample_time is not None:
        raise InputError(CALLER, "A", "an uncertain system in discrete time", "one in continuous time")
    if system.approximate:
        raise InputError(
            CALLER, "A", f"an uncertain system that is not exact: {system.approximate}", "an exact one"
        )
    p = ca.SX.sym("p", len(system.names))
    A, B, C, *more = system.matrices.call([p])
    if more and ca.sparsify(more[0]).nnz():
        raise InputError(CALLER, "D", "inputs that the outputs follow at once", "zeros")
    if len(more) > 1:
        E = ca.sparsify(more[1])
        if not E.sparsity().is_diag():
            raise InputError(
                CALLER, "E", "an E(p) that is not diagonal", "a diagonal one, or A and B divided by it"
            )
        A, B = (ca.diag(1 / ca.diag(E)) @ M for M in (A, B))
    base, formulas = [], {}
    for letter, M in zip(LETTERS, (A, B, C), strict=True):
        constant = np.zeros(M.shape)
        for row, column in zip(*M.sparsity().get_triplet(), strict=True):
            entry, place = ca.simplify(M[row, column]), f"{letter}_{row + 1}_{column + 1}"
            if entry.is_constant():
                constant[row, column] = float(entry)
                continue
            try:
                formulas[place] = formula(entry, p, system.names)
            except ValueError as error:
                wanted = "a shorter one, or a machine of its own (malta new)"
                raise InputError(CALLER, place, str(error), wanted) from error
        base.append(constant)
    nominal = dict(zip(system.names, system.nominal.tolist(), strict=True))
    limits = dict(zip(system.names, system.limits, strict=False))
    own: Details = {"nominal": nominal, "formulas": formulas, "limits": limits}
    return base[0], base[1], base[2], own


def _matrix(name: str, value: Any) -> FloatArray:
    try:
        found = np.array(value, dtype=float)
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
        found = np.broadcast_to(np.asarray(given, dtype=float), (count,))
    except (TypeError, ValueError) as error:
        raise InputError(CALLER, what, repr(given), wanted) from error
    if not (found >= 0 if zero else found > 0).all():  # or NaN
        raise InputError(CALLER, what, repr(given), wanted)
    return tuple(found.tolist())
