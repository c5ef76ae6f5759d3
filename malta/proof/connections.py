"""Uncertain systems in series, side by side, in parallel, in feedback and by names, among each other and known ones.

    series      y = G2 G1 u         parallel    y = (G1 + G2) u
    side by side  y = diag(G1, G2) u    feedback    y = G (u + sign K y)

Parameters of the same name are one parameter. What is known may be a control.StateSpace or TransferFunction, or a
matrix of gains. The result is an uncertain system of its own: its margin, gains over the box and samples are asked as
of any other, and `malta.linear_machine` makes a machine of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from malta.arguments import describe
from malta.arrays import readonly
from malta.errors import InputError
from malta.linear import diagrams, interconnection
from malta.linear.compensators import compensator_of
from malta.linear.system import System
from malta.linear.uncertain import Compensator, UncertainSystem
from malta.proof.box import box_of

if TYPE_CHECKING:
    from malta.proof.margin import Ranges

MOST_SYSTEMS = 100_000


def series(*systems: Any) -> UncertainSystem:
    """Connect systems one after the other: the first takes u, the last gives y.

    systems : UncertainSystems, control.StateSpaces, TransferFunctions, Compensators without delay and lag, or matrices
        of gains; at least one uncertain

    Returns an UncertainSystem.

    Raises InputError for shapes, sample times and nominal values that do not fit.

    >>> import control, malta
    >>> mass = malta.uncertain(
    ...     lambda m: ([[0, 1], [0, 0]], [[0], [1 / m]], [[1, 0]]), {"m": 0.1}
    ... )
    >>> lagging = malta.proof.series(
    ...     control.tf([500], [1, 500]), mass
    ... )  # a drive of 500 rad/s
    >>> print(malta.robust_margin(lagging, control.tf([-40, -800], [1, 80]), {"m": 0.5}))
    proven 197.57 %, lost at 197.58 % at 168.5 rad/s
    """
    whole = _Connection.of(systems, "series")
    return whole.system(interconnection.series(*whole.parts))


def append(*systems: Any) -> UncertainSystem:
    """Put systems side by side, each with inputs and outputs of its own: y = diag(G1, G2, ...) u.

    systems : as for `series`

    Returns an UncertainSystem. Raises InputError as `series` does.

    >>> import malta
    >>> one = malta.uncertain(lambda k: ([[-k]], [[1]], [[1]]), {"k": 2.0})
    >>> both = malta.proof.append(one, [[3.0]])
    >>> both.state_space(k=5).D.tolist()
    [[0.0, 0.0], [0.0, 3.0]]
    """
    whole = _Connection.of(systems, "append")
    return whole.system(interconnection.append(*whole.parts))


def parallel(*systems: Any) -> UncertainSystem:
    """Add the outputs of systems with the same inputs: y = (G1 + G2 + ...) u.

    systems : as for `series`

    Returns an UncertainSystem. Raises InputError as `series` does.

    >>> import malta
    >>> one = malta.uncertain(lambda k: ([[-k]], [[1]], [[1]]), {"k": 2.0})
    >>> malta.proof.parallel(one, one).state_space(k=4).dcgain().item()
    0.5
    """
    whole = _Connection.of(systems, "parallel")
    return whole.system(diagrams.parallel(*whole.parts))


def feedback(system: Any, law: Any, sign: int = -1) -> UncertainSystem:
    """Close a loop: y = G (u + sign K y), as control.feedback does for known systems.

    system : G
    law : K, from y to what is added to u
    sign : -1, or +1, which the laws of malta take

    One of the two is uncertain, as for `series`.

    Returns an UncertainSystem. Raises InputError as `series` does, and where I - sign D_K D_G
    is singular, or an algebraic loop has more than LARGEST_LOOP signals.

    >>> import control, malta
    >>> mass = malta.uncertain(
    ...     lambda m: ([[0, 1], [0, 0]], [[0], [1 / m]], [[1, 0]]), {"m": 0.1}
    ... )
    >>> closed = malta.proof.feedback(mass, control.tf([40, 800], [1, 80]))
    >>> for known in malta.proof.random_systems(closed, 2, {"m": 0.5}, seed=1):
    ...     print(f"{control.damp(known, doprint=False)[1].min():.2f}")
    0.19
    0.16
    """
    caller = "feedback"
    whole = _Connection.of((system, law), caller)
    if sign not in (-1, 1):
        raise InputError(caller, "sign", describe(sign), "-1 or 1")
    return whole.system(diagrams.feedback(whole.parts[0], whole.parts[1], sign))


def interconnect(
    systems: Sequence[Any], inputs: Sequence[str] | str, outputs: Sequence[str] | str
) -> UncertainSystem:
    """Connect systems by the names of their signals, as control.interconnect does for known systems.

    An input of a system takes the output of its name, and the input of its name from outside, added where both exist.

    systems : (system, names of its inputs, names of its outputs) each, the system as for `series`; or a system of
        python-control alone, which has names of its own, as control.summing_junction(["r", "-y"], "e")
    inputs : names of the inputs of the whole
    outputs : names of its outputs, each an output of a system

    Returns an UncertainSystem.

    Raises InputError as `series` does, for names that fit no signal, for two outputs of one name, and for an algebraic
    loop as `feedback` does.

    >>> import control, malta
    >>> mass = malta.uncertain(
    ...     lambda m: ([[0, 1], [0, 0]], [[0], [1 / m]], [[1, 0]]), {"m": 0.1}
    ... )
    >>> error = control.summing_junction(["r", "-y"], "e")
    >>> lead = control.tf([40, 800], [1, 80], inputs="e", outputs="v")
    >>> drive = control.tf([500], [1, 500], inputs="v", outputs="f")
    >>> parts = [error, lead, drive, (mass, "f", "y")]
    >>> closed = malta.proof.interconnect(parts, "r", "y")
    >>> print(malta.robust_margin(closed, [[0.0]], {"m": 0.5}))
    proven 197.57 %, lost at 197.58 % at 168.5 rad/s
    """
    caller = "interconnect"
    named = [_with_names(one, caller) for one in systems]
    whole = _Connection.of([system for system, _, _ in named], caller)
    parts = [
        replace(part, inputs=tuple(into), outputs=tuple(out))
        for part, (_, into, out) in zip(whole.parts, named, strict=True)
    ]
    return whole.system(diagrams.interconnect(parts, _names_of(inputs), _names_of(outputs)))


def _with_names(one: Any, caller: str) -> tuple[Any, list[str], list[str]]:
    """A system with the names of its inputs and outputs, one for each. Raises InputError."""
    system, *names = one if isinstance(one, tuple) else (one,)
    if not names and hasattr(system, "input_labels"):
        names = [system.input_labels, system.output_labels]
    if len(names) != 2:
        raise InputError(caller, "systems", describe(one), "(system, names of inputs, names of outputs)")
    into, out = map(_names_of, names)
    if isinstance(system, UncertainSystem):
        shape = system.matrices.size2_out(1), system.matrices.size1_out(2)
    elif hasattr(system, "ninputs"):
        shape = system.ninputs, system.noutputs
    else:
        shape = np.shape(np.asarray(getattr(system, "D", system)))[::-1]
    if (len(into), len(out)) != shape:
        found = f"{len(into)} names of inputs and {len(out)} of outputs"
        raise InputError(caller, "systems", found, f"{' and '.join(map(str, shape))} of them")
    return system, into, out


def _names_of(names: Sequence[str] | str) -> list[str]:
    return [names] if isinstance(names, str) else list(names)


def random_systems(system: UncertainSystem, count: int, ranges: Ranges, seed: int = 0) -> list[Any]:
    """Draw known systems from a box, each parameter uniformly in its range: for plots beside what is proven of all.

    system : of `malta.uncertain`
    count : of systems
    ranges : by parameter: 0.2 is +-20 % of the nominal value, (low, high) an interval in SI; others stay nominal
    seed : of the draw

    Returns `count` control.StateSpaces; the same for the same seed.

    Raises InputError for unknown parameters, ranges beyond their limits, and a count that is no whole number.

    >>> import malta
    >>> motor = malta.uncertain(lambda J: ([[-0.1 / J]], [[1 / J]], [[1]]), {"J": 2e-3})
    >>> [
    ...     f"{known.poles().real.item():.1f}"
    ...     for known in malta.proof.random_systems(motor, 3, {"J": 0.2})
    ... ]
    ['-47.4', '-55.1', '-61.2']
    """
    caller = "random_systems"
    if not isinstance(system, UncertainSystem):
        raise InputError(caller, "system", describe(system), "what malta.uncertain makes")
    if isinstance(count, bool) or not isinstance(count, int) or not 0 < count <= MOST_SYSTEMS:
        raise InputError(caller, "count", describe(count), f"a whole number from 1 to {MOST_SYSTEMS}")
    box = box_of(system.names, system.nominal, system.limits, ranges, {}, caller=caller)
    if box.most <= 1:
        raise InputError(caller, "ranges", f"a box in which {box.ends}", "ranges within the limits")
    rows = np.random.default_rng(seed).uniform(-1, 1, (count, len(system.names)))
    drawn = system.nominal + np.where(rows < 0, rows * box.down, rows * box.up)
    return [system.state_space(**dict(zip(system.names, row, strict=True))) for row in drawn.tolist()]


@dataclass(frozen=True, eq=False)
class _Connection:
    """Systems in the symbols of their common parameters."""

    p: Any
    names: tuple[str, ...]
    nominal: tuple[float, ...]
    limits: tuple[tuple[float, float], ...]
    sample_time: float | None
    approximate: str
    positive: tuple[Any, ...]
    ends: tuple[str, ...]
    parts: tuple[System, ...]

    @classmethod
    def of(cls, systems: Sequence[Any], caller: str) -> _Connection:
        """Read the systems, of which at least one is uncertain, and their parameters. Raises InputError."""
        uncertain = [one for one in systems if isinstance(one, UncertainSystem)]
        if not uncertain:
            raise InputError(caller, "systems", "no uncertain system", "at least one, of malta.uncertain")
        nominal: dict[str, float] = {}
        limits: dict[str, tuple[float, float]] = {}
        for one in uncertain:
            ends = one.limits or ((-np.inf, np.inf),) * len(one.names)
            for name, value, (above, below) in zip(one.names, one.nominal.tolist(), ends, strict=True):
                if nominal.setdefault(name, value) != value:
                    raise InputError(
                        caller, name, f"nominal values {nominal[name]:g} and {value:g}", "one value"
                    )
                low, high = limits.get(name, (-np.inf, np.inf))
                limits[name] = max(low, above), min(high, below)
        symbols = {name: ca.SX.sym(name) for name in nominal}
        times = {_sample_time(one, caller) for one in systems} - {_ANY_SAMPLE_TIME}
        if len(times) > 1:
            found = ", ".join(sorted("continuous" if T is None else f"{T:g} s" for T in times))
            raise InputError(
                caller, "sample_time", found, "one for all systems; control.c2d samples a continuous one"
            )
        return cls(
            ca.vertcat(*symbols.values()), tuple(nominal), tuple(nominal.values()), tuple(limits.values()),
            times.pop(),
            "; ".join(dict.fromkeys(one.approximate for one in uncertain if one.approximate)),
            tuple(one.positive(_own(one, symbols)) for one in uncertain if one.positive is not None),
            tuple(text for one in uncertain for text in one.ends),
            tuple(_parts(one, symbols) for one in systems),
        )  # fmt: skip

    def system(self, found: System) -> UncertainSystem:
        """The uncertain system of matrices in the common symbols; E and D only where there are any."""
        A, B, C, D = (ca.sparsify(M) for M in (found.A, found.B, found.C, found.D))
        E = None if found.E is None else ca.sparsify(found.E)
        plain_E = E is None or ca.sparsify(E - ca.SX.eye(E.shape[0])).nnz() == 0
        matrices = [A, B, C] if plain_E and not D.nnz() else [A, B, C, D] if plain_E else [A, B, C, D, E]
        positive = ca.Function("positive", [self.p], [ca.vertcat(*self.positive)]) if self.positive else None
        return UncertainSystem(
            self.names,
            readonly(np.array(self.nominal)),
            ca.Function("matrices", [self.p], matrices),
            self.limits,
            self.sample_time,
            self.approximate,
            positive,
            self.ends,
        )


_ANY_SAMPLE_TIME = -1.0  # the sample time of gains, which fit every system


def _sample_time(one: Any, caller: str) -> float | None:
    if isinstance(one, UncertainSystem):
        return one.sample_time
    if isinstance(one, Compensator):
        if one.delay or one.lag is not None:
            found = f"a Compensator with a delay of {one.delay} samples and a lag of {one.lag}"
            raise InputError(caller, "law", found, "one without, and the delay and the lag as systems")
        return one.sample_time
    if not hasattr(one, "dt"):
        return _ANY_SAMPLE_TIME
    if one.dt is True:
        raise InputError(caller, "dt", "True", "0, or a sample time in seconds")
    return float(one.dt) if one.dt else None


def _own(one: UncertainSystem, symbols: dict[str, Any]) -> Any:
    return ca.vertcat(*(symbols[name] for name in one.names))


def _parts(one: Any, symbols: dict[str, Any]) -> System:
    """The matrices of one system; those of a known one are constant."""
    if isinstance(one, UncertainSystem):
        A, B, C, *more = one.matrices.call([_own(one, symbols)])
        D = more[0] if more else ca.SX(C.shape[0], B.shape[1])
        return System(A, B, C, D, more[1] if len(more) > 1 else None)
    shape = (one.noutputs, one.ninputs) if hasattr(one, "ninputs") else np.shape(getattr(one, "D", one))
    outputs, inputs = shape if len(shape) == 2 else (1, 1)
    law = compensator_of(one, inputs, outputs)
    A, B, C, D = (ca.SX(ca.sparsify(ca.DM(M))) for M in (law.A, law.B, law.C, law.D))
    n = A.shape[0]
    return System(A, B.reshape((n, inputs)), C.reshape((outputs, n)), D)
