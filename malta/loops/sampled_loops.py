"""The loop of a machine and a controller in numbers: sampled, with its delay, current loops and late sensors.

P is the machine from forces to measurements under a zero-order hold, exactly; F is the control law from measurements
to forces (v = F y), as in the block diagram of synthesis/controller.py. At the sensors

    S = (I - P F)^-1,   T = I - S,   L = -P F.

Coil currents are commutated for the last reading and held for a sample. Where the machine moves on meanwhile, the
reading is a further input of P, and F passes it on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import casadi as ca
import numpy as np

from malta.arrays import ComplexArray, FloatArray, readonly
from malta.display import display
from malta.linear.matrices import eigenvalues, system_matrix
from malta.linear.peaks import in_plane, response_at
from malta.linear.sampling import add_lags, sample
from malta.linear.system import System
from malta.loops.classical import Nominal
from malta.loops.windings import (
    LAST_STAGE,
    Caught,
    CurrentControl,
    CurrentLoops,
    axis_map,
    chosen_loops,
    current_control,
    forecast_as_forces,
    link_at_rest,
    sample_driven,
    windings_of,
    with_estimated_emf,
    with_windings,
)
from malta.model.equilibrium import trim
from malta.model.linearize import LinearModel, linearize
from malta.model.places import off_stroke, position_at, position_in
from malta.model.plant import Plant
from malta.model.plants import plant_of
from malta.model.sensors import split_dead_time, with_lags
from malta.model.traced import trace
from malta.synthesis.controller import Controller
from malta.synthesis.law import law_at
from malta.synthesis.linear_law import LinearLaw, linear_law, with_readings, with_slope
from malta.synthesis.step_response import StepResponse, step_response

ROUNDING = 1e-9  # of the largest entry
RESONANCE_OFFSETS = np.array([-3.0, -1.0, -0.3, 0.0, 0.3, 1.0, 3.0])  # half-widths of a resonance
DELAY_POLE_SIZE = 1e-6  # |z| below which a pole is one of pure delay


@display
@dataclass(frozen=True, eq=False)
class SampledLoop:
    """Sampled machine x+ = Ad x + Bd v, y = Cd x, closed by the linear control law v = F y."""

    Ad: FloatArray
    Bd: FloatArray
    Cd: FloatArray
    control: LinearLaw
    sample_time: float  # s
    true: FloatArray | None = None  # outputs of the states, where sensors read them late; None: Cd
    continuous: FloatArray | None = None  # of the first states, between samples
    pushed: FloatArray | None = None  # what unit disturbances leave in the states in one sample, n x w
    caught: tuple[int, Caught] | None = None  # readings within a sample, and the first of their states

    @property
    def outputs(self) -> FloatArray:
        """The matrix of the true outputs, which Cd reads."""
        return self.Cd if self.true is None else self.true

    @property
    def closed(self) -> FloatArray:
        """State matrix of the closed loop, states of the machine first."""
        c = self.control
        through = self.Ad + self.Bd @ c.D_y @ self.Cd
        return np.asarray(system_matrix(through, self.Bd @ c.C, c.B_y @ self.Cd, c.A))

    def loop_gain(self, w: FloatArray) -> ComplexArray:
        """The loop gain at the sensors, L = -P F, at the frequencies w (rad/s): k x p x p."""
        s = np.expm1(1j * np.asarray(w) * self.sample_time) / self.sample_time
        P, F = (response(s) for response in self._responses)
        return np.asarray(-P @ F)

    @cached_property
    def systems(self) -> tuple[System, System]:
        """P and F in differences, (x+ - x) / T: slow poles keep their digits."""
        c, T = self.control, self.sample_time
        none = np.zeros((len(self.Cd), self.Bd.shape[1]))
        machine, law = System(self.Ad, self.Bd, self.Cd, none, dt=T), System(c.A, c.B_y, c.C, c.D_y, dt=T)
        return machine.differences, law.differences

    @cached_property
    def spectral_radius(self) -> float:
        """The largest |z| of the closed loop; stable below 1."""
        return float(np.abs(eigenvalues(self.closed)).max())

    @property
    def resonances(self) -> FloatArray:
        """Frequencies about those of the closed loop's oscillating poles, rad/s, from below their width to above."""
        z = eigenvalues(self.closed)
        poles = np.log(z[z.imag > 0]) / self.sample_time
        return np.asarray((poles.imag[:, None] + np.abs(poles.real)[:, None] * RESONANCE_OFFSETS).ravel())

    @cached_property
    def cut(self) -> Nominal:
        """The loop cut at its sensors: what peaks and crossings are read from."""
        return Nominal(*self.systems, self.spectral_radius < 1, self.sample_time)

    def __getstate__(self) -> dict[str, Any]:
        """What pickle keeps: functions of frequency are made anew."""
        return {key: value for key, value in vars(self).items() if key != "_responses"}

    @cached_property
    def _responses(self) -> tuple[Callable[[ComplexArray], ComplexArray], ...]:
        P, F = self.systems
        return P.response_function(), F.response_function()

    def sensitivity(self, w: FloatArray) -> ComplexArray:
        """The sensitivity S = (I + L)^-1 at the sensors, k x p x p; it also takes noise to the outputs."""
        return np.asarray(np.linalg.inv(np.eye(len(self.Cd)) + self.loop_gain(w)))

    def answer(self, load: int | None = None) -> StepResponse:
        """The true outputs after a unit step of each disturbance, or of one. Raises CheckError for an unstable loop."""
        assert self.pushed is not None
        k, pushed = len(self.control.A), self.pushed if load is None else self.pushed[:, [load]]
        g = np.vstack([pushed, np.zeros((k, pushed.shape[1]))])
        C = np.hstack([self.outputs, np.zeros((len(self.Cd), k))])
        return step_response(self.closed, g, C, self.sample_time)

    def under_load(self, load: FloatArray) -> System:
        """From a load that is constant throughout each sample to the true outputs; in the s of Tustin's rule."""
        assert self.pushed is not None
        k, T = len(self.control.A), self.sample_time
        push = np.concatenate([self.pushed @ load, np.zeros(k)])[:, None]
        C = np.hstack([self.outputs, np.zeros((len(self.Cd), k))])
        closed = System(self.closed, push, C, np.zeros((len(C), 1)), dt=T)
        return in_plane(closed.differences, T).balanced

    def compliance(self, w: FloatArray, load: FloatArray) -> ComplexArray:
        """True outputs per load at frequencies w, rad/s, of a load that is constant throughout each sample: k x p."""
        half = self.sample_time / 2
        return response_at(self.under_load(load), np.tan(np.asarray(w) * half) / half)[..., 0]


def sampled_loop(
    model: LinearModel,
    controller: Controller,
    *,
    delay: float = 0,
    current_loops: CurrentLoops | None = None,
    feedforward: bool = False,
    sensors: bool = False,
    forces_alone: bool = False,
) -> SampledLoop:
    """The sampled loop of a machine and a controller.

    delay : samples between measurement and force
    current_loops : "lag" or "pi" (windings.py); None: forces follow their commands at once
    feedforward : whether the slope of v0(z) acts, for models at their trim, where the slope of the loads acts
    sensors : whether the machine's sensors read late; their readings are states after the machine's
    forces_alone : whether voltages that the law forecasts are part of its forces, not outputs beside them

    The controller commutates with its own parameters, and the currents produce forces with the machine's parameters.
    """
    controller = law_at(controller, model.plant, model.operating_point.x)
    model, law = commanded_model(model, controller), linear_law(controller)
    plant, late, caught = model.plant, 0, None
    A, B, C, true = _between_samples(model, sensors=sensors)
    if sensors:
        late, rest = split_dead_time(plant.sensors.dead_time, controller.sample_time)
        caught = Caught(C, controller.sample_time - rest) if rest else None
    if feedforward:
        here = position_at(plant, model.operating_point.x)
        law = with_slope(law, feedforward_slope(plant, controller, here))
    if current_loops == "pi":
        continuous, Ad, Bd, control = _sample_windings(model, controller, delay, sensors)
        if forces_alone or not len(control.emf[0]):
            Bd, law = (
                Bd[:, : len(controller.forces)],
                forecast_as_forces(law, control, controller.sample_time),
            )
        else:
            law = with_estimated_emf(law, control.emf)
    else:
        continuous = A
        if current_loops == "lag" and math.isfinite(plant.actuator.crossover):
            A, B = add_lags(A, B, plant.actuator.crossover)
        Ts = controller.sample_time
        Ad, Bd = sample(A, B, Ts, delay) if caught is None else caught.add_to((A, B), Ts, delay)
    Cd, true = pad(C, len(Ad)), None if true is None else pad(true, len(Ad))
    first = len(Ad) - len(C) - (len(controller.forces) if current_loops == "pi" else 0)
    if caught is not None:
        Cd = np.eye(len(Ad))[first : first + len(C)]
    if late:
        Ad, Bd, Cd = stored_readings(Ad, Bd, Cd, late)
        true = None if true is None else pad(true, len(Ad))
    if model.E.any():
        law = with_readings(law)
    at = None if caught is None else (first, caught._replace(C=pad(C, len(continuous))))
    return SampledLoop(Ad, Bd, Cd, law, controller.sample_time, true, continuous, caught=at)


def _between_samples(
    model: LinearModel, *, sensors: bool
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray | None]:
    """A, B with the readings on which held currents hang, C, and C of the true outputs where lags of sensors count."""
    A, B, C, lags = model.A, model.B, model.C, model.plant.sensors
    if model.E.any():
        A, B = A - model.E @ C, np.hstack([B, model.E])
    if not sensors or not lags.late:
        return A, B, C, None
    A, B, read = (np.array(ca.DM(M)) for M in with_lags(lags, A, B, C))
    return A, B, read, C


@lru_cache(maxsize=4)  # a loop has it twice, with and without forecast voltages; records compare by identity
def _sample_windings(
    model: LinearModel, controller: Controller, delay: float, sensors: bool, within: float = 0.0
) -> tuple[FloatArray, FloatArray, FloatArray, CurrentControl]:
    """The machine with its windings between samples; sampled behind its current controllers; and these.

    within : s, time of a sample at which the states of the design model are caught; 0: what sensors catch

    Under load the link's voltage is a state. The voltages that the law forecasts, M^+ emf(x_hat), are inputs of the
    sampled machine after its forces.
    """
    plant, point, m, Ts = model.plant, model.operating_point, len(controller.forces), controller.sample_time
    believed = plant_of(controller.parameters)
    windings = windings_of(plant, believed, point, np.eye(m))
    control = current_control(controller, windings, point)
    *abc, _ = _between_samples(model, sensors=sensors)
    A, B, C = (np.array(ca.DM(M)) for M in with_windings(plant, windings, point.x, *abc))
    phi, share = C[-m:], None
    link = link_at_rest(plant, windings, point, axis_map(believed, point)) if point.loaded else None
    if link is not None:
        A = system_matrix(A, B @ link.share[:, None], (link.by_phi @ phi)[None], np.array([[link.rate]]))
        B, phi, share = np.vstack([B, link.by_w[None]]), pad(phi, len(A)), link.share
    rest = split_dead_time(plant.sensors.dead_time, Ts)[1] if sensors else 0.0
    caught = Caught(pad(C[:-m], len(A)), Ts - rest) if rest else None
    if within:
        caught = Caught(np.eye(len(model.A), len(A)), within)
    Ad, Bd = sample_driven((A, B, phi), control.loop, windings.R, Ts, delay, share, caught)
    return readonly(A), readonly(Ad), readonly(Bd), control


def states_within(
    model: LinearModel, controller: Controller, loop: SampledLoop, current_loops: CurrentLoops, time: float
) -> FloatArray:
    """The states of the design model at a time within a sample, s, of those of `loop.closed` at its beginning.

    model, controller, current_loops : of which the loop is `machine_loop`
    """
    n, plant, Ts = len(model.A), model.plant, loop.sample_time
    if time == 0:
        return np.eye(n, len(loop.closed))
    delay, known = plant.actuator.delay(Ts), 0 if loop.caught is None else len(loop.caught[1].C)
    model = commanded_model(model, controller)
    if chosen_loops(plant, controller, current_loops) == "pi":
        _, Ad, Bd, _ = _sample_windings(model, controller, delay, sensors=True, within=time)
        after = len(Ad) - n - len(controller.forces)
    else:
        A, B, _, _ = _between_samples(model, sensors=True)
        if math.isfinite(plant.actuator.crossover):
            A, B = add_lags(A, B, plant.actuator.crossover)
        Ad, Bd = Caught(np.eye(n, len(A)), time).add_to((A, B), Ts, delay)
        after = len(Ad) - n
    rows, into = Ad[after : after + n], Bd[after : after + n, : loop.Bd.shape[1]]
    rows = np.hstack([rows[:, :after], np.zeros((n, known)), rows[:, after + n :]])
    rows, law = pad(rows, len(loop.Ad)), loop.control
    return np.hstack([rows + into @ law.D_y @ loop.Cd, into @ law.C])


def stored_readings(
    A: FloatArray, B: FloatArray, C: FloatArray, late: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The sampled machine whose outputs are read `late` samples old: stored readings follow its states."""
    n, p = len(A), len(C)
    whole = np.zeros((n + p * late,) * 2)
    whole[:n, :n], whole[n : n + p, :n] = A, C
    whole[n:, n:] = np.eye(p * late, k=-p)
    return whole, np.vstack([B, np.zeros((p * late, B.shape[1]))]), np.eye(len(whole))[-p:]


def pad(C: FloatArray, n: int) -> FloatArray:
    """C of the first states as a matrix of all n."""
    return np.hstack([C, np.zeros((len(C), n - C.shape[1]))])


def machine_loop(
    model: LinearModel,
    controller: Controller,
    current_loops: CurrentLoops = LAST_STAGE,
    *,
    forces_alone: bool = False,
) -> SampledLoop:
    """The loop as the machine runs it: hold, delay, current loops, late sensors, loads against v0(z) at the trim.

    current_loops : "pi", the controllers of the gain file on the windings, where a machine has some; or "lag"
    forces_alone : see `sampled_loop`

    Raises CheckError when no input holds the machine at the model's operating point.
    """
    plant = model.plant
    x = model.operating_point.x
    loaded = loaded_model(plant, position_in(plant, x), tuple(off_stroke(plant, x).items()))
    chosen = chosen_loops(plant, controller, current_loops)
    delay = plant.actuator.delay(controller.sample_time)
    return sampled_loop(
        loaded, controller,
        delay=delay, current_loops=chosen, feedforward=True, sensors=True, forces_alone=forces_alone,
    )  # fmt: skip


@lru_cache(maxsize=16)  # every controller of a machine has it; models compare by identity
def disturbance_map(model: LinearModel) -> FloatArray:
    """B_w of xi' = A xi + B v + B_w w: n states of the design model x disturbances."""
    plant, point = model.plant, model.operating_point
    (found,) = trace(_disturbances, plant, None, point.loaded)(point.x, point.u)
    return readonly(found[list(plant.controlled)])


def _disturbances(plant: Plant, _believed: None, loaded: bool) -> tuple[list[Any], list[Any]]:
    """(x, u) -> the slope of the rates by disturbances, under the loads or without them."""
    kind = ca.MX if plant.actuator.tabulated else ca.SX
    sizes = {"x": len(plant.states), "u": len(plant.inputs), "w": len(plant.disturbances)}
    x, u, w = (kind.sym(name, size) for name, size in sizes.items())
    slope = ca.densify(ca.jacobian(plant.f(x, u, w + plant.load(x) if loaded else w), w))
    return [x, u], [ca.substitute([slope], [w], [kind.zeros(w.numel())])[0]]


def push_through(
    A: FloatArray, B_w: FloatArray, Ts: float, size: int, caught: tuple[int, Caught] | None = None
) -> FloatArray:
    """What x' = A x + B_w w leaves in `size` states in one sample; states behind those of B_w take nothing from w.

    caught : readings within the sample, and the first of their states
    """
    B_w = np.vstack([B_w, np.zeros((len(A) - len(B_w), B_w.shape[1]))])
    _, pushed = sample(A, B_w, Ts)
    whole = np.vstack([pushed, np.zeros((size - len(pushed), B_w.shape[1]))])
    if caught is not None:
        first, (C, time) = caught
        whole[first : first + len(C)] = C @ sample(A, B_w, time)[1]
    return whole


@lru_cache(maxsize=8)  # every stage needs it; records compare by identity, so no entry is stale
def commanded_model(model: LinearModel, controller: Controller) -> LinearModel:
    """The model with the forces as inputs that the controller commands with its own parameters."""
    believed = plant_of(controller.parameters)
    if believed is model.plant:
        return model
    return linearize(model.plant, model.operating_point, believed)


@lru_cache(maxsize=16)  # every loop of a machine needs it; plants compare by identity
def loaded_model(plant: Plant, position: float, others: tuple[tuple[str, float], ...] = ()) -> LinearModel:
    """The machine at rest under its loads at a position of the stroke, m; 0 for a machine without a stroke.

    others : further states that are not zero

    Raises CheckError when no input holds the machine there.
    """
    along = {plant.stroke.name: position} if plant.has_stroke else {}
    return linearize(plant, trim(plant, **along, **dict(others)))


def loaded_loop(
    plant: Plant, controller: Controller, at: Mapping[str, float], current_loops: CurrentLoops = LAST_STAGE
) -> Nominal:
    """The responses of `machine_loop` at the states `at` (SI), from forces to sensors and back.

    Currents that are held hang on the reading: as far as forces make the same, H y is part of the law's forces.

    Raises CheckError when no input holds the machine there.
    """
    others = tuple((name, x) for name, x in at.items() if name != plant.stroke.name)
    model = loaded_model(plant, at.get(plant.stroke.name, 0.0), others)
    loop = machine_loop(model, controller, current_loops, forces_alone=True)
    m, B, law = len(controller.forces), loop.Bd, loop.control
    into, rest = B[:, :m], B[:, m:]
    H = np.linalg.lstsq(into, rest, rcond=None)[0]
    left = rest - into @ H
    law = law._replace(
        C=law.C + _on_top(H @ law.C[m:], law.C), D_y=law.D_y + _on_top(H @ law.D_y[m:], law.D_y)
    )
    if np.abs(left).max(initial=0.0) <= ROUNDING * np.abs(rest).max(initial=0.0):
        B, law = into, law._replace(C=law.C[:m], D_y=law.D_y[:m])
    else:
        B = np.hstack([into, left])
    P, F = SampledLoop(loop.Ad, B, loop.Cd, law, loop.sample_time).systems
    return Nominal(P, F, loop.spectral_radius < 1, loop.sample_time, m)


def _on_top(rows: FloatArray, of: FloatArray) -> FloatArray:
    """These rows over zeros, in the shape of another matrix."""
    return np.vstack([rows, np.zeros((len(of) - len(rows), of.shape[1]))])


def feedforward_slope(plant: Plant, controller: Controller, at: Mapping[str, float]) -> FloatArray:
    """dv0/dy at the states `at`, m x p: v0(z) follows the reading of the stroke."""
    slope = np.zeros((len(controller.forces), len(plant.outputs)))
    if plant.has_stroke:
        position = at.get(plant.stroke.name, 0.0)
        slope[:, plant.stroke_output] = controller.feedforward.slope(position)
    return slope


def continuous_poles(sampled: ComplexArray, Ts: float) -> ComplexArray:
    """Poles in rad/s of a sampled system, ln(lambda) / Ts, in order; poles of pure delay are left out."""
    return sorted_poles(np.asarray(np.log(sampled[np.abs(sampled) > DELAY_POLE_SIZE].astype(complex)) / Ts))


def sorted_poles(poles: ComplexArray) -> ComplexArray:
    """The same poles in order of their real parts, then of their imaginary ones; read-only."""
    poles = np.asarray(poles, dtype=complex)
    order = np.lexsort((poles.imag.round(6), poles.real.round(6)))
    frozen: ComplexArray = poles[order]
    frozen.flags.writeable = False
    return frozen
