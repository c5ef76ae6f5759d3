"""R and L of the windings and the dead time of the drive: what commanded voltages make of the measured currents.

At the lines of an excitation the currents of each axis obey

    I = H(R, L, dead time) U - W Y / (R + j w L)

with the voltages U that the current controllers computed, held for one sample, and W from measured positions to induced
voltages and to the coupling of moving axes. Between the lines the same e = I - ... is the noise of the current sensors.
What the law and the current controllers did drops out. So one log tells R, L and the dead time, and with the gain
file's controllers the crossover and the phase margin that the current loops have.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import casadi as ca
import numpy as np
from scipy.optimize import brentq, least_squares
from scipy.special import gammainccinv

from malta.arrays import ComplexArray, FloatArray
from malta.display import Description, display
from malta.errors import InputError
from malta.identification.calibration import Interval95
from malta.identification.identify import MIN_PROBABILITY, SLACK
from malta.identification.log import Log, require_currents
from malta.identification.spectra import (
    MOTION_BAND_FACTOR,
    SIGMA,
    Spectrum,
    between_neighbours,
    in_axes,
    readings,
    require_log,
    spectrum_of,
    whole,
)
from malta.model.places import place_states
from malta.model.plant import Plant
from malta.model.plants import plant_of
from malta.simulation.current_control import open_loop_gain
from malta.simulation.engine.engines import evaluate
from malta.synthesis.controller import Controller

ROUNDS = 3  # searches, each with the noise that the one before has left between the lines
MAX_DEAD_TIME = 20.0  # samples of dead time


@display
@dataclass(frozen=True, eq=False)
class Windings:
    """Parameters of the drive from a log.

    R : of each axis
    L : likewise
    dead_time : from the reading to the middle of the sample in which its voltage is held
    believed : the same three of the gain file, SI
    crossover : rad/s, of the current loops with the gain file's controllers
    phase_margin : rad
    designed : the crossover and the phase margin that the controllers were designed for
    chi2 : of the residuals at the lines over their degrees of freedom; 1 where this model is right
    limit : of chi2, above which it is refused

    >>> import dataclasses, malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> loop, R = malta.loop(plant, controller), plant.parameters.R
    >>> plan = malta.excite(loop, period=0.5, periods=4, band=(4, 400))
    >>> warm = plant.variant(dataclasses.replace(plant.parameters, R=1.2 * R))
    >>> excited = malta.Scenario.excited(plan.signal, plan.duration)
    >>> run = malta.simulate(warm, controller, excited)
    >>> log = malta.identification.log_of(run)
    >>> found = malta.identification.identify_windings(controller, log)
    >>> found.refusal, f"{found.R.value / R:.2f}"
    ('', '1.20')
    """

    R: Interval95
    L: Interval95
    dead_time: Interval95
    believed: tuple[float, float, float]
    crossover: float
    phase_margin: float
    designed: tuple[float, float]
    chi2: float
    limit: float

    @property
    def refusal(self) -> str:
        """Why the windings do not explain the log; "": they do."""
        if self.chi2 <= self.limit:
            return ""
        return (
            f"chi2 / dof of the currents is {self.chi2:.3g}, at most {self.limit:.3g} is noise: voltages do not act as "
            "on R, L and a dead time (logged at other samples, lost in the half-bridges, or axes unlike each other)"
        )

    @property
    def estimates(self) -> dict[str, tuple[Interval95, float]]:
        """By name: R, L and the dead time, each with what the gain file has, SI."""
        found = self.R, self.L, self.dead_time
        return dict(zip(("R", "L", "dead time"), zip(found, self.believed, strict=True), strict=True))

    @property
    def description(self) -> Description:
        """The three figures, and the current loop that they make."""
        rows = [(name, f"{found}, gain file {own:.5g}") for name, (found, own) in self.estimates.items()]
        rows.append(("current loops", f"{self.crossover:.4g} rad/s, {np.degrees(self.phase_margin):.3g} deg"))
        rows.append(("verdict", self.refusal or "as R, L and a dead time"))
        return Description("Drive as identified", tuple(rows))


class _Axes(NamedTuple):
    """Currents and voltages of the axes at some bins, and what motion adds."""

    sample_time: float
    w: FloatArray  # rad/s
    current: ComplexArray  # bins x axes
    voltage: ComplexArray
    induced: ComplexArray  # V
    turned: ComplexArray  # A/s, by the coupling of moving axes

    def residuals(self, theta: FloatArray) -> ComplexArray:
        """e of R (ohm), L (H) and the samples until a voltage acts."""
        R, L, _ = theta
        moved = (self.induced - L * self.turned) / (R + 1j * self.w * L)[:, None]
        driven = held_response(theta, self.w, self.sample_time)[:, None] * self.voltage
        return np.asarray(self.current - driven + moved)


def held_response(theta: FloatArray, w: FloatArray, Ts: float) -> ComplexArray:
    """The response of sampled currents to sampled voltages that are held, at frequencies w, rad/s.

        H(z) = z^-n (1 - a^(1-f) + (a^(1-f) - a) / z) / (R (z - a)),    a = e^(-R Ts / L)

    theta : R, ohm; L, H; and n + f, the samples until a voltage acts
    """
    R, L, delay = theta
    n = np.floor(delay)
    z, decay, part = np.exp(1j * w * Ts), np.exp(-R * Ts / L), np.exp(-R * Ts * (1 - delay + n) / L)
    return np.asarray(z**-n * (1 - part + (part - decay) / z) / (R * (z - decay)))


def identify_windings(controller: Controller, log: Log) -> Windings:
    """R, L and the dead time of the drive from a log under excitation, with its voltages.

    controller : the gain file that was running
    log : with the measured currents and the commanded voltages of the axes, and whole periods of an excitation

    Returns a Windings, also where its `refusal` says that these three do not explain the currents.

    Raises InputError for a machine without windings, and for a log without voltages; CheckError as `malta.identify`.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/halbach.json")
    >>> hold = malta.Scenario("hold", 0.2, malta.references.hold, fidelity="force")
    >>> run = malta.simulate(malta.plant_of(controller.parameters), controller, hold)
    >>> log = malta.identification.log_of(run)
    >>> malta.identification.identify_windings(controller, log)
    Traceback (most recent call last):
        ...
    malta.errors.InputError: identify: windings: found a halbach, which has no model of them, expected a machine
    with windings
    """
    plant = plant_of(controller.parameters)
    if plant.actuator.windings is None or controller.current_loop is None:
        found = f"a {plant.name}, which has no model of them"
        raise InputError("identify", "windings", found, "a machine with windings")
    require_log(log, plant.name, controller.sample_time)
    log = in_axes(log, plant)
    axes = [s.name for s in plant.drive.axes]
    require_currents(log, axes)
    known = log.names("u")
    used = [name for name in log.names("i") if name.replace("i_", "u_", 1) in known]
    if not used:
        raise InputError(log.source, "u", "no voltages of its currents", f"columns as u_{axes[0][2:]} [V]")
    u = whole(log, "u")[:, [known.index(name.replace("i_", "u_", 1)) for name in used]]
    i = whole(log, "i")[:, [log.names("i").index(name) for name in used]]
    y = between_neighbours(readings(log, robust=False))
    s = spectrum_of(log, y, i)
    N = round(2 * np.pi / (s.rate * log.sample_time))
    read, sent, flown = (
        np.fft.rfft(np.asarray(table)[-N:], axis=0) / N for table in (y, u, i)
    )  # at all bins
    signals = (flown, sent, *_induced_spectra(plant, used, s, read, np.asarray(i)[-N:]))
    lines, between = (
        _Axes(log.sample_time, s.rate * bins, *(one[bins] for one in signals))
        for bins in (s.lines, s.between.ravel())
    )
    actuator = plant.actuator
    computed = actuator.computation_time
    believed = actuator.R, actuator.L, computed + log.sample_time / 2 if computed else actuator.dead_time
    theta = np.array([actuator.R, actuator.L, actuator.delay(log.sample_time)], dtype=float)
    for _ in range(ROUNDS):
        theta, covariance, chi2, dof = _search(lines, between, theta)
    values = theta * [1, 1, log.sample_time] + [0, 0, log.sample_time / 2]
    half = SIGMA * np.sqrt(np.diag(covariance)) * [1, 1, log.sample_time]
    R, L, dead_time = map(Interval95, values.tolist(), half.tolist(), ("ohm", "H", "s"))
    loop = _current_loop(controller, *values.tolist())
    designed = actuator.crossover, actuator.phase_margin
    limit = float(SLACK * 2 * gammainccinv(dof / 2, MIN_PROBABILITY) / dof)
    return Windings(R, L, dead_time, believed, *loop, designed, chi2, limit)


def _induced_spectra(
    plant: Plant, used: list[str], s: Spectrum, outputs: ComplexArray, i: FloatArray
) -> list[ComplexArray]:
    """The spectra of induced voltages, V, and of the coupling of moving axes, A/s; bins x axes each.

    Positions and speeds are those of the readings up to twice the highest line.

    outputs : bins x readings, all bins
    i : samples x axes, whole periods
    """
    N, count = len(i), len(plant.outputs)
    slow = np.arange(len(outputs)) <= MOTION_BAND_FACTOR * s.lines[-1]
    w = s.rate * np.arange(len(outputs))
    y = np.fft.irfft(outputs * slow[:, None] * N, N, axis=0)
    speed = np.fft.irfft(1j * w[:, None] * outputs * slow[:, None] * N, N, axis=0)
    read, moving, flowing = (ca.SX.sym("signal", size) for size in (count, count, len(used)))
    axes, q = [axis.name for axis in plant.drive.axes], plant.position_of(read)
    x = place_states(plant, ca.vertcat(q, ca.jtimes(q, read, moving)))
    whole_i, places = ca.SX.zeros(len(axes)), [axes.index(name) for name in used]
    whole_i[places] = flowing
    added = plant.drive.emf(x), plant.drive.coupling(x, whole_i)
    moved = ca.Function("moved", [read, moving, flowing], [ca.densify(one[places]) for one in added])
    return [np.fft.rfft(table, axis=0) / N for table in evaluate(moved.map(N), y, speed, i)]


def _search(lines: _Axes, between: _Axes, begin: FloatArray) -> tuple[FloatArray, FloatArray, float, int]:
    """R, L and the samples of delay, their covariance, chi2 / dof and dof, with the noise that `begin` leaves."""
    noise = np.sqrt((np.abs(between.residuals(begin)) ** 2).mean(axis=0) / 2)
    scale = np.array([begin[0], begin[1], 1.0])

    def residuals(x: FloatArray) -> FloatArray:
        e = (lines.residuals(x * scale) / np.maximum(noise, 1e-300)).ravel()
        return np.concatenate([e.real, e.imag])

    low, high = np.array([0.01, 0.01, 0.0]), np.array([100.0, 100.0, MAX_DEAD_TIME])
    found = least_squares(residuals, begin / scale, bounds=(low, high), x_scale=[1, 1, 0.1], xtol=1e-12)
    dof = len(found.fun) - 3
    chi2 = float(found.fun @ found.fun) / dof
    J = np.asarray(found.jac)
    covariance = np.linalg.pinv(J.T @ J) * max(1.0, chi2) * np.outer(scale, scale)
    return found.x * scale, covariance, chi2, dof


def _current_loop(controller: Controller, R: float, L: float, dead_time: float) -> tuple[float, float]:
    """Crossover, rad/s, and phase margin, rad, of the gain file's current controllers on this drive."""
    loop = controller.current_loop
    assert loop is not None
    actuator = replace(plant_of(controller.parameters).actuator, R=R, L=L)

    def gain(w: float) -> complex:
        return complex(open_loop_gain(actuator, loop.Kp, loop.Ki, dead_time, np.array([w]))[0])

    low, high = 1e-3 * actuator.crossover, 1e3 * actuator.crossover
    crossover = float(brentq(lambda w: abs(gain(w)) - 1, low, high))
    return crossover, float(np.pi + np.angle(gain(crossover)))
