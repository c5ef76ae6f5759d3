"""Any linear loop as matrices: a machine and its controller, two systems of python-control, or a loop gain alone.

       r                    w
       |                    |
    [ law F ] --+-- v --> [ plant P ] --+--> y           v = F y + R r,   y = P v + P_w w
       ^                                |
       +--------------------------------+                negative feedback is inside F: L = -P F

Sampled systems are in differences, (x+ - x) / T = A x + B u: slow poles lie close to 1, where the A of x+ = A x has
lost their digits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from scipy import linalg

from malta.arrays import ComplexArray, FloatArray
from malta.display import Description, display, quantity
from malta.errors import CheckError, InputError
from malta.linear.conversion import from_control
from malta.linear.interconnection import append, connect, gain
from malta.linear.matrices import balanced_units, eigenvalues, system_matrix
from malta.linear.system import System
from malta.loops.classical import Nominal
from malta.loops.loop import Loop, loop_along, loop_from
from malta.model.plant import Plant, Signal
from malta.processes import on_one_thread
from malta.synthesis.controller import Controller
from malta.synthesis.law_system import reference_names, set_point
from malta.synthesis.linear_law import LinearLaw, linear_law

# The loop of a machine and a controller as systems of python-control: to plot, to simulate, to compute with.
#
#        v  +-----+        +-----+  y             at the sensors   L = -P F,  S = (I + L)^-1,  T = I - S
#     +--o->|  P  |------->|  F  |--+             at the forces    L = -F P,  likewise
#     |     +-----+        +-----+  |
#     +-----------------------------+
#
# P is the machine as it runs, sampled: hold, delay, current loops, the loads against v0(z). F is the law, with
# negative feedback inside. They are those of `malta.loop`.


@display
@dataclass(frozen=True, eq=False)
class LoopSystems:
    """The systems of a machine's sampled loop, discrete control.StateSpace with the names of the machine's signals.

    Negative feedback stands in F. Gains are in SI.

    P : from forces to outputs: hold, delay, current loops and the loads against v0(z)
    F : from measurements to forces, the control law
    L : loop gain at the sensors, -P F
    S : sensitivity at the sensors, (I + L)^-1
    T : complementary sensitivity at the sensors, I - S
    L_forces : loop gain at the forces, -F P
    S_forces : sensitivity at the forces
    T_forces : complementary sensitivity at the forces
    tracking : from references at rest, as "z_ref", to outputs
    plant : the machine
    controller : its controller

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> loop = malta.loops.loop_systems(malta.plant_of(controller.parameters), controller)
    >>> loop.F.input_labels, loop.F.output_labels[:2], loop.S.dt
    (['x1', 'y1', 'x2', 'y2', 'z'], ['fx_B1', 'fy_B1'], 5e-05)
    """

    P: Any
    F: Any
    L: Any
    S: Any
    T: Any
    L_forces: Any
    S_forces: Any
    T_forces: Any
    tracking: Any
    plant: Plant
    controller: Controller

    @property
    def description(self) -> Description:
        """The size of each system."""
        systems = ((name, getattr(self, name)) for name in self.__dataclass_fields__)
        rows = tuple(
            (name, f"{s.ninputs} inputs, {s.noutputs} outputs, {s.nstates} states")
            for name, s in systems
            if name not in ("plant", "controller")
        )
        title = f"LoopSystems of {self.controller.name!r} on {self.plant.name!r}"
        return Description(f"{title}, every {quantity(self.controller.sample_time, 's')}", rows)


@on_one_thread
def loop_systems(plant: Plant | Loop, controller: Controller | None = None) -> LoopSystems:
    """Make python-control systems of a machine's loop; of a plant and a controller at the controller's operating point.

    Currents that are held between samples depend on the last reading, too. At the sensors this is part of F, and broken
    with it. P, F and what is taken at the forces have it in the machine.

    plant : the machine, or its Loop at any operating point
    controller : of the plant; None: the Loop has it

    Returns a LoopSystems, for control.bode_plot and its like.

    Raises CheckError where no input holds the machine at the operating point.

    >>> import malta
    >>> import numpy as np
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> loop = malta.loops.loop_systems(spec.plant, controller)
    >>> w = np.logspace(0, 4, 200)  # rad/s
    >>> f"largest |S| {loop.S.frequency_response(w).magnitude.max():.2f}"
    'largest |S| 1.57'
    """
    whole = loop_from(plant, controller)
    plant, controller, loop = whole.plant, whole.controller, whole.sampled_forces
    law, m = loop.control, len(controller.forces)
    k, p = len(law.A), len(loop.Cd)
    Cd, B1 = loop.Cd, loop.Bd[:, :m]
    Ad = loop.Ad + (loop.Bd[:, m:] @ Cd if loop.Bd.shape[1] > m else 0)  # with what hangs on the reading
    C1, D1, R = law.C[:m], law.D_y[:m], set_point(controller)
    read = np.vstack([loop.Bd @ law.D_y, law.B_y])  # of an error of the reading
    pushed = np.vstack([B1, np.zeros((k, m))])
    sent = np.vstack([B1 @ law.D_r[:m] @ R, law.B_r @ R])
    y, v = np.hstack([Cd, np.zeros((p, k))]), np.hstack([D1 @ Cd, C1])
    cut_at_sensors = system_matrix(loop.Ad, loop.Bd @ law.C, None, law.A)
    cut_at_forces = system_matrix(Ad, None, law.B_y @ Cd, law.A)
    forces, outputs = (tuple(s.name for s in signals) for signals in (plant.inputs, plant.outputs))
    references, one_p, one_m = tuple(reference_names(controller)), np.eye(p), np.eye(m)

    def system(name: str, inputs: Names, outputs: Names, A: Any, B: Any, C: Any, D: Any = 0) -> Any:
        through = np.zeros((len(C), B.shape[1])) + D
        made = System(A, B, C, through, None, controller.sample_time, (), inputs, outputs)
        return made.balanced.to_control(name)

    return LoopSystems(
        P=system("P", forces, outputs, Ad, B1, Cd),
        F=system("F", outputs, forces, law.A, law.B_y, C1, D1),
        L=system("L", outputs, outputs, cut_at_sensors, read, -y),
        S=system("S", outputs, outputs, loop.closed, read, y, one_p),
        T=system("T", outputs, outputs, loop.closed, read, -y),
        L_forces=system("L_forces", forces, forces, cut_at_forces, pushed, -v),
        S_forces=system("S_forces", forces, forces, loop.closed, pushed, v, one_m),
        T_forces=system("T_forces", forces, forces, loop.closed, pushed, -v),
        tracking=system("tracking", references, outputs, loop.closed, sent, y),
        plant=plant,
        controller=controller,
    )


CALLER = "loop"
Place = Literal["sensors", "forces"]
Names = tuple[str, ...]
DELAY_POLE_SIZE = 1e-6  # |z| of the poles of pure delay
NO_GROWTH = 1e-6  # of a pole's frequency: growth that counts as none
ROUNDING = 1e-14  # of a matrix whose eigenvalues are taken


@dataclass(frozen=True, eq=False)
class LinearLoop:
    """A plant y = P (v, r) + P_w w and its law (v, r) = F y: m inputs v, and readings r that held currents hang on.

    What curves, steps and loci of any loop are computed from. That of a machine is derived from its Loop, in
    differences; systems of python-control have no machine, and so no Loop.

    plant : inputs v, r, w (m, some or none, d); outputs y, then the true outputs where sensors read late
    law : inputs y; outputs v and r
    command : what a unit reference adds, one column each: in the law's states, and in v and r
    """

    name: str
    plant: System
    law: System
    command: tuple[FloatArray, FloatArray]
    sample_time: float | None  # s; None: continuous
    outputs: tuple[Signal, ...]
    inputs: tuple[Signal, ...]
    loads: tuple[Signal, ...]
    cancelled: tuple[float, ...] = ()  # rad/s, poles of the law that its zeros cancel: of forecast voltages

    def frequencies(self, w: FloatArray) -> ComplexArray:
        """The complex frequencies of the systems at w, rad/s: jw, or (z - 1) / T."""
        T, s = self.sample_time, 1j * np.asarray(w, dtype=float)
        return np.asarray(s if T is None else np.expm1(s * T) / T)

    def closed_loop(self, factors: FloatArray | None = None, at: Place = "forces") -> System:
        """The closed loop from references and loads to the true outputs.

        factors : of the loop gain, one for each channel at the sensors or at the forces; 0 opens a channel

        Raises CheckError for a loop without a solution, 1 + L = 0 at infinite frequency.
        """
        (F_A, F_B, F_C, F_D), (R_s, R_v), p = self.law, self.command, len(self.outputs)
        if factors is not None and at == "sensors":
            F_B, F_D = F_B * factors, F_D * factors
        elif factors is not None:
            rows = np.append(factors, np.ones(len(F_C) - len(factors)))[:, None]
            F_C, F_D = rows * F_C, rows * F_D
        law = System(F_A, np.hstack([F_B, R_s]), F_C, np.hstack([F_D, R_v]))
        (out, into), u = self.plant.D.shape, len(F_C)
        M = np.zeros((into + p + R_v.shape[1], out + u))  # of v, w, y, r by the outputs and v
        M[:u, out:], M[into : into + p, :p] = np.eye(u), np.eye(p)
        outside = [*range(into + p, len(M)), *range(u, into)]
        try:
            both = append(self.plant, law)
            return connect(both, M, np.eye(len(M))[:, outside], np.eye(out, out + u)[-p:])
        except InputError as error:
            raise CheckError(f"{self.name}: 1 + L is singular at infinite frequency") from error

    def poles_of(self, A: FloatArray) -> ComplexArray:
        """Eigenvalues in rad/s; of sampled systems ln(z) / T, without the poles of pure delay."""
        found, T = eigenvalues(A) if len(A) else np.zeros(0, dtype=complex), self.sample_time
        if T is None:
            return found
        z = 1 + T * found
        found = found[np.abs(z) > DELAY_POLE_SIZE]
        return np.asarray(np.log1p(T * found) / T)

    def __getstate__(self) -> dict[str, Any]:
        """What pickle keeps: functions of frequency are made anew."""
        return {key: value for key, value in vars(self).items() if key != "responses"}

    @cached_property
    def responses(self) -> tuple[Callable[[ComplexArray], ComplexArray], ...]:
        """The functions of frequency of the plant and of the law, see `System.response`."""
        return self.plant.response_function(), self.law.response_function()

    @cached_property
    def cut(self) -> Nominal:
        """The loop cut at its sensors and at its forces: what margins are read from."""
        (A, B, C, D), p, u = self.plant, len(self.outputs), len(self.law.C)
        return Nominal(
            System(A, B[:, :u], C[:p], D[:p, :u]), self.law, self.stable, self.sample_time, len(self.inputs)
        )

    def unstable_poles(self, factors: FloatArray, at: Place) -> int:
        """How many poles grow with these factors of the loop gain.

        A pole grows where its growth exceeds what rounding may have made of it, eps |A| times the condition of the
        eigenvalue, and a millionth of its frequency. Integrators, which scatter about zero when several are in
        series, and undamped oscillators count as stable.
        """
        system, T = self.closed_loop(factors, at), self.sample_time
        A = system.A
        found = eigenvalues(A) if len(A) else np.zeros(0, dtype=complex)
        if not (self._growth(found) > 0).any():
            return 0
        t = balanced_units(A, system.B, system.C)
        A = A * t / t[:, None]
        vectors: Any = linalg.eig(A, left=True, right=True)
        found, left, right = vectors
        overlap = np.abs(np.einsum("ij,ij->j", left.conj(), right))  # of unit vectors: 1 / condition
        size = float(np.linalg.norm(A, 2)) + (0.0 if T is None else 1 / T)
        growth = self._growth(found)
        return int(((growth * overlap > ROUNDING * size) & (growth > NO_GROWTH * np.abs(found))).sum())

    def _growth(self, poles: ComplexArray) -> FloatArray:
        """Re of poles; of eigenvalues in differences (|z|^2 - 1) / 2 T."""
        T = self.sample_time or 0.0
        return np.asarray(poles.real + 0.5 * T * np.abs(poles) ** 2)

    def closed_eigenvalues(self) -> ComplexArray:
        """The eigenvalues of the closed loop, without those that the law cancels in itself."""
        found, T = eigenvalues(self.closed_loop().A), self.sample_time
        for pole in self.cancelled:
            found = np.delete(found, np.abs(found - (pole if T is None else np.expm1(pole * T) / T)).argmin())
        return found

    @cached_property
    def closed_poles(self) -> ComplexArray:
        """The poles of the closed loop, rad/s, without those that the law cancels in itself."""
        found = self.poles_of(self.closed_loop().A)
        for pole in self.cancelled:
            found = np.delete(found, np.abs(found - pole).argmin())
        return found

    @cached_property
    def stable(self) -> bool:
        """Whether all poles of the closed loop decay."""
        return bool((self.closed_poles.real < 0).all())


def linear_loop(
    source: Any, controller: Any = None, *, name: str = "", position: float | None = None
) -> LinearLoop:
    """The matrices of a loop.

    source, controller : a plant and its Controller; a Loop; LoopSystems; two systems of python-control, plant and
        controller of the errors (L = P C, negative feedback); or one, the loop gain L. A pair may be one tuple
    name : of the loop; "": that of the controller or of the system
    position : of the stroke, m, of a plant; None: the controller's operating point

    Raises InputError for anything else, and CheckError as `loop_systems`.

    >>> import control
    >>> linear_loop(control.tf([2], [1, 1])).closed_poles.real.round(6).tolist()
    [-3.0]
    """
    if controller is None and isinstance(source, tuple) and len(source) == 2:
        source, controller = source
    if isinstance(source, LinearLoop):
        return source
    if isinstance(source, Plant) and isinstance(controller, Controller):
        source, controller = loop_along(source, controller, position), None
    if isinstance(source, Loop) and controller is None and position is None:
        return _of_machine(source, name or source.controller.name)
    if isinstance(source, LoopSystems) and controller is None:
        return linear_loop(source.plant, source.controller, name=name)
    if _is_system(source) and (controller is None or _is_system(controller)):
        return _of_systems(source, controller, name)
    found = " and ".join(type(one).__name__ for one in (source, controller) if one is not None)
    raise InputError(
        CALLER, "", f"a {found}", "a loop, a plant and its controller, or control systems: L, or P and C"
    )


def _of_machine(whole: Loop, name: str) -> LinearLoop:
    loop, plant, controller = whole.sampled_forces, whole.plant, whole.controller
    law, T = loop.control, loop.sample_time
    assert loop.pushed is not None
    driven, command = _commanded_system(controller, law)
    outputs = loop.Cd if loop.true is None else np.vstack([loop.Cd, loop.true])
    into = np.hstack([loop.Bd, loop.pushed]) / T
    return LinearLoop(
        name,
        System((loop.Ad - np.eye(len(loop.Ad))) / T, into, outputs, np.zeros((len(outputs), into.shape[1]))),
        driven,
        command,
        T,
        plant.outputs,
        plant.inputs,
        plant.disturbances,
        cancelled=tuple((np.log(np.diag(law.A)[len(linear_law(controller).A) :]) / T).tolist()),
    )


def _commanded_system(c: Controller, law: LinearLaw) -> tuple[System, tuple[FloatArray, FloatArray]]:
    """The law from readings, and what a unit reference adds to its states and to its outputs.

    The reference of a stored force is as old as the force: the law gets the references of the last samples as states
    where that matters. No reading reaches them, so that the loop stays the same.
    """
    T, R, p, m = c.sample_time, set_point(c), len(c.measurements), len(c.forces)
    A, B_y, C = (law.A - np.eye(len(law.A))) / T, law.B_y / T, law.C
    first = p + len(c.A) + m * c.lagging  # of the stored forces in r, the oldest first
    stored = R[first : first + m * c.stored].copy()
    if not stored.any():
        return System(A, B_y, C, law.D_y), (law.B_r @ R / T, law.D_r @ R)
    R[first : first + m * c.stored] = 0
    rows = np.arange(m * c.stored).reshape(c.stored, m)[::-1]  # of the newest, one sample old, first
    of_stored = slice(first, first + m * c.stored)
    B_old = np.hstack([law.B_r[:, of_stored][:, r] @ stored[r] for r in rows]) / T
    D_old = np.hstack([law.D_r[:, of_stored][:, r] @ stored[r] for r in rows])
    size = p * c.stored
    shift = (np.eye(size, k=-p) - np.eye(size)) / T
    whole = system_matrix(A, B_old, None, shift)
    newest = np.vstack([np.eye(p), np.zeros((size - p, p))]) / T
    driven = System(whole, np.vstack([B_y, np.zeros((size, p))]), np.hstack([C, D_old]), law.D_y)
    return driven, (np.vstack([law.B_r @ R / T, newest]), law.D_r @ R)


def _is_system(source: Any) -> bool:
    """Whether this is a linear system: a record, or of python-control."""
    return isinstance(source, System) or all(
        hasattr(source, key) for key in ("ninputs", "noutputs", "dt", "input_labels", "poles")
    )


def _of_systems(plant: Any, controller: Any, name: str) -> LinearLoop:
    """A loop of systems, of python-control or records: P and C of the errors, or L alone."""
    given = [one for one in (plant, controller) if one is not None]
    known = [dt for dt in map(_time_of, given) if dt is not None]
    dt = known[0] if known else 0
    if any(other != dt for other in known):
        raise InputError(CALLER, "dt", " and ".join(map(str, known)), "the same of plant and controller")
    T = (1.0 if dt is True else float(dt)) or None
    names = [
        getattr(one, "name", kind)
        for one, kind in zip(given, ("P" if controller else "L", "C"), strict=False)
    ]
    P, *C = (
        from_control(one, CALLER, own, step=T, differences=True)
        for one, own in zip(given, names, strict=True)
    )
    p, m = P.D.shape
    F = System(C[0].A, -C[0].B, C[0].C, -C[0].D) if C else gain(-np.eye(p))
    if F.D.shape != (m, p):
        who, (rows, columns) = ("C", F.D.shape) if C else ("L", P.D.shape)
        wanted = f"{p} inputs and {m} outputs" if C else "as many of both"
        raise InputError(CALLER, who, f"{columns} inputs and {rows} outputs", wanted)
    outputs, inputs = (
        tuple(Signal(label, "1") for label in labels or [f"{letter}[{i}]" for i in range(size)])
        for labels, letter, size in ((P.outputs, "y", p), (P.inputs, "u", m))
    )
    loads = inputs if C else ()
    driven = System(P.A, np.hstack([P.B, P.B[:, : len(loads)]]), P.C, np.hstack([P.D, P.D[:, : len(loads)]]))
    return LinearLoop(name or names[-1], driven, F, (-F.B, -F.D), T, outputs, inputs, loads)


def _time_of(system: Any) -> Any:
    """The sample time; 0 continuous, None of gains and of what fits any."""
    return (system.dt or 0) if isinstance(system, System) and len(system.A) else system.dt
