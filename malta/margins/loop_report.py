"""The record of what is known of a loop: what `malta verify` finds, and every page, table and document shows."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from malta.display import Curves, Description, display
from malta.frames import data_frame
from malta.loops.loop import Loop, loop_of_model
from malta.loops.noise import noise_of
from malta.loops.time_domain import Recovery, furthest, recovery
from malta.loops.windings import LAST_STAGE, CurrentLoops, left_out
from malta.margins.outcome import Outcome
from malta.margins.travel import NO_EXTENT, NOT_BETWEEN_TEXT, Extent
from malta.merit_lists import in_groups
from malta.merits import Merit, figure
from malta.model.parameters import box_words
from malta.proof.margin import NOT_PROVEN, Margin
from malta.synthesis.requirements import NoiseRms, Payload
from malta.units import FINE_UNITS

if TYPE_CHECKING:
    from malta.arrays import ComplexArray
    from malta.loops.classical import Classical, Disk
    from malta.margins.unmodelled import UnmodelledMargin
    from malta.model.linearize import LinearModel
    from malta.model.plant import Plant
    from malta.proof.blocks.gain import Gain
    from malta.synthesis.controller import Controller


# ISO 14839-3: upper limits of the peak sensitivity
ZONES = ((3.0, "A"), (4.0, "B"), (5.0, "C"), (np.inf, "D"))
BANDWIDTHS = {
    "sigma_max_T": "last -3 dB of sigma_max(T)",
    "sigma_min_T": "first -3 dB of sigma_min(T)",
    "crossover_max": "last 0 dB of sigma_max(L)",
    "w_n_max": "regulator's fastest natural frequency",
    "w_n_min": "regulator's slowest natural frequency",
}
BANDWIDTH = "sigma_max_T"  # the one that is meant where a tile shows one


def zone(peak: float) -> str:
    """ISO 14839-3 zone of a peak sensitivity: A below 3 (9.5 dB), B below 4, C below 5, D above."""
    return next(name for limit, name in ZONES if peak < limit or limit == np.inf)


CURVE = 120  # points of a curve in a notebook
# Kinds that a reader looks for.
FIRST_KINDS = ("disk", "delay_margin", "peak_s", "peak_t", "damping", "requirements")


@display
@dataclass(frozen=True, eq=False)
class Poles:
    """Poles in rad/s; of sampled systems ln(lambda) / Ts, without the poles of pure delay."""

    open_loop: ComplexArray  # of the continuous model
    regulator: ComplexArray  # of the controller's own sampled model with K, Ki; empty for a PID
    filter: ComplexArray  # of the controller's own sampled observer; empty for a PID
    closed_loop: ComplexArray  # of the machine: hold, delay, current loops, controller

    @property
    def pairs(self) -> dict[str, list[list[float]]]:
        """Each set as rows [re, im]."""
        return {f.name: [[float(p.real), float(p.imag)] for p in getattr(self, f.name)] for f in fields(self)}


@dataclass(frozen=True)
class StagePeak:
    """The peak sensitivity and stability of one loop, from the ideal one to the machine's."""

    name: str
    peak_sensitivity: Mapping[str, float]  # by sensor, and sigma_max of all
    peak_frequency: float  # rad/s, of sigma_max
    spectral_radius: float  # of the closed loop; stable below 1

    @property
    def stable(self) -> bool:
        return self.spectral_radius < 1


@dataclass(frozen=True, eq=False)
class ChainStage:
    """One stage of the chain, with its margin and its peak sensitivity."""

    name: str
    margin: Margin
    peak: float  # largest |S_ii|; NaN where unstable
    broken_at: Literal["forces", "sensors"]  # where S is taken
    loaded: bool = False  # whether S is that of the machine under its loads


@dataclass(frozen=True)
class TravelPlace:
    """Figures at a place of the stroke: each is the worse of +position and -position.

    A machine without a stroke has its places along the first parameter of `plant.over`, as the speed of a rotor.
    """

    position: float  # m, or the SI unit of the parameter
    margin: Margin
    peak: float
    disk: float  # size of the disk margin of all forces and sensors at once
    delay: float  # s, smallest delay margin; NaN where unstable, as peak and disk


@display
@dataclass(frozen=True, eq=False)
class LoopReport:
    """What is known of a loop, from `malta.verify`; terminal, JSON, pages and comparisons show this record.

    The last of `stages` is the machine's loop: hold, delay and current loops. ISO 14839-3 sorts its peak sensitivities
    into zones: A below 3 (9.5 dB), B below 4, C below 5, D above. Margins are multiples of `uncertainty`.

    model : the machine's linear model
    controller : its controller
    poles : open loop, regulator, filter and closed loop, rad/s; of sampled systems ln(lambda) / Ts
    stages : peak sensitivities and spectral radius of the loop as designed, with current loops, and of the machine
    bandwidth : rad/s, by definition
    uncertainty : relative half range of each parameter, or its interval, SI
    robust : the margin anywhere in `extent`; None where it was not asked for
    extent : the intervals that proofs cover beside the uncertainty
    current_loops : of the last stage of the chain: "pi" or "lag"
    chain : the stages from LQR to the machine's loop, each with its margin and its largest `|S|`
    disks : disk margins of forces, sensors, both, and each sensor alone: the worst of all places; empty where unstable
    delay : s, delay margin of each sensor's loop, the others closed: the worst of all places; NaN where unstable
    gang : by sensor the largest `|S|`, `|T|`, `|S P|` (m/N) and `|F S|` (N/m): the worst of all places
    tolerance : margins of each parameter alone, down and up, anywhere in `extent`, in multiples of its range
    mass : margin of the linear loop in kg on top of the mass m; None for a machine without a parameter m
    places : figures along the course, each the worse of +z and -z
    worst : the largest `|S|` of each sensor over the uncertainty, with its proven bound
    payload : kg that the forces hold and the mover carries in flight; None for a machine without a mass m
    unmodelled : the margin with the dynamics that a log leaves of an identified machine; None: of no log
    requirements : of the design file, with what was found
    notes : what could not be computed, and why

    The fields from `chain` on are empty but with `stages=True`. `figures` lists all of it: each figure of merit with
    its unit, its meaning, which way is better, and its bound.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> model = malta.linearize(spec.plant, spec.plant.at())
    >>> found = malta.verify(model, malta.synthesize(spec, model), {"m": 0.2})
    >>> f"{found.peak_sensitivity['y']:.2f}, {found.robust.lower:.2f}"
    '1.57, 3.91'
    >>> peak = next(one for one in found.figures if one.key == "peak_sensitivity")
    >>> peak.heading, f"{peak.value:.2f}", peak.better
    ('peak |S| of the worst sensor', '1.57', 'low')
    """

    model: LinearModel
    controller: Controller
    poles: Poles
    stages: tuple[StagePeak, ...]
    bandwidth: Mapping[str, float]
    uncertainty: Mapping[str, float] = field(default_factory=dict)
    robust: Margin | None = None
    extent: Extent = NO_EXTENT
    current_loops: CurrentLoops = LAST_STAGE
    chain: tuple[ChainStage, ...] = ()
    disks: tuple[Disk, ...] = ()
    delay: Mapping[str, float] = field(default_factory=dict)
    gang: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    tolerance: Mapping[str, tuple[Margin, Margin]] = field(default_factory=dict)
    mass: Margin | None = None
    places: tuple[TravelPlace, ...] = ()
    worst: Mapping[str, Gain] = field(default_factory=dict)
    payload: Payload | None = None
    unmodelled: UnmodelledMargin | None = None
    requirements: tuple[Outcome, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def plant(self) -> Plant:
        """The machine."""
        return self.model.plant

    @property
    def loop(self) -> Loop:
        """The machine's loop, as simulations fly it."""
        return loop_of_model(self.model, self.controller)

    @property
    def left_out(self) -> str:
        """What the machine has and the last stage of the chain has not, in words; "": nothing."""
        return left_out(self.plant, self.controller, self.current_loops)

    @property
    def stable(self) -> bool:
        """Whether the machine's loop is stable."""
        return self.stages[-1].stable

    @property
    def peak_sensitivity(self) -> Mapping[str, float]:
        """The peak sensitivity of the machine's loop, by sensor and as sigma_max."""
        return self.stages[-1].peak_sensitivity

    @property
    def travel(self) -> Margin:
        """The margin anywhere in `extent`, `NOT_PROVEN` where it was not asked for."""
        return NOT_PROVEN if self.robust is None else self.robust

    @property
    def covers_travel(self) -> bool:
        """Whether the margin holds at every position of the travel, and not only at some."""
        return NOT_BETWEEN_TEXT not in self.travel.reason

    @property
    def places_covered(self) -> str:
        """Where the margin holds, in words: over all that is proven at once, or at the places that stand for it."""
        if self.covers_travel:
            return str(self.extent)
        if self.controller.schedule is not None:
            return f"at the places of {self.controller.schedule.variable}"
        return "in the middle and at the end of the travel"

    @property
    def classical(self) -> Classical | None:
        """Disk and delay margins and gang of four at the operating point; None for an unstable loop."""
        return self.loop.classical if self.stable else None

    @cached_property
    def recovery(self) -> tuple[Recovery, ...]:
        """The answer to each disturbance; none of an unstable loop, or where no load acts from outside."""
        return recovery(self.loop) if self.stable and self.plant.disturbances else ()

    @cached_property
    def noise(self) -> NoiseRms | None:
        """Motion and commands at rest, rms; None for an unstable loop."""
        return noise_of(self.loop.sampled, self.plant) if self.stable else None

    @cached_property
    def figures(self) -> tuple[Merit, ...]:
        """The figures of merit, in the order of their groups."""
        slow = (_margins, _complementary, _loads, _requirements)
        return in_groups([*self.quick_figures, *(found for part in slow for found in part(self))])

    def to_pandas(self) -> Any:
        """The figures of merit as a pandas.DataFrame: by key, with label, value and bound, SI.

        Raises InputError where pandas is not installed.
        """
        merits = self.figures
        columns = {
            name: [getattr(one, name) for one in merits] for name in ("label", "value", "bound", "note")
        }
        return data_frame(columns, ("figure", [one.identifier for one in merits]))

    @cached_property
    def quick_figures(self) -> tuple[Merit, ...]:
        """Those of them that need no frequency response and no proof: what a page shows at each move."""
        parts = (_sensitivities, _bandwidths, _noise)
        return tuple(found for part in parts for found in part(self))

    def __str__(self) -> str:
        lines = [f"{'stable' if self.stable else 'UNSTABLE'} {self.loop.contents}"]
        for stage in self.stages:
            own = {k: v for k, v in stage.peak_sensitivity.items() if k != "sigma_max"}
            peaks = "  ".join(f"{k} {v:.2f}" for k, v in own.items()) + f", zone {zone(max(own.values()))}"
            largest = stage.peak_sensitivity["sigma_max"]
            lines.append(
                f"peak |S|, {stage.name}: {peaks}  all {largest:.2f} ({20 * np.log10(largest):.1f} dB)"
            )
        for key, value in self.bandwidth.items():
            lines.append(f"bandwidth, {BANDWIDTHS[key]}: {value / (2 * np.pi):.2f} Hz ({value:.1f} rad/s)")
        if self.uncertainty:
            where = self.places_covered
            lines += [
                f"uncertainty: {box_words(self.uncertainty, self.plant.parameters)}",
                f"{f'robust {where}'.rstrip()}: {self.robust}",
            ]
        return "\n".join(lines)

    @property
    def description(self) -> Description:
        """What a reader looks for first, then every figure of merit."""
        state = "stable" if self.stable else "UNSTABLE"
        at = f"{self.controller.name!r} on {self.plant.name!r}"
        box = box_words(self.uncertainty, self.plant.parameters)
        rows = [("margin", f"{self.robust} of {box}")] if self.robust is not None else []
        shown = sorted(self.figures[1:], key=lambda one: one.kind not in FIRST_KINDS)
        rows += [(one.heading, one.text) for one in shown]
        rows = [("contents", self.loop.contents), *rows]
        return Description(f"Loop of {at}: {state}", tuple(rows), self._curves)

    @property
    def _curves(self) -> Curves | None:
        """The largest singular values of S and T over frequency; None for an unstable loop."""
        if not self.stable:
            return None
        w = np.geomspace(1.0, np.pi / self.controller.sample_time, CURVE)
        S = self.loop.sensitivity(w)
        sizes = {
            name: np.linalg.norm(G, 2, axis=(1, 2)) for name, G in (("S", S), ("T", np.eye(S.shape[-1]) - S))
        }
        return Curves(w, "frequency [rad/s]", sizes, "largest singular value [1]", logarithmic=True)


def _margins(a: LoopReport) -> Iterator[Merit]:
    yield figure("stable", "stable", "stable on the machine", float(a.stable))
    if a.robust is not None:
        where = f", {a.extent}" if str(a.extent) else ""
        lower = a.robust.lower or 0.0
        yield figure("margin_proven", "margin_proven", f"margin of parameters, proven{where}", lower)
        yield figure("margin_lost_at", "margin_lost_at", "lost at", a.robust.upper)
    classical = a.classical
    if classical is None:
        return
    for disk in classical.disks:
        signal = disk.channels.removesuffix(" alone") if disk.channels.endswith(" alone") else ""
        words = f"disk margin, {disk.channels}"
        kind = "disk_of" if signal else "disk"
        yield figure(kind, f"disk_margin {disk.channels}", words, disk.size, signal=signal)
    yield figure("delay_margin", "delay_margin", "delay margin, smallest", min(classical.delay.values()))
    if a.mass is not None and a.robust is not None:
        yield figure("mass_margin", "mass_margin", "mass margin, linear loop", a.mass.lower or 0.0)
    if a.payload is not None:
        yield figure("payload", "payload_held", "payload held at rest", a.payload.held)
        if not math.isnan(a.payload.carried):
            yield figure("payload", "payload_carried", "payload in flight", a.payload.carried)


def _sensitivities(a: LoopReport) -> Iterator[Merit]:
    peaks = a.peak_sensitivity
    sensors = {name: peak for name, peak in peaks.items() if name != "sigma_max"}
    worst = max(sensors.values()) if a.stable else math.nan
    yield figure("peak_s", "peak_sensitivity", "peak |S| of the worst sensor", worst)
    yield figure("peak_s", "peak_sensitivity_sigma_max", "peak sigma_max(S)", peaks["sigma_max"])
    for name, peak in sensors.items():
        yield figure("peak_s_of", f"peak_sensitivity {name}", f"peak |S| at {name}", peak, signal=name)


def _complementary(a: LoopReport) -> Iterator[Merit]:
    if a.classical is not None:
        largest = max(gang[1] for gang in a.classical.gang.values())
        yield figure("peak_t", "peak_complementary", "peak |T| of the worst sensor", largest)


def _bandwidths(a: LoopReport) -> Iterator[Merit]:
    for key, value in a.bandwidth.items():
        kind = "natural" if key.startswith("w_n") else "bandwidth"
        yield figure(kind, f"bandwidth_{key}", BANDWIDTHS[key], value)
    if len(a.poles.closed_loop) and a.stable:
        yield from pole_figures(a.poles.closed_loop)


def pole_figures(poles: ComplexArray) -> Iterator[Merit]:
    """The slowest decay and the smallest damping of a closed loop's poles, rad/s."""
    yield figure("slowest_pole", "slowest_pole", "decay of the slowest pole", -poles.real.max())
    damping = -poles.real / np.maximum(np.abs(poles), 1e-300)
    yield figure("damping", "smallest_damping", "smallest damping ratio", damping.min())


def _noise(a: LoopReport) -> Iterator[Merit]:
    if a.noise is None:
        return
    for signal, value in zip(a.plant.outputs, a.noise.motion, strict=True):
        fine, words = FINE_UNITS.get(signal.unit, signal.unit), f"motion {signal.name}, rms"
        yield figure("motion", f"motion {signal.name} rms", words, value, fine, signal.name)
    for signal, value in zip(a.plant.inputs, a.noise.force, strict=True):
        words = f"command {signal.name}, rms"
        yield figure("command", f"command {signal.name} rms", words, value, signal.unit, signal.name)


def _loads(a: LoopReport) -> Iterator[Merit]:
    units = {s.name: s.unit for s in a.plant.disturbances}
    for load, output in furthest(a.recovery):
        fine, name = FINE_UNITS.get(output.unit, output.unit), f"load {load.name}"
        size = f"1 {units[load.name]} {load.name}".replace("1 1 ", "1 ")
        settled = f"{size}: within 1 % after"
        peak = f"{size}: largest over frequency"
        moved, any_waveform = f"{size}: largest deviation", f"any waveform of {size}: at most"
        yield figure("load_any", f"{name} any waveform", any_waveform, output.any_waveform, fine, load.name)
        yield figure("load_moves", f"{name} largest", moved, output.largest, fine, load.name)
        yield figure("load_settles", f"{name} settles", settled, output.settled, signal=load.name)
        yield figure("compliance", f"{name} compliance", peak, output.compliance, fine, load.name)


def _requirements(a: LoopReport) -> Iterator[Merit]:
    asked = [one for one in a.requirements if one.asked is not None]
    if asked:
        kept = sum(one.holds for one in asked) / len(asked)
        yield figure("requirements", "requirements_held", "requirements held", kept, "percent")
        undecided = sum(one.verdict == "undecided" for one in asked) / len(asked)
        if undecided:
            name, words = "requirements_undecided", "requirements undecided"
            yield figure("undecided", name, words, undecided, "percent")
    for one in a.requirements:
        several = sum(other.name == one.name for other in a.requirements) > 1
        name, words = f"requirement {one.name}", one.words
        if several:
            name, words = f"{name} {one.how}", f"{words}, {one.how}"
        proven = one.name == "margin"
        kind = "proven" if proven else "at_least" if one.at_least else "at_most"
        unit = "percent" if proven else FINE_UNITS.get(one.unit, one.unit)
        yield figure(kind, name, words, one.found, unit, bound=one.asked)
