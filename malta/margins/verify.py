"""Linear verification of a controller on a machine: poles, sensitivities, bandwidths, stage by stage.

The loops and their signals are those of loops.py; at the sensors S = (I - P F)^-1, T = I - S, L = -P F.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np

from malta.display import Description, display
from malta.errors import CheckError
from malta.loops.loop import loop_of_model
from malta.loops.sampled_loops import (
    SampledLoop,
    commanded_model,
    continuous_poles,
    sampled_loop,
    sorted_poles,
)
from malta.margins.extent import NOWHERE, Extent, extent_of
from malta.margins.travel import NOT_BETWEEN, travel_margin
from malta.model.data import plant_of
from malta.model.linearize import LinearModel, linearize
from malta.proof.margin import Margin
from malta.proof.responses import crossing, find_peaks
from malta.synthesis.controller import Controller
from malta.synthesis.riccati import add_integrals, eigenvalues
from malta.synthesis.sampled import gain_at_rest
from malta.threads import on_one_thread

if TYPE_CHECKING:
    from collections.abc import Mapping

    from malta.model.plant import ComplexArray, FloatArray

# ISO 14839-3: upper limits of the peak sensitivity
ZONES = ((3.0, "A"), (4.0, "B"), (5.0, "C"), (np.inf, "D"))


@dataclass(frozen=True, eq=False)
class Poles:
    """Poles in rad/s; of sampled systems ln(lambda) / Ts, without the poles of pure delay."""

    open_loop: ComplexArray  # of the continuous model
    regulator: ComplexArray  # of the controller's own sampled model with K, Ki; empty for a PID
    filter: ComplexArray  # of the controller's own sampled observer; empty for a PID
    closed_loop: ComplexArray  # of the machine: hold, delay, current loops, controller

    def pairs(self) -> dict[str, list[list[float]]]:
        """Each set as rows [re, im]."""
        return {f.name: [[float(p.real), float(p.imag)] for p in getattr(self, f.name)] for f in fields(self)}


@dataclass(frozen=True)
class Stage:
    """The peak sensitivity and stability of one loop, from the ideal one to the machine's."""

    name: str
    peak_sensitivity: Mapping[str, float]  # by sensor, and sigma_max of all
    peak_frequency: float  # rad/s, of sigma_max
    spectral_radius: float  # of the closed loop; stable below 1

    @property
    def stable(self) -> bool:
        return self.spectral_radius < 1


@display
@dataclass(frozen=True, eq=False)
class Margins:
    """What `malta.verify` finds: poles, peak sensitivities, bandwidths and the robust margin of a loop.

    The last stage is the machine's loop: hold, delay and current loops. ISO 14839-3 sorts its peak sensitivities into
    zones: A below 3 (9.5 dB), B below 4, C below 5, D above.

    poles : open loop, regulator, filter and closed loop, rad/s; of sampled systems ln(lambda) / Ts
    stages : peak sensitivities and spectral radius of the loop as designed, with current loops, and of the machine
    bandwidth : rad/s, by definition
    uncertainty : relative half range of each parameter
    robust : the margin in multiples of these ranges, anywhere in `extent`; None without ranges
    extent : the intervals that the margin covers beside the ranges

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> model = malta.linearize(spec.plant, spec.plant.at())
    >>> margins = malta.verify(model, malta.synthesize(spec, model), {"m": 0.2})
    >>> f"{margins.peak_sensitivity['y']:.2f}, {margins.robust.lower:.2f}"
    '1.57, 3.91'
    """

    poles: Poles
    stages: tuple[Stage, ...]
    bandwidth: Mapping[str, float]
    uncertainty: Mapping[str, float]
    robust: Margin | None
    extent: Extent = NOWHERE

    @property
    def stable(self) -> bool:
        """Whether the machine's loop is stable."""
        return self.stages[-1].stable

    @property
    def peak_sensitivity(self) -> Mapping[str, float]:
        """The peak sensitivity of the machine's loop, by sensor and as sigma_max."""
        return self.stages[-1].peak_sensitivity

    def __str__(self) -> str:
        lines = [f"{'stable' if self.stable else 'UNSTABLE'} with hold, delay and current loops"]
        for stage in self.stages:
            peaks = "  ".join(
                f"{k} {v:.2f} {zone(v)}" for k, v in stage.peak_sensitivity.items() if k != "sigma_max"
            )
            largest = stage.peak_sensitivity["sigma_max"]
            lines.append(
                f"peak |S|, {stage.name}: {peaks}  all {largest:.2f} ({20 * np.log10(largest):.1f} dB)"
            )
        for key, value in self.bandwidth.items():
            lines.append(f"bandwidth, {BANDWIDTHS[key]}: {value:.1f} rad/s ({value / (2 * np.pi):.2f} Hz)")
        if self.uncertainty:
            box = "  ".join(f"{name} +-{share * 100:g} %" for name, share in self.uncertainty.items())
            everywhere = self.robust is None or NOT_BETWEEN not in self.robust.reason
            where = str(self.extent) if everywhere else "in the middle and at the end of the travel"
            lines += [f"uncertainty: {box}", f"{f'robust {where}'.rstrip()}: {self.robust}"]
        return "\n".join(lines)

    @property
    def description(self) -> Description:
        """The sentences of `str`."""
        first, *rest = str(self).splitlines()
        parts = (line.partition(": ") for line in rest)
        return Description(f"Margins: {first}", tuple((label, text) for label, _, text in parts))


BANDWIDTHS = {
    "sigma_max_T": "last -3 dB of sigma_max(T)",
    "sigma_min_T": "first -3 dB of sigma_min(T)",
    "crossover_max": "last 0 dB of sigma_max(L)",
    "w_n_max": "regulator's fastest natural frequency",
    "w_n_min": "regulator's slowest natural frequency",
}


def zone(peak: float) -> str:
    """ISO 14839-3 zone of a peak sensitivity: A below 3 (9.5 dB), B below 4, C below 5, D above."""
    return next(name for limit, name in ZONES if peak < limit or limit == np.inf)


def controller_poles(c: Controller) -> tuple[ComplexArray, ComplexArray]:
    """Eigenvalues in z of regulator and filter on the controller's own model (separation principle).

    The regulator has no poles for observed disturbance forces, which only the filter estimates.
    """
    k = len(c.Ad) - c.observed * len(c.forces)
    A, B, K = c.Ad[:k, :k], c.Bd[:k], c.K[:, :k]
    if c.integrating:
        A, B = add_integrals(A, B, c.Cd[:, :k], c.sample_time)
        K = np.hstack([K, -c.Ki])
    return eigenvalues(A - B @ K), eigenvalues((np.eye(len(c.Ad)) - c.L @ c.Cd) @ c.Ad)


@on_one_thread
def unstable_gain(c: Controller) -> tuple[str, float] | None:
    """The name of a gain that leaves the controller's own model unstable, and the worst |lambda|; None: all are stable.

    An LQG is judged by its regulator and its filter. A PID or a law of errors has no model and is judged on the machine
    that it names.
    """
    if c.cost is None:
        plant = plant_of(c.parameters)
        model = linearize(plant, plant.point(c.operating_point[0]))
        found = {"K": eigenvalues(loop_of_model(model, c).matrix)}
    else:
        found = dict(zip("KL", controller_poles(c), strict=True))
    for name, poles in found.items():
        radius = float(np.abs(poles).max())
        if not radius < 1:
            return name, radius
    return None


@on_one_thread
def verify(
    model: LinearModel, controller: Controller, uncertainty: Mapping[str, float] | None = None
) -> Margins:
    """Verify a controller on a machine's linear model: poles, peak sensitivities, bandwidths, and the robust margin.

    Stages: the sampled loop as designed; with the current loops; the machine. The robust margin covers the travel and
    the intervals of `plant.over`. The peak sensitivities of an unstable loop are NaN; instability raises nothing.

    model : the machine's linear model, from `malta.linearize`
    controller : its controller
    uncertainty : relative half range of each parameter, the unit of the robust margin, as {"m": 0.2}; None: no margin

    Returns a Margins, which prints as a short table.

    Raises CheckError when numbers overflow or no input holds the machine.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> model = malta.linearize(spec.plant, spec.plant.at())
    >>> print(malta.verify(model, malta.synthesize(spec, model), spec.uncertainty))
    stable with hold, delay and current loops
    peak |S|, sampled: y 1.71 A  all 1.71 (4.7 dB)
    peak |S|, + current loops: y 1.71 A  all 1.71 (4.7 dB)
    peak |S|, machine: y 1.57 A  all 1.57 (3.9 dB)
    bandwidth, last -3 dB of sigma_max(T): 652.0 rad/s (103.76 Hz)
    bandwidth, first -3 dB of sigma_min(T): 652.0 rad/s (103.76 Hz)
    bandwidth, last 0 dB of sigma_max(L): 290.8 rad/s (46.29 Hz)
    bandwidth, regulator's fastest natural frequency: 247.4 rad/s (39.37 Hz)
    bandwidth, regulator's slowest natural frequency: 247.4 rad/s (39.37 Hz)
    uncertainty: m +-20 %  C +-20 %
    robust: proven 320... %, lost at 320.61 % at 1047 rad/s
    """
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            return _verify(model, controller, dict(uncertainty or {}))
    except np.linalg.LinAlgError as error:
        raise CheckError(f"{controller.name}: the loop cannot be computed ({error})") from error


def _verify(model: LinearModel, controller: Controller, uncertainty: Mapping[str, float]) -> Margins:
    whole = loop_of_model(model, controller)
    machine = whole.sampled
    loops = {
        "sampled": sampled_loop(model, controller, delay=controller.delay),
        "+ current loops": sampled_loop(model, controller, delay=controller.delay, current_loops="lag"),
        "machine": machine,
    }
    names = [s.name for s in controller.measurements]
    stages = tuple(stage_of(name, stage, names) for name, stage in loops.items())
    empty = np.zeros(0, dtype=complex)
    regulator, observer = (empty, empty) if controller.cost is None else controller_poles(controller)
    poles = Poles(
        open_loop=sorted_poles(eigenvalues(model.A)),
        regulator=continuous_poles(regulator, controller.sample_time),
        filter=continuous_poles(observer, controller.sample_time),
        closed_loop=whole.poles,
    )
    bandwidths = bandwidths_of(model, controller, machine, stable=stages[-1].stable)
    robust = travel_margin(model.plant, controller, uncertainty) if uncertainty else None
    return Margins(poles, stages, bandwidths, uncertainty, robust, extent_of(model.plant, uncertainty))


def require_stable(margins: Margins, name: str) -> None:
    """Raise CheckError when a stage is unstable: such gains are not written to files."""
    for stage in margins.stages:
        if not stage.stable:
            raise CheckError(
                f"{name}: the loop ({stage.name}) is unstable, |lambda| = {stage.spectral_radius:.6f}"
            )


def _grid(Ts: float) -> FloatArray:
    return np.geomspace(1e-2, np.pi / Ts, 240)


def stage_of(name: str, stage: SampledLoop, sensors: list[str]) -> Stage:
    """The peak sensitivities and the spectral radius of a loop; the peaks of an unstable one are NaN."""
    radius = float(np.abs(eigenvalues(stage.closed)).max())
    if radius >= 1:
        return Stage(name, dict.fromkeys([*sensors, "sigma_max"], np.nan), np.nan, radius)

    def sizes(w: FloatArray) -> FloatArray:
        S = stage.sensitivity(w)
        return np.column_stack([np.abs(np.einsum("kii->ki", S)), _singular_values(S)[:, 0]])

    peaks, at = find_peaks(sizes, _grid(stage.sample_time))
    return Stage(name, dict(zip([*sensors, "sigma_max"], peaks.tolist(), strict=True)), float(at[-1]), radius)


def bandwidths_of(
    model: LinearModel, controller: Controller, machine: SampledLoop, *, stable: bool
) -> dict[str, float]:
    """The bandwidths of the machine's loop by the definitions of BANDWIDTHS, rad/s; NaN where it is unstable."""
    natural = _natural_frequencies(commanded_model(model, controller), controller)
    if not stable:
        return {key: np.nan for key in BANDWIDTHS if not key.startswith("w_n")} | natural
    w = _grid(machine.sample_time)
    L = machine.loop_gain(w)
    S = machine.sensitivity(w)
    T = _singular_values(np.eye(len(machine.Cd)) - S)
    half = np.sqrt(0.5)
    return {
        "sigma_max_T": crossing(w, T[:, 0], half, last=True),
        "sigma_min_T": crossing(w, T[:, -1], half, last=False),
        "crossover_max": crossing(w, _singular_values(L)[:, 0], 1.0, last=True),
        **natural,
    }


def _natural_frequencies(model: LinearModel, controller: Controller) -> dict[str, float]:
    """Natural frequencies of q'' = (k - G K1) q, rad/s; none unless the controller feeds back states (q, q')."""
    n = model.plant.coordinates
    if not n or controller.tracks == "errors":
        return {}
    K = controller.K[:, :n]
    if controller.lagging:
        K = gain_at_rest(controller.K, len(controller.A), controller.lagging + controller.delay)
    closed = model.force_map @ K - model.stiffness
    w_n = np.sqrt(np.maximum(eigenvalues(closed).real, 0))
    return {"w_n_max": float(w_n.max()), "w_n_min": float(w_n.min())}


def _singular_values(G: ComplexArray) -> FloatArray:
    return np.asarray(np.linalg.svd(G, compute_uv=False))
