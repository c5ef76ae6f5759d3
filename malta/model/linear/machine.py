"""A machine from plain matrices: x' = A x + B (u + d), y = C x, with entries that may be uncertain.

    A = A0 + sum of p_i A_i + F(p), and B, C likewise      parameters p by name; none where all entries are known

F has formulas of p, as "-b / J", for entries that an uncertain system has in its parameters.

Such a machine is designed for, verified, simulated and flown in campaigns as any other. Its currents are its inputs, d
are its disturbances. Its gain file carries the matrices, so that reading the file back needs no module.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, Unpack

import casadi as ca
import numpy as np
from scipy import linalg

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.linear.matrices import system_matrix
from malta.model.actuator import Actuator
from malta.model.linear.formulas import FUNCTIONS, MAX_FORMULA_LENGTH, value_of
from malta.model.linear.parameters import CALLER, LETTERS, Details, LinearSystem, linear_parameters
from malta.model.linearize import LinearModel, linearize
from malta.model.parameters import symbolic_names
from malta.model.plant import Plant, Signal
from malta.model.plants import plant_of
from malta.model.sensors import Sensors

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
    range : of the sensors, the largest reading either way, one number for all or one for each; default: 0, not declared
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
    if B is None and C is None:
        is_uncertain = all(hasattr(A, name) for name in ("matrices", "nominal", "limits", "approximate"))
        A, B, C, own = (_of_uncertain if is_uncertain else _of_state_space)(A)
        if both := sorted({"nominal", "terms", "formulas", "limits"} & own.keys() & details.keys()):
            raise InputError(CALLER, both[0], "beside an uncertain system, which has its own", "none")
        details = {**own, **details}
    return plant_of(linear_parameters(A, B, C, **details))


def linear_model_of(source: Any, caller: str) -> LinearModel:
    """The linear model that a function was given: as it is, of a Plant at rest at zero, or of a control.StateSpace.

    Raises InputError for another source, which names the caller.
    """
    if isinstance(source, LinearModel):
        return source
    made = linear_machine(source) if hasattr(source, "state_labels") else source
    if not isinstance(made, Plant):
        expected = "a LinearModel, a Plant or a continuous control.StateSpace"
        raise InputError(caller, "model", f"a {type(source).__name__}", expected)
    return linearize(made, made.at())


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
        sensors=Sensors(noise=s.noise, range=s.range),
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
