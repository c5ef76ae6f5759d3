"""What a page shows of a design: the record of its loop, the machine's main job, campaigns."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from malta.arrays import FloatArray
from malta.errors import CheckError, InputError
from malta.loops.curves import LoopCurves, loop_curves
from malta.loops.windings import LAST_STAGE
from malta.margins.loop_report import BANDWIDTH, BANDWIDTHS, LoopReport
from malta.merit_lists import in_groups
from malta.merits import Merit, figure
from malta.model.linear.parameters import is_linear
from malta.model.parameters import units_of
from malta.model.plant import Parameters, Plant, Signal
from malta.model.plants import plant_of
from malta.report.figures.drawing import micro, number
from malta.simulation.experiments import Experiment, progress_of_part, whole_experiment
from malta.simulation.experiments.catalogue import experiment, main_job
from malta.synthesis.spec import Pid, Spec, StructuredLaw, integral_signals, pid_signals, process_signals
from malta.synthesis.weighting import Weights
from malta.tuning.verify import verify, with_requirements
from malta.units import FINE_UNITS, identifier, in_unit
from malta.work import NO_TIME, WorkUp, is_stopped, share_time

if TYPE_CHECKING:
    from malta.campaigns.summary import Summary
    from malta.loops.windings import CurrentLoops
    from malta.margins.load_sizes import LoadLimit
    from malta.synthesis.controller import Controller

MARGIN_SHARE = 0.6  # of the time, for the margins; the rest is for the flights
Share = Callable[[float], None]  # takes the share of the work that is done, 0 to 1


class Subject(NamedTuple):
    """A controller on a machine, with what a page needs to know beside them."""

    controller: Controller
    parameters: Parameters  # of the machine, which need not be those of the controller
    box: Mapping[str, float] = {}  # parameter -> share, either way, at margin 1; empty: no such margin
    spec: Spec | None = None  # the design file, whose [specification] is judged
    source: str = ""  # the gain file, as the user named it
    changes: Sequence[str] = ()  # of the machine, as "m=0.56"
    provenance: Sequence[tuple[str, str]] = ()  # of the gain file: seal, and versions that wrote it
    current_loops: CurrentLoops = LAST_STAGE

    @property
    def written_from(self) -> Spec | None:
        """The design file that the gains were synthesized from; None where it is not known, or was changed since."""
        same = self.spec is not None and self.spec.sha256 == self.controller.spec_sha256
        return self.spec if same else None

    @property
    def plant(self) -> Plant:
        """The machine."""
        return plant_of(self.parameters)


@dataclass(frozen=True, eq=False)
class Analysis:
    """What is shown of one subject."""

    subject: Subject
    report: LoopReport
    job: Experiment | None  # None where it could not be simulated
    campaigns: Sequence[Summary]
    notes: Sequence[str]  # what could not be computed, and why
    loads: tuple[LoadLimit, ...] = ()  # of any waveform; none without a proof

    @property
    def plant(self) -> Plant:
        """The machine."""
        return self.report.plant

    @cached_property
    def curves(self) -> LoopCurves:
        """The curves of the machine's loop."""
        return loop_curves(self.report.loop)

    @cached_property
    def figures(self) -> tuple[Merit, ...]:
        """The figures of merit of the loop and of the main job, in the order of their groups."""
        of_loads = [figure_of_limit(one) for one in self.loads if one.safe.limit is not None]
        return in_groups([*self.report.figures, *of_loads, *(() if self.job is None else self.job.figures)])


def analyse(
    subject: Subject,
    *,
    proof: bool = True,
    stages: bool = True,
    spec: Spec | None = None,
    campaigns: Sequence[Summary] = (),
    progress: Share | None = None,
) -> Analysis:
    """Compute all that the pages show of a subject.

    proof : whether margins of the parameters are proven
    stages : whether every stage and each parameter alone has its margin, |S| its worst case, and each load its largest
        size of any waveform; otherwise the margin of all parameters at once is the only one
    spec : whose [specification] judges it; None: the subject's own
    progress : takes the share of the work that is done

    Raises CheckError when numbers overflow or no input holds the machine.
    """
    with share_time(MARGIN_SHARE):
        found = verify(
            subject.plant, subject.controller, subject.box, stages=stages, proof=proof,
            current_loops=subject.current_loops, progress=progress_of_part(progress, 0, 3),
        )  # fmt: skip
    notes: list[str] = []
    job = _main_job(subject, notes, progress_of_part(progress, 1, 3))
    found = with_requirements(
        found, spec or subject.spec, proof=proof, flights=True, progress=progress_of_part(progress, 2, 3)
    )
    loads = _limits_of_loads(found) if proof and stages else ()
    return Analysis(subject, found, job, tuple(campaigns), (*notes, *found.notes), loads)


def _limits_of_loads(found: LoopReport) -> tuple[LoadLimit, ...]:
    """How large each load may be, whatever its waveform; none of an unstable loop, or where no load acts."""
    if not (found.stable and found.plant.disturbances) or is_stopped():
        return ()
    from malta.margins.load_sizes import load_limits  # ball arithmetic: not for pages without a proof

    return load_limits(found.loop, courses=True)


def figure_of_limit(found: LoadLimit) -> Merit:
    """The largest size of a load that is proven, as a figure of merit."""
    safe = found.safe
    words = f"any waveform of {safe.disturbance}: touches and saturates nothing up to"
    return figure(
        "load_safe", f"load {safe.disturbance} safe", words, safe.limit or 0.0, safe.unit, safe.disturbance
    )


def _main_job(subject: Subject, notes: list[str], progress: Share | None) -> Experiment | None:
    """The machine's main job; None, with a note, where it cannot be simulated."""
    plant = subject.plant
    name = main_job(plant)
    if is_stopped():
        notes.append(f"{name} was not simulated: {NO_TIME}")
        return None
    try:
        return whole_experiment(experiment(name, plant, subject.controller, progress=progress))
    except (InputError, CheckError) as error:
        notes.append(f"{name} was not simulated: {error}")
    except WorkUp:
        notes.append(f"{name} was not simulated to its end: {NO_TIME}")
    return None


# What a design is, entry by entry: machine, law, weights, noise, gains. Reports list it, comparisons seek changes.


# Units for values below a size, SI, the smallest first.
FINER_UNITS: dict[str, tuple[tuple[str, float], ...]] = {
    "s": (("us", 1e-3), ("ms", 1.0)),
    "m": (("um", 1e-4), ("mm", 1.0)),
    "rad": (("urad", 1e-4), ("mrad", 0.1)),
}


GROUPS = (
    *(
        "machine",
        "parameters",
        "uncertainty",
        "law",
        "PID gains",
        "elements of the law",
        "weights",
        "bases",
        "cost",
        "noise",
        "gains",
    ),
    "limits",
)


class FileEntry(NamedTuple):
    """A number or a word of a design, as it stands in its files."""

    group: str  # of GROUPS
    name: str
    value: float | str  # SI
    unit: str = ""
    signal: str = ""  # in the name, of an entry that each signal has

    @property
    def key(self) -> str:
        """The entry as an identifier with its unit."""
        return identifier(f"{self.group} {self.name}", self.unit)

    def text(self, unit: str) -> str:
        """The value in a unit of display, with six digits."""
        if isinstance(self.value, str):
            return self.value
        return f"{in_unit(self.value, unit) if unit else self.value:.6g}"

    def equals(self, other: FileEntry | None) -> bool:
        """Whether another design has the same value, but for rounding."""
        if other is None or isinstance(self.value, str) or isinstance(other.value, str):
            return other is not None and self.value == other.value
        return bool(np.isclose(self.value, other.value, rtol=1e-9, atol=0.0))


def display_unit(unit: str, values: Iterable[float | str]) -> str:
    """The unit in which some values of an SI unit have few digits: "us" of 5e-5 s."""
    sizes = [abs(value) for value in values if not isinstance(value, str) and value]
    small = (fine for fine, size in FINER_UNITS.get(unit, ()) if sizes and max(sizes) < size)
    return next(small, unit)


def kind_of(controller: Controller) -> str:
    """The kind of a control law in a word."""
    if controller.cost is not None:
        return "LQG"
    return "linear law of the errors" if controller.tracks == "errors" else "PID"


def design_entries(subject: Subject) -> list[FileEntry]:
    """List what a design is: the machine, the law, its weights and its noise, the size of its gains."""
    parts = (_machine, _law, _weights, _noise_entries, _gains, _limits)
    return sorted((entry for part in parts for entry in part(subject)), key=lambda e: GROUPS.index(e.group))


def _machine(subject: Subject) -> Iterator[FileEntry]:
    parameters = subject.parameters
    yield FileEntry("machine", "name", "linear" if is_linear(parameters) else subject.plant.name)
    yield FileEntry("machine", "preset", parameters.preset)
    for name, unit in units_of(parameters).items():
        yield FileEntry("parameters", name, float(getattr(parameters, name)), unit)
    for name, share in subject.box.items():
        yield FileEntry("uncertainty", name, share, "1")


def _sums(c: Controller) -> str:
    """The outputs whose errors a law integrates: "yes" for all of them, "" for none."""
    if len(c.summed) == len(c.measurements):
        return "yes"
    return " ".join(c.measurements[k].name for k in c.summed)


def _law(subject: Subject) -> Iterator[FileEntry]:
    c = subject.controller
    yield FileEntry("law", "kind", kind_of(c))
    yield FileEntry("law", "sample time", c.sample_time, "s")
    yield FileEntry("law", "delay in the design model [samples]", float(c.delay), "1")
    yield FileEntry("law", "lag of the current loops in the design model", "yes" if c.lagging else "no")
    yield FileEntry("law", "integrals of errors", _sums(c) or "no")
    yield FileEntry("law", "observed forces of disturbance", "yes" if c.observed else "no")
    yield FileEntry("law", "commutation", "measured place" if c.commutation is None else "predicted place")
    spec = subject.written_from
    if spec is not None and spec.kind == "LQG":
        yield FileEntry("law", "discretization", spec.discretization)
    for signal, pause in zip(c.measurements, c.pause, strict=False):
        if pause:
            name, unit = f"integral of {signal.name} waits above", f"{signal.unit}/s"
            yield FileEntry("law", name, float(pause), unit, signal.name)
    for signal, error in zip(c.measurements, c.braking, strict=False):
        if error:
            yield FileEntry("law", f"{signal.name} brakes from", float(error), signal.unit, signal.name)
    for words, per, row in zip(
        ("reference", "speed", "acceleration"), ("", "/s", "/s^2"), c.references, strict=False
    ):
        for signal, limit in zip(c.measurements, row, strict=True):
            if limit:
                yield FileEntry(
                    "law",
                    f"largest {words} of {signal.name}",
                    float(limit),
                    f"{signal.unit}{per}",
                    signal.name,
                )
    if c.current_loop is not None:
        yield FileEntry("law", "current loop Kp", c.current_loop.Kp, "V/A")
        yield FileEntry("law", "current loop Ki", c.current_loop.Ki, "V / (A s)")


def _weights(subject: Subject) -> Iterator[FileEntry]:
    c, plant = subject.controller, subject.plant
    law = None if subject.written_from is None else subject.written_from.law
    if isinstance(law, Pid):
        for table, signals in pid_signals(plant, law.axes).items():
            plain = [Signal(s.name, re.sub(r"\((\w+)\)", r"\1", s.unit).replace(" / ", "/")) for s in signals]
            yield from _row("PID gains", f"{table} ", plain, getattr(law, table))
    elif isinstance(law, StructuredLaw):
        for element in law.elements:
            for key, value in element.numbers.items():
                if isinstance(value, float):
                    unit = re.sub(r"\((\w+)\)", r"\1", element.units[key]).replace(" / ", "/")
                    yield FileEntry("elements of the law", f"{element.name} {key}", value, unit)
    elif isinstance(law, Weights):
        integrals = integral_signals(plant, law.coordinates)
        for table, states, weight, base in (
            ("state", plant.design_states, law.q, law.q_base),
            ("input", plant.inputs, law.r, law.r_base),
            ("integral", integrals, law.q_i, law.q_i_base),
        ):
            plain = [Signal(s.name, "1") for s in states]
            yield from _row("weights", f"{table} ", plain, weight)
            yield from _row("bases", f"{table} ", states, base)
    elif c.cost is not None:
        integrals = integral_signals(plant, c.cost.coordinates)
        for table, states, cost in (
            ("state", plant.design_states, c.cost.state),
            ("input", plant.inputs, c.cost.input),
            ("integral", integrals, c.cost.integral),
        ):
            squares = [Signal(s.name, _over_square(s.unit)) for s in states]
            yield from _row("cost", f"{table} ", squares, cost)


def _over_square(unit: str) -> str:
    """The unit of a weight on a square: "1/m^2" of m, "1/(m/s)^2" of m/s."""
    if unit == "1":
        return unit
    return f"1/{unit}^2" if unit.isalpha() else f"1/({unit})^2"


def _noise_entries(subject: Subject) -> Iterator[FileEntry]:
    noise, cost, plant = subject.controller.noise, subject.controller.cost, subject.plant
    if noise is None or cost is None:
        return
    sources = process_signals(plant, cost.coordinates)
    yield from _row("noise", "process ", sources, np.sqrt(noise.process))
    yield from _row("noise", "sensor ", plant.outputs, np.sqrt(noise.sensor))
    yield from _row("noise", "drift ", sources, np.sqrt(noise.drift))
    plain = [Signal(s.name, "1") for s in sources]
    yield from _row("noise", "correlation ", plain, noise.correlation)


def _gains(subject: Subject) -> Iterator[FileEntry]:
    for name in ("K", "Ki", "L"):
        yield FileEntry(
            "gains", f"norm of {name}", float(np.linalg.norm(getattr(subject.controller, name))), "1"
        )
    yield FileEntry("gains", "states of the law", float(len(subject.controller.states)), "1")


def _limits(subject: Subject) -> Iterator[FileEntry]:
    c = subject.controller
    for signal, limit in zip(c.forces, c.limits.force, strict=True):
        if np.isfinite(limit):
            yield FileEntry("limits", signal.name, float(limit), signal.unit, signal.name)


def _row(group: str, prefix: str, signals: Sequence[Signal], values: FloatArray) -> Iterator[FileEntry]:
    """An entry for each signal that has a value; none of an empty vector."""
    for signal, value in zip(signals, values, strict=False):
        yield FileEntry(group, f"{prefix}{signal.name}", float(value), signal.unit, signal.name)


# The top of a report: its key figures, and what the design is in words.


MERITS = 3  # of the main job, on the first screen


class KeyFigure(NamedTuple):
    """A figure that a reader looks for first."""

    label: str
    value: str
    note: str = ""
    state: str = ""  # "good", "near", "bad" or ""


def key_figures(a: Analysis) -> list[KeyFigure]:
    """List the figures that a reader looks for after the verdict: bandwidth, noise, loads, main job."""
    parts = (_bandwidth, _noise, _any_load, _job)
    return [figure for part in parts for figure in part(a)]


def _bandwidth(a: Analysis) -> Iterator[KeyFigure]:
    value = a.report.bandwidth.get(BANDWIDTH, math.nan)
    if math.isfinite(value):
        note = f"{number(value)} rad/s, {BANDWIDTHS[BANDWIDTH]}"
        yield KeyFigure("Bandwidth", f"{number(value / (2 * math.pi), 3)} Hz", note)


def _noise(a: Analysis) -> Iterator[KeyFigure]:
    noise = a.report.noise
    if noise is None or not (np.any(noise.motion) or np.any(noise.force)):
        return
    for values, signals, label in (
        (noise.motion, a.plant.outputs, "Motion at rest"),
        (noise.force, a.plant.inputs, "Commands at rest"),
    ):
        largest: dict[str, tuple[float, str]] = {}  # by unit
        for signal, value in zip(signals, values.tolist(), strict=True):
            largest[signal.unit] = max(largest.get(signal.unit, (0.0, "")), (value, signal.name))
        texts = []
        for unit, (value, _) in largest.items():
            fine = FINE_UNITS.get(unit, unit)
            shown = "" if fine == "1" else f" {micro(fine)}".replace(" ", "\N{NO-BREAK SPACE}")
            texts.append(f"{number(in_unit(value, fine), 3)}{shown}")
        names = ", ".join(name for _, name in largest.values())
        yield KeyFigure(label, " · ".join(texts), f"rms of the worst: {names}")


def _any_load(a: Analysis) -> Iterator[KeyFigure]:
    proven = sorted(
        (one for one in a.loads if one.safe.limit is not None), key=lambda one: -(one.safe.limit or 0.0)
    )
    smallest = {one.safe.unit: one for one in proven}
    if smallest:
        value = " · ".join(f"{one.proven.text(3)} {one.safe.unit}" for one in smallest.values())
        names = ", ".join(one.safe.disturbance for one in smallest.values())
        yield KeyFigure(
            "Any load, touching nothing", value, f"proven, of any waveform: {names} is the smallest"
        )


def _job(a: Analysis) -> Iterator[KeyFigure]:
    if a.job is None:
        return
    outcome, label = a.job.outcome, a.job.name.replace("-", " ").replace("_", " ").capitalize()
    state = "bad" if a.job.failed else "good"
    short = "completed" if not a.job.failed else outcome
    fidelity = f"simulated, fidelity {a.job.run.scenario.fidelity}"
    yield KeyFigure(label, short, outcome if short != outcome and a.job.failed else fidelity, state)
    for merit in a.job.merits[:MERITS]:
        if math.isfinite(merit.value) and not a.job.failed:
            yield KeyFigure(merit.label.capitalize(), merit.phrase(), label.lower())


def summary_sentences(a: Analysis) -> list[str]:
    """Say in words what the design is."""
    c, plant = a.subject.controller, a.plant
    rate = (
        f"at {1e-3 / c.sample_time:g} kHz" if c.sample_time <= 1e-3 else f"every {c.sample_time * 1e3:g} ms"
    )
    law = kind_of(c)
    article = "An" if law == "LQG" else "A"
    what = f"{law} controller" if law.isupper() else law
    text = f"{article} {what} of the machine {plant.name}, preset {a.subject.parameters.preset}: "
    text += f"{_count(len(c.measurements), 'measurement')} and {_count(len(c.forces), 'command')} {rate}, "
    text += f"{_count(len(c.states), 'state')}."
    sentences = [text]
    parts = []
    if c.integrating:
        whole = len(c.summed) == len(c.measurements)
        parts.append("integrates the errors" if whole else f"integrates the errors of {_sums(c)}")
    if c.observed:
        parts.append("estimates constant disturbance forces")
    if c.lagging:
        parts.append("models the lag of the current loops")
    if c.delay:
        parts.append(f"models a delay of {_count(c.delay, 'sample')}")
    if c.commutation is not None:
        parts.append("commutates for the predicted position")
    if parts:
        sentences.append(f"It {_list_in_words(parts)}.")
    if plant.has_stroke:
        sentences.append(f"The travel of {plant.stroke.name} is ±{in_unit(plant.stroke.travel, 'mm'):g} mm.")
    spec = a.subject.written_from
    if spec is not None and spec.summary:
        sentences.insert(0, f"{spec.summary.rstrip('.')}.")
    if a.subject.changes:
        sentences.append(
            f"The machine is changed: {', '.join(a.subject.changes)}; the controller is not told."
        )
    if not a.report.stable:
        sentences.append("The loop is UNSTABLE on this machine: it has no sensitivities, margins or noise.")
    return sentences


def _count(number_of: float, what: str) -> str:
    return f"{number_of:g} {what}{'' if number_of == 1 else 's'}"


def _list_in_words(parts: Sequence[str]) -> str:
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
