"""The response of a machine from measured currents to measured outputs, in parameters by name.

Between samples a current goes exponentially from one measured value to the next: with the rate R / L of windings whose
voltages are held; of a machine without a model of its windings with that of its current loops, or it is held. Then
delay, current loops and law drop out, whatever they are, and what is left is the machine

    x' = f(x, forces(i), load(x)),   y = h(x)       linearized where the log was made, with the mean current there
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from scipy.linalg import expm

from malta.arrays import ComplexArray, FloatArray
from malta.errors import InputError
from malta.identification.imperfections import Imperfection, disturb, skews
from malta.model.parameters import symbolic_names, twins_of
from malta.model.plant import Plant, symbolic
from malta.model.plants import plant_of
from malta.model.sensors import with_lags
from malta.simulation.engine.engines import evaluate

STEP = 1e-5  # of a scale: for derivatives by differences
MIN_VARIANCE_SHARE = 0.01  # of the variance of all currents: a direction with less of it is left out
MAX_EIGENVECTOR_CONDITION = 1e3  # condition number of eigenvectors, which are too much alike above it
SCALES = {"1": 0.1, "m": 1e-3, "rad": 0.1, "s": 1e-4}  # of a parameter whose value is 0, SI


@dataclass(frozen=True, eq=False)
class ResponseModel:
    """A machine at a place, from some of its measured currents to its outputs, in parameters by name.

    plant : the machine, with the values from which the parameters start
    names : of the parameters: those of the machine's record, or errors of its sensors
    currents : names of the measured currents
    y : mean outputs, SI
    i : mean currents, A
    sample_time : s
    around : points x currents, A: where the machine is linearized beside the mean, so that the mean of A and B is that
        over the noise which the law makes of the sensors'; a point at 0 of one that is quiet
    bench : imperfections of the bench, whose values follow the parameters' in theta
    """

    plant: Plant
    names: tuple[str, ...]
    currents: tuple[str, ...]
    y: FloatArray
    i: FloatArray
    sample_time: float
    around: FloatArray = field(default_factory=lambda: np.zeros((1, 1)))
    bench: tuple[Imperfection, ...] = ()

    @cached_property
    def start(self) -> FloatArray:
        """The parameters' values in the machine's record, SI; errors of the sensors are 0."""
        return np.array([float(getattr(self.plant.parameters, name, 0.0)) for name in self.names])

    @cached_property
    def scale(self) -> FloatArray:
        """The size of a parameter, in which its accuracy is counted: its value, or a unit's where that is 0."""
        units = units_of_model(self.plant)
        sizes = [abs(v) or SCALES.get(units[n], 1.0) for n, v in zip(self.names, self.start, strict=True)]
        return np.array(sizes)

    def response(self, theta: FloatArray, w: FloatArray) -> ComplexArray:
        """G from the sampled currents to the sampled outputs, k x p x currents.

        theta : parameters, SI
        w : k frequencies, rad/s
        """
        return self.responses(theta, w)[0]

    def responses(self, theta: FloatArray, w: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """The same G, and what a unit of each state leaves that a record has more at its end than at its begin.

        The second one is k x p x states: over a record of N samples the coefficients of outputs and currents obey
        Y = G I + T (x_0 - x_N) / N with the states x_0 and x_N at both ends.
        """
        A, B, C, late = self.matrices(theta)
        m, Ts, z = B.shape[1], self.sample_time, np.exp(1j * np.asarray(w) * self.sample_time)
        lags = np.array(self._lags(theta[: len(self.names)])).ravel()
        older = skews(self.bench, theta[len(self.names) :], len(C))
        Phi, forced = _step(A, B, self._flow, Ts)
        samples = int(late.item() // Ts)
        read, direct = C, np.zeros((len(C), forced.shape[1]))
        if late.item() > 0:  # of a state within the sample before: with the hold, not as between samples
            part, acting = _step(A, B, self._flow, (samples + 1) * Ts - late.item())
            read, direct, samples = C @ part, C @ acting, samples + 1
        blocks = transfer(Phi, read, np.hstack([forced, np.eye(len(A))]), z)
        blocks[:, :, : forced.shape[1]] += direct
        z = z[:, None, None]
        found = np.concatenate([blocks[:, :, :m], z * blocks[:, :, forced.shape[1] :]], axis=2)
        if forced.shape[1] > m:
            found[:, :, :m] += z * blocks[:, :, m : 2 * m]
        found *= z**-samples
        # A lag or a skew that is estimated, small beside a sample or of either sign, acts on readings that are smooth.
        if lags.any() or older.any():
            s = 1j * np.asarray(w)[:, None]
            found *= (np.exp(-s * older) / (1 + s * lags))[:, :, None]
        return found[:, :, :m], found[:, :, m:]

    def slopes(self, theta: FloatArray, w: FloatArray) -> ComplexArray:
        """dG per parameter in units of its scale, parameters x k x p x currents, by central differences."""
        steps = STEP * np.diag(self.scale)
        return np.array(
            [(self.response(theta + h, w) - self.response(theta - h, w)) / (2 * STEP) for h in steps]
        )

    @cached_property
    def _flow(self) -> Flow:
        """How its currents go from sample to sample."""
        return flow_of(self.plant, self.sample_time)

    @cached_property
    def _equations(self) -> tuple[Any, Any, Any, Any, Any, Any]:
        """Symbols of parameters, all states and all currents; x', the readings, and the dead time of these, s."""
        plant, par = self.plant, self.plant.parameters
        theta = ca.SX.sym("theta", len(self.names))
        symbols = {name: theta[k] for k, name in enumerate(self.names)}
        of_machine = {name: symbols[name] for name in self.names if name in symbolic_names(par)}
        twins = {
            n: symbols[twin] for n, twin in twins_of(par).items() if twin in symbols and n not in symbols
        }
        machine = plant.variant(symbolic(par, of_machine | twins))
        errors = ca.vertcat(*(symbols.get(s.name, 0) for s in plant.sensors.errors))
        x, i = ca.SX.sym("x", len(plant.states)), ca.SX.sym("i", len(axes_of(plant)))
        forces = machine.actuator.forces(x, i) if plant.actuator.windings is None else machine.drive.force(i)
        rate, read = machine.f(x, forces, machine.load(x)), machine.sensors.sense(x, errors)
        return theta, x, i, rate, read, machine.sensors

    def matrices(
        self, theta: FloatArray, around: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """A, B and C of the states of the design model and of lagging readings, and the dead time of readings, s.

        theta : parameters, SI
        around : points beside the mean currents, over which they are means; None: the model's own
        """
        points = self.around if around is None else around
        n = len(self.names)
        found = self._matrices.map(len(points))(theta[:n], (self.i + points).T)
        A, B, C, late = (np.array(M).reshape(M.shape[0], len(points), -1).mean(axis=1) for M in found)
        if self.bench:
            A, B, C = disturb(self.plant, self.bench, theta[n:], A, B, C)
        return A, B, C, late

    def linear(self, theta: FloatArray) -> tuple[FloatArray, ...]:
        """`matrices`, and the lags of the outputs that are parameters, s."""
        return *self.matrices(theta), np.array(self._lags(theta[: len(self.names)]))

    @cached_property
    def _lags(self) -> ca.Function:
        """Parameters -> lags of the outputs that are parameters, s; 0 of others, which are states."""
        theta, *_, sensors = self._equations
        lags = [lag if isinstance(lag, ca.SX) else 0.0 for lag in sensors.lag]
        return ca.Function("lags", [theta], [ca.densify(ca.vertcat(ca.SX(0, 1), *lags))])

    @property
    def lag_named(self) -> bool:
        """Whether a lag of the sensors is among the parameters."""
        return bool(ca.depends_on(ca.vertcat(ca.SX(0, 1), *self._equations[5].lag), self._equations[0]))

    @cached_property
    def _matrices(self) -> ca.Function:
        """Parameters, currents -> A, B, C of the design model's states and lagging readings, and the dead time, s."""
        theta, x, i, rate, read, sensors = self._equations
        keep, used = list(self.plant.controlled), self._places
        sensors = replace(sensors, lag=tuple(0.0 if isinstance(lag, ca.SX) else lag for lag in sensors.lag))
        blocks = (
            ca.jacobian(rate, x)[keep, keep],
            ca.jacobian(rate, i)[keep, used],
            ca.jacobian(read, x)[:, keep],
        )
        linear = [*with_lags(sensors, *blocks), ca.SX(sensors.dead_time)]
        at, flowing = ca.SX.zeros(i.numel()), ca.SX.sym("flowing", len(used))
        at[used] = flowing
        here = ca.substitute(linear, [x, i], [ca.DM(self.place), at])
        return ca.Function("matrices", [theta, flowing], [ca.densify(M) for M in here])

    def beyond_linear(
        self, theta: FloatArray, outputs: ComplexArray, currents: ComplexArray, rate: float
    ) -> ComplexArray:
        """What the machine's curvature adds to its outputs, harmonics x p: lever arms that move with the stroke, bent
        loads, forces that change with the place.

        The remainder r = f(x, i) - f(x_0, i_0) - A (x - x_0) - B (i - i_0) is a known input, as it is small and the
        motion is measured: its response is that of the linear machine, C (s - A)^-1 r, beside the remainder of h.
        States that are not (q, q') move as the measured currents move the linear machine.

        theta : parameters, SI
        outputs : harmonics x p, Fourier coefficients of the outputs over a period, from 0 on
        currents : the same of the measured currents
        rate : rad/s of the first harmonic
        """
        A, B, C, late = self.matrices(theta)
        A_0, B_0, C_0, _ = self.matrices(theta, np.zeros((1, len(self.i))))
        count, n = len(outputs), len(self.plant.controlled)
        samples = 4 * count

        def signal(coefficients: ComplexArray) -> FloatArray:
            whole = np.zeros((samples // 2 + 1, coefficients.shape[1]), dtype=complex)
            whole[:count] = coefficients
            return np.asarray(np.fft.irfft(whole, samples, axis=0)) * samples

        w = rate * np.arange(count)
        flowing = currents * self.hold(w)[:, None]
        i = signal(flowing)
        if self.plant.second_order:
            q = evaluate(self._positions.map(samples), signal(outputs))[0]
            moving = np.fft.rfft(q, axis=0)[:count] / samples * (1j * w)[:, None]
            x = np.hstack([q, signal(moving)])
        else:
            own = np.zeros((count, n), dtype=complex)
            own[0] = self.place[list(self.plant.controlled)]
            own[1:] = np.linalg.solve(
                1j * w[1:, None, None] * np.eye(n) - A[:n, :n], (flowing[1:] @ B[:n].T)[..., None]
            )[..., 0]
            x = signal(own)
        own = np.tile(theta[: len(self.names)], (samples, 1))
        f, h = evaluate(self._values.map(samples), own, x, i)
        off_x, off_i = x - self.place[list(self.plant.controlled)], i - self.i
        r = f - off_x @ A_0[:n, :n].T - off_i @ B_0[:n].T
        bent = h - off_x @ C_0[:, :n].T if C.shape[1] == n else np.zeros_like(h)
        R, H = (np.fft.rfft(part, axis=0)[:count] / samples for part in (r, bent))
        s, wide = 1j * w[1:, None, None], np.zeros((count - 1, len(A), 1), dtype=complex)
        wide[:, :n, 0] = R[1:]
        H[1:] += (C @ np.linalg.solve(s * np.eye(len(A)) - A, wide))[..., 0]
        H[0] = 0
        return np.asarray(H * np.exp(-1j * w * late.item())[:, None])

    def hold(self, w: FloatArray) -> ComplexArray:
        """Spectrum of a current between samples over that of its samples, at frequencies w, rad/s."""
        rate, until, Ts = self._flow
        s = 1j * np.where(w == 0, 1.0, w)
        whole = (1 - np.exp(-s * Ts)) / (s * Ts)
        if np.isinf(rate):
            found = whole * np.exp(s * (Ts - until)) if until else whole
        elif rate == 0:
            found = np.abs(whole) ** 2 + 0j
        else:
            risen = whole - (1 - np.exp(-(s + rate) * Ts)) / ((s + rate) * Ts)
            found = whole + (np.exp(s * Ts) - 1) * risen / (1 - np.exp(-rate * Ts))
        return np.where(w == 0, 1.0, found)

    @cached_property
    def _positions(self) -> ca.Function:
        """y -> positions of the design model."""
        y = ca.SX.sym("y", len(self.plant.outputs))
        return ca.Function("positions", [y], [ca.densify(self.plant.position_of(y))])

    @cached_property
    def _values(self) -> ca.Function:
        """Parameters, states of the design model and measured currents -> x' and readings."""
        theta, x, i, rate, read, _ = self._equations
        keep, used = list(self.plant.controlled), self._places
        own, measured = ca.SX.sym("x", len(keep)), ca.SX.sym("i", len(used))
        whole, flowing = ca.SX.zeros(x.numel()), ca.SX.zeros(i.numel())
        whole[keep], flowing[used] = own, measured
        found = ca.substitute([rate[keep], read], [x, i], [whole, flowing])
        return ca.Function("values", [theta, own, measured], [ca.densify(part) for part in found])

    @cached_property
    def place(self) -> FloatArray:
        """The states at rest at the mean outputs, all states."""
        positions = np.array(ca.DM(self.plant.position_of(ca.DM(self.y)))).ravel()
        x = np.zeros(len(self.plant.states))
        x[list(self.plant.controlled)[: len(positions)]] = positions
        return x

    @cached_property
    def _places(self) -> list[int]:
        """Places of the measured currents among all."""
        known = [s.name for s in axes_of(self.plant)]
        return [known.index(name) for name in self.currents]


class Flow(NamedTuple):
    """How a current goes from one measured value to the next: with a rate (1/s; 0: evenly), or it is held until `until`
    (s after the sample; 0: with a rate, or held for the whole sample, if the rate is infinite)."""

    rate: float
    until: float
    sample_time: float


def _step(A: FloatArray, B: FloatArray, flow: Flow, t: float) -> tuple[FloatArray, FloatArray]:
    """The state at t after a sample by the state there and the currents there, and, unless held, at the next sample."""
    n, m = B.shape
    held, Ts = bool(np.isinf(flow.rate)), flow.sample_time
    rate = 0.0 if held else flow.rate
    whole = np.zeros((n + 2 * m,) * 2)
    whole[:n, :n], whole[:n, n : n + m] = A, B
    whole[n : n + m, n : n + m] = -rate * np.eye(m)
    whole[n : n + m, n + m :] = (rate or 1 / Ts) * np.eye(m)
    E = expm(whole * t)
    at, growing = E[:n, n : n + m], E[:n, n + m :]
    if held:
        new = expm(whole * max(t - flow.until, 0.0))[:n, n : n + m]
        return E[:n, :n], np.hstack([at - new, new]) if flow.until else at
    # What the current goes towards, from its values at both ends: its command behind a lag, else its growth.
    left = np.exp(-rate * Ts)
    part = growing / (1 - left) if rate else growing
    return E[:n, :n], np.hstack([at - left * part, part])


def points_of_noise(i: FloatArray, periods: int) -> FloatArray:
    """Points with the covariance of what currents do beside their mean period, and the mean 0: 2 x n of n directions.

    i : k x currents, whole periods
    """
    each, width = len(i) // periods, i.shape[1]
    total, gram = np.zeros((each, width)), np.zeros((width, width))
    middle = np.asarray(i[:each]).mean(axis=0)
    for p in range(periods):  # one by one: a long record stays in its file
        part = np.asarray(i[p * each : (p + 1) * each]) - middle
        total += part
        gram += part.T @ part
    gram = (gram - total.T @ total / periods) / max(periods - 1, 1) / each
    values, vectors = np.linalg.eigh(gram)
    loud = values > MIN_VARIANCE_SHARE * values.sum()
    points = (vectors[:, loud] * np.sqrt(loud.sum() * values[loud])).T
    return np.vstack([points, -points]) if loud.any() else np.zeros((1, i.shape[1]))


def flow_of(plant: Plant, sample_time: float) -> Flow:
    """How a current goes from one measured value to the next; one that follows at once changes with its command."""
    actuator = plant.actuator
    if plant.actuator.windings is not None:
        return Flow(actuator.R / actuator.L if actuator.L else 0.0, 0.0, sample_time)
    late = actuator.delay(sample_time) % 1 if np.isinf(actuator.crossover) else 0.0
    return Flow(actuator.crossover, late * sample_time, sample_time)


def axes_of(plant: Plant) -> tuple[Any, ...]:
    """The signals of the currents that a log may have: axes of the drive, or coils of a machine without windings."""
    return plant.actuator.coils if plant.actuator.windings is None else plant.drive.axes


def transfer(A: FloatArray, C: FloatArray, B: FloatArray, z: ComplexArray) -> ComplexArray:
    """C (z - A)^-1 B at many z: by eigenvectors, or where these are nearly alike by a solution for each."""
    values, V = np.linalg.eig(A)
    if np.linalg.cond(V) > MAX_EIGENVECTOR_CONDITION:
        return np.asarray(C @ np.linalg.solve(z[:, None, None] * np.eye(len(A)) - A, B))
    seen, driven = C @ V, np.linalg.solve(V, B.astype(complex))
    outer = seen.T[:, :, None] * driven[:, None, :]
    found = (1 / (z[:, None] - values)) @ outer.reshape(len(A), -1)
    return np.asarray(found.reshape(len(z), len(C), B.shape[1]))


def units_of_model(plant: Plant) -> dict[str, str]:
    """The SI units of what may be a parameter of a response: fields of the record, and errors of the sensors."""
    fields: dict[str, Any] = plant.parameters.__dataclass_fields__
    units = {name: str(fields[name].metadata["unit"]) for name in symbolic_names(plant.parameters)}
    return units | {s.name: s.unit for s in plant.sensors.errors}


def plant_with(plant: Plant, values: Mapping[str, float]) -> Plant:
    """The machine with these parameters; those that are alike by declaration stay alike. Sensors' errors are none."""
    par: Any = plant.parameters
    own = {name: float(value) for name, value in values.items() if name in symbolic_names(par)}
    alike = {name: own[twin] for name, twin in twins_of(par).items() if twin in own}
    return plant_of(replace(par, **alike | own))


def require_parameters(plant: Plant, names: Sequence[str]) -> tuple[str, ...]:
    """The names of parameters, each once. Raises InputError for unknown ones."""
    known = units_of_model(plant)
    for name in names:
        if name not in known:
            raise InputError("parameters", name, "an unknown parameter", "one of " + " ".join(known))
    return tuple(dict.fromkeys(names))


def acting_parameters(plant: Plant) -> tuple[str, ...]:
    """The parameters of a machine that are not 0, twins apart."""
    par, twins = plant.parameters, twins_of(plant.parameters)
    return tuple(n for n in symbolic_names(par) if n not in twins and float(getattr(par, n)) != 0)


def candidates(plant: Plant) -> tuple[str, ...]:
    """The parameters that are asked for where none is named: `acting_parameters` but masses, lengths, pure numbers.

    Those are weighed, measured and counted, as turns are; and without one of them only ratios are told.
    """
    units = units_of_model(plant)
    return tuple(name for name in acting_parameters(plant) if units[name] not in ("kg", "m", "1"))


def information(slopes: ComplexArray, inputs: ComplexArray, variance: FloatArray) -> FloatArray:
    """The Fisher information of parameters in units of their scales.

    F = 2 sum over k of Re (dG_k I_k)^H C^-1 (dG_k I_k)

    slopes : parameters x k x p x currents
    inputs : k x currents, Fourier coefficients of the currents
    variance : k x p, of the noise of the outputs' Fourier coefficients
    """
    if not len(slopes):  # a machine whose parameters are all known
        return np.zeros((0, 0))
    moved = np.einsum("nkpm,km->nkp", slopes, inputs) / np.sqrt(variance)
    flat = moved.reshape(len(moved), -1)
    return np.asarray(2 * (flat.conj() @ flat.T).real)


def well_found(F: FloatArray, names: Sequence[str], share: float) -> list[int]:
    """Indices of the parameters that are left when those with the largest standard deviation are dropped one by one.

    share : of its scale, which no standard deviation exceeds in the end
    """
    left = [k for k in range(len(names)) if F[k, k] > 0]
    while left:
        sigma = deviations(F[np.ix_(left, left)])
        worst = int(sigma.argmax())
        if sigma[worst] <= share:
            break
        del left[worst]
    return left


def deviations(F: FloatArray) -> FloatArray:
    """Standard deviations of all parameters together from their information; infinite for one that does not act."""
    size = np.sqrt(np.maximum(np.diag(F), 0.0))  # below zero by rounding alone
    found = np.full(len(F), np.inf)
    act = size > 0
    if act.any():
        values, vectors = np.linalg.eigh(F[np.ix_(act, act)] / np.outer(size[act], size[act]))
        found[act] = np.sqrt((vectors**2 / np.maximum(values, 1e-13)).sum(axis=1)) / size[act]
    return found
