"""Commissioning: the checklist of the first day as steps, each with a log, findings and limits, and a signed journal.

A step records a log, on the simulated machine or from a file of a bench, and judges it by the gain file alone. The
journal keeps what passed, so that an interrupted day goes on where it stopped. A machine offers its own steps as
`commissioning_steps(box)` beside its experiments; others have those of `general_steps`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from malta.display import Description, display, quantity
from malta.errors import CheckError, InputError
from malta.files import file_exists, read_file
from malta.gains.file import content_of
from malta.identification.calibration import Interval95, at_rest
from malta.identification.excite import cut_loop, output_bands
from malta.identification.learn import FACTORS, learn, own_stroke
from malta.identification.log import Log, log_of
from malta.identification.log_files import OTHER_SUFFIXES, read_log, write_log
from malta.identification.measure import measure, plan_measurement
from malta.identification.noise import dc_log, noise_table, process_noise
from malta.identification.signal_checks import machine_findings, require_signals
from malta.identification.spectra import in_axes
from malta.identification.strokes import stroke_of
from malta.identification.windings import identify_windings
from malta.loops.classical import disk_sizes
from malta.loops.loop import Loop, loop
from malta.model.parts import attribute_of
from malta.model.plant import Plant
from malta.model.plants import plant_of
from malta.simulation import references
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import simulate
from malta.synthesis.controller import Controller
from malta.writing import json_text, replace_files

JOURNAL = "journal.json"
MAX_JOURNAL_BYTES = 10_000_000  # bytes of a journal
VERSION = 1
ENDS = ("completed", "not lifted")  # of flights in which nothing went wrong
MAX_NOISE_RATIO = 1.5  # times the noise and steps of a sensor that the gain file believes
REST_SAMPLES = 2000  # samples of a rest: noise is told to 4 %
ERROR = 0.1  # of the travel: the largest error of a stroke
DRIVE = (0.7, 1.3)  # of R and L: copper that is 75 K warmer has 1.3 times the resistance
CURRENT_MARGIN = 0.5  # rad, least phase margin of the current loops
MIN_DISK_MARGIN = 0.2  # disk margin of all sensors
SLACK = 1.2  # times what a design promises, where that is less than what a new machine is asked for
MAX_PEAK = 3.0  # largest |S|: the end of zone A of ISO 14839-3, which a new machine is asked for


class StepFinding(NamedTuple):
    """A figure of a step with its interval, and the limits between which all of it has to be, SI."""

    name: str
    found: Interval95
    low: float = -math.inf
    high: float = math.inf

    @property
    def holds(self) -> bool:
        """Whether the whole interval is within the limits."""
        return (
            self.low <= self.found.value - self.found.half and self.found.value + self.found.half <= self.high
        )


class Bench(NamedTuple):
    """Where steps record: a machine that the gain file does not know, under its law. Judges do not see it."""

    controller: Controller
    truth: Plant
    errors: Mapping[str, float]  # of its sensors, SI
    seed: int


class Check(NamedTuple):
    """A line of the checklist.

    name : of one word
    question : that it answers
    needs : what has to be there
    aborts : at what it ends early
    record : on the simulated machine
    judge : (controller, log) -> findings
    """

    name: str
    question: str
    needs: str
    aborts: str
    record: Callable[[Bench], Log]
    judge: Callable[[Controller, Log], Sequence[StepFinding]]


@dataclass(frozen=True)
class JournalEntry:
    """What a step found: its log with its sha256, findings, and why it was refused; "": it was judged."""

    name: str
    question: str
    log: str
    sha256: str
    findings: tuple[StepFinding, ...] = ()
    refusal: str = ""

    @property
    def passed(self) -> bool:
        """Whether it was judged and all findings are within their limits."""
        return not self.refusal and all(one.holds for one in self.findings)


@display
@dataclass(frozen=True)
class Commissioning:
    """A day's journal: entries in the order of the checklist, as far as they went.

    gains : the gain file
    sha256 : of it
    machine : its name
    bench : digest of the simulated machine; "" where logs are a bench's own
    entries : by step
    steps : names of all steps of the checklist
    kept : names of steps whose entries are those of an earlier run
    """

    gains: str
    sha256: str
    machine: str
    bench: str
    entries: tuple[JournalEntry, ...]
    steps: tuple[str, ...]
    kept: tuple[str, ...] = field(default=(), compare=False)

    @property
    def passed(self) -> bool:
        """Whether all steps were gone and passed."""
        return len(self.entries) == len(self.steps) and all(entry.passed for entry in self.entries)

    @property
    def failed(self) -> JournalEntry | None:
        """The first step that did not pass; None where all that were gone did."""
        return next((entry for entry in self.entries if not entry.passed), None)

    @property
    def left(self) -> tuple[str, ...]:
        """Steps that were not gone."""
        gone = {entry.name for entry in self.entries}
        return tuple(name for name in self.steps if name not in gone)

    @property
    def document(self) -> dict[str, Any]:
        """The journal as JSON holds it, without its signature."""
        entries = [
            {"step": e.name, "question": e.question, "log": e.log, "sha256": e.sha256, "refusal": e.refusal}
            | {"findings": [_finding_table(one) for one in e.findings]}
            for e in self.entries
        ]
        return {
            "schema": "malta-commissioning-journal",
            "version": VERSION,
            "gains": self.gains,
            "sha256": self.sha256,
            "machine": self.machine,
            "bench": self.bench,
            "steps": list(self.steps),
            "entries": entries,
        }

    @property
    def signature(self) -> str:
        """The sha256 of the journal with those of the gain file and of all logs: it changes with any of them."""
        text = json.dumps(json.loads(json_text(self.document)), sort_keys=True, separators=(",", ":"))
        return sha256(text.encode()).hexdigest()

    @property
    def description(self) -> Description:
        """Which steps passed."""
        states = [f"{e.name} {'passed' if e.passed else 'FAILED'}" for e in self.entries]
        rows = (
            ("gain file", f"{self.gains}, sha256 {self.sha256[:16]}"),
            ("steps", ", ".join(states) or "none"),
            ("left", ", ".join(self.left) or "none"),
            ("signature", self.signature),
        )
        return Description(f"Commissioning of a {self.machine}", rows)


def _finding_table(one: StepFinding) -> dict[str, Any]:
    value, half, unit = one.found
    return {"name": one.name, "value": value, "half": half, "unit": unit, "low": one.low, "high": one.high}


def commission(
    gains: str | Path,
    controller: Controller,
    folder: str | Path,
    *,
    truth: Plant | None = None,
    errors: Mapping[str, float] | None = None,
    logs: str | Path | None = None,
    reading: Mapping[str, Any] | None = None,
    steps: Sequence[Check] | None = None,
    only: Sequence[str] = (),
    skip: Sequence[str] = (),
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Commissioning:
    """Go through the checklist until a step fails, and write a log for each and the journal.

    Steps that are named alone or left out do not end the day; what the journal has of them, and of steps after one that
    fails now, stays.

    gains : the gain file, whose sha256 is signed
    controller : what it holds
    folder : for logs and journal; steps that passed in it with these gains and logs are kept
    truth : the simulated machine; None: that of the gain file
    errors : of its sensors by name, SI
    logs : folder of a bench with logs NAME.npz, .csv, .mat or of another suffix of the steps; a step without one waits
        for it. None: the simulated machine
    reading : arguments of `read_log`, where other programs wrote the logs
    steps : None: those of the machine
    only, skip : names of steps that are gone alone, again where they were, and that are left out
    seed : of the noise
    progress : called with the name of each step that begins

    Returns a Commissioning. Raises InputError for a damaged journal, a folder that cannot be written, and a name that
    no step has.

        commission("design/gains/robust.json", controller, "build/day")
    """
    path, folder = Path(gains), Path(folder)
    digest = _digest(path)
    if logs is not None and not Path(logs).is_dir():
        raise InputError(logs, "", "no such folder", "one with a log for each step")
    plant = plant_of(controller.parameters)
    box = content_of(path)[0].uncertainty or {}
    list_of = tuple(steps if steps is not None else steps_of(plant, box))
    bench = Bench(controller, truth or plant, dict(errors or {}), seed)
    simulated = "" if logs else _digest_of(bench)
    entries: list[JournalEntry] = []
    kept: list[str] = []
    done = Commissioning(str(path), digest, plant.name, simulated, (), tuple(step.name for step in list_of))
    for option, names in (("--step", only), ("--skip", skip)):
        for name in names:
            if name not in done.steps:
                raise InputError(option, "", repr(name), f"one of {' '.join(done.steps)}")
    before = {} if logs and not (only or skip) else _entries_before(folder, done)
    for step in list_of:
        entry, wanted = before.get(step.name), step.name in (only or done.steps) and step.name not in skip
        wanted = wanted and done.failed is None
        if entry is None and not wanted:
            continue
        if entry is None or (wanted and (only or logs)):
            if progress is not None:
                progress(step.name)
            if logs is None:
                entry = _record_step(step, bench, folder)
            else:
                others = {one.sha256: one.name for one in entries if one.sha256}
                entry = _read_step(step, controller, Path(logs), partial(read_log, **(reading or {})), others)
        else:
            kept.append(step.name)
        entries.append(entry)
        done = replace(done, entries=tuple(entries), kept=tuple(kept))
        content = json_text(done.document | {"signature": done.signature})
        replace_files({folder / JOURNAL: content.encode()})
    return done


def steps_of(plant: Plant, box: Mapping[str, float]) -> tuple[Check, ...]:
    """The checklist of a machine, its own or else the general one; box: share by which each parameter may differ."""
    own: Callable[[Mapping[str, float]], tuple[Check, ...]] | None
    own = attribute_of(plant, "experiments", "commissioning_steps")
    return general_steps(plant, box) if own is None else own(box)


def _record_step(step: Check, bench: Bench, folder: Path) -> JournalEntry:
    """Record the log of a step, and judge it."""
    try:
        path = write_log(step.record(bench), folder / f"{step.name}.npz")
    except CheckError as error:
        return JournalEntry(step.name, step.question, "", "", (), str(error))
    return _judge_step(step, bench.controller, path, read_log(path))


def _read_step(
    step: Check, controller: Controller, logs: Path, read: Callable[[Path], Log], others: Mapping[str, str]
) -> JournalEntry:
    """Judge a bench's log of a step. others : the steps before it, by the digests of their logs"""
    found = [logs / f"{step.name}{suffix}" for suffix in (".npz", ".csv", ".mat", *OTHER_SUFFIXES)]
    path = next((file for file in found if file.exists()), found[0])
    if not path.exists():
        return JournalEntry(step.name, step.question, str(path), "", (), f"waits for {path}: {step.needs}")
    try:
        log = read(path)
    except CheckError as error:
        return JournalEntry(step.name, step.question, "", "", (), str(error))
    refusal = _mistake_of(controller, log, others)
    if refusal:
        return JournalEntry(step.name, step.question, str(path), log.sha256, (), f"{path}: {refusal}")
    return _judge_step(step, controller, path, log)


def _mistake_of(controller: Controller, log: Log, others: Mapping[str, str]) -> str:
    """What is wrong with a bench's log whatever its step asks, named; "": nothing."""
    plant = plant_of(controller.parameters)
    if log.sha256 in others:
        return f"it is the log of step {others[log.sha256]}"
    beyond = machine_findings(in_axes(log, plant), plant)
    try:
        require_signals(controller, plant, log)
    except InputError as error:
        return str(error).removeprefix(f"{log.source}: ")
    return beyond[0] if beyond else ""


def _judge_step(step: Check, controller: Controller, path: Path, log: Log) -> JournalEntry:
    try:
        findings = tuple(step.judge(controller, log))
    except CheckError as error:
        return JournalEntry(step.name, step.question, str(path), log.sha256, (), str(error))
    return JournalEntry(step.name, step.question, str(path), log.sha256, findings)


def _digest(path: Path) -> str:
    return sha256(read_file(path, "file", Path.read_bytes)).hexdigest()


def _digest_of(bench: Bench) -> str:
    """A digest of the simulated machine: its parameters, the errors of its sensors, and the seed."""
    text = f"{bench.truth.parameters!r} {sorted(bench.errors.items())!r} {bench.seed}"
    return sha256(text.encode()).hexdigest()


def _entries_before(folder: Path, now: Commissioning) -> dict[str, JournalEntry]:
    """The entries of a journal that passed with these gains on this bench, and whose logs are as they were.

    Raises InputError for a file that holds no journal, or a journal with another signature.
    """
    path = folder / JOURNAL
    if not path.exists():
        return {}
    done, signature = read_journal(path)
    if done.signature != signature:
        raise InputError(path, "signature", signature[:16], f"{done.signature[:16]}, that of its entries")
    if (done.sha256, done.bench) != (now.sha256, now.bench):
        return {}
    kept = {}
    for entry in done.entries:
        log = Path(entry.log)
        if entry.passed and file_exists(log) and log.is_file() and _digest(log) == entry.sha256:
            kept[entry.name] = entry
    return kept


def read_journal(path: Path) -> tuple[Commissioning, str]:
    """A journal and the signature that stands in it. Raises InputError for a file of another kind."""
    try:
        content = json.loads(read_file(path, "journal", Path.read_bytes, MAX_JOURNAL_BYTES))
        entries = []
        for e in content["entries"]:
            findings = tuple(_finding_of(one) for one in e["findings"])
            name, question, log, digest, refusal = (
                str(e[key]) for key in ("step", "question", "log", "sha256", "refusal")
            )
            entries.append(JournalEntry(name, question, log, digest, findings, refusal))
        gains, digest, machine, bench = (str(content[key]) for key in ("gains", "sha256", "machine", "bench"))
        if content["version"] != VERSION:
            raise InputError(path, "version", str(content["version"]), str(VERSION))
        done = Commissioning(gains, digest, machine, bench, tuple(entries), tuple(map(str, content["steps"])))
        return done, str(content["signature"])
    except InputError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise InputError(
            path, "", "no journal, or a damaged one", "one that malta commission wrote"
        ) from error


def _finding_of(table: Mapping[str, Any]) -> StepFinding:
    ends = {"low": -math.inf, "high": math.inf} | {
        k: _number_of(table[k]) for k in ("low", "high") if table[k] is not None
    }
    value, half = (math.nan if table[k] is None else _number_of(table[k]) for k in ("value", "half"))
    return StepFinding(str(table["name"]), Interval95(value, half, str(table["unit"])), **ends)


def _number_of(entry: Any) -> float:
    """A number as it is written: a whole one stays whole, since the signature is of its text."""
    return entry if isinstance(entry, int) and abs(float(entry)) < math.inf else float(entry)


def fly(bench: Bench, scenario: Scenario, *, ends: Iterable[str] = ENDS) -> Log:
    """Fly a scenario with the bench's noise, steps and errors of sensors. Raises CheckError where it ends otherwise."""
    own: dict[str, Any] = {"noise": 1.0, "quantize": True, "seed": bench.seed}
    own["sensor_errors"] = dict(bench.errors) or None
    own |= {} if bench.truth.actuator.windings is not None else {"fidelity": "force"}
    run = simulate(bench.truth, bench.controller, scenario.replace(**own))
    if run.verdict.name not in ends:
        raise CheckError(f"{scenario.name}: {run.verdict}")
    return log_of(run)


def general_steps(plant: Plant, box: Mapping[str, float]) -> tuple[Check, ...]:
    """The checklist of any machine that levitates: rest in flight, the loop, and a stroke where it has one."""
    noise = Check(
        "still", "Do the sensors read as quietly as the filter believes?", "the mover held at its place",
        "touchdown", _record_still, judge_noise,
    )  # fmt: skip
    steps = (noise, noise_step(plant=plant), loop_step(box))
    return (*steps, stroke_step()) if plant.has_stroke else steps


def record_noise(bench: Bench) -> Log:
    """The log of `dc_log` on the bench."""
    return dc_log(bench.truth, bench.controller.name, bench.controller.sample_time, seed=bench.seed)


def noise_step(record: Callable[[Bench], Log] = record_noise, plant: Plant | None = None) -> Check:
    """The step that measures the noise of the current sensors, and what it makes of the forces.

    plant : without windings, a tenth of what its coils may have flows; None: 1 A
    """
    flows, most, where = "1 A", "a current above 2 A", "phase"
    if plant is not None and plant.actuator.windings is None and plant.actuator.coils:
        limit, unit = plant.actuator.current_limit, plant.actuator.coils[0].unit
        flows, most, where = quantity(limit / 10, unit), f"more than {quantity(limit / 5, unit)}", "coil"
    return Check(
        "noise", "What noise do the currents make of the forces?",
        f"mover out or clamped, {flows} dc in each {where}", most, record, judge_currents,
    )  # fmt: skip


def judge_currents(controller: Controller, log: Log) -> list[StepFinding]:
    """The noise of each force by that of the measured currents.

    Of a log without currents, the process noise that the filter was designed for stands, and is named so.
    """
    found = process_noise(plant_of(controller.parameters), log)
    if found:
        return [StepFinding(f"noise of {name}", e) for name, e in found.items()]
    what = "no current sensors: the largest process noise that the gain file has"
    if controller.noise is None:
        return [StepFinding(what, Interval95(0.0, 0.0))]
    force = int(controller.noise.process.argmax())
    own = float(np.sqrt(controller.noise.process[force]))
    return [StepFinding(what, Interval95(own, 0.0, controller.forces[force].unit))]


def noise_of_design(done: Commissioning, controller: Controller) -> str:
    """The [noise] of a design file by the logs at rest and of the currents; "" where there are none."""
    logs = {e.name: Path(e.log) for e in done.entries if e.passed}
    still, dc = logs.get("rest", logs.get("still")), logs.get("noise")
    if still is None or dc is None:
        return ""
    process = process_noise(plant_of(controller.parameters), read_log(dc))
    sensor = {name: deviation for name, (_, deviation) in at_rest(read_log(still)).items()}
    return noise_table(process, sensor, f"{dc.name}, {still.name}") if process else ""


def _record_still(bench: Bench) -> Log:
    """So many samples that noise is told to a few percent, and ten turns of what the slowest loop follows."""
    Ts, band = bench.controller.sample_time, output_bands(_own_loop(bench.controller))
    return fly(bench, Scenario("still", max(REST_SAMPLES * Ts, 10 / float(band.min())), references.hold))


def stroke_step() -> Check:
    """The step that flies a stroke, and learns from it."""
    return Check(
        "stroke", "Does it follow a stroke, and with which thrust?", "the travel free, |S| as predicted",
        "touchdown, end stop, current limit", _record_stroke, judge_stroke,
    )  # fmt: skip


def judge_noise(controller: Controller, log: Log) -> list[StepFinding]:
    """The noise of each position sensor beside the gain file's. Raises InputError for a log that lacks one."""
    plant = plant_of(controller.parameters)
    log.table("y", [s.name for s in plant.outputs])
    found = at_rest(log)
    return [
        StepFinding(
            f"noise of {s.name}", found[s.name][1], 0.0, MAX_NOISE_RATIO * math.hypot(noise, step) + 1e-12
        )
        for s, noise, step in zip(plant.outputs, plant.sensors.noise, plant.sensors.resolution, strict=True)
    ]


def loop_step(box: Mapping[str, float], **options: Any) -> Check:
    """The step that measures the loop; `options` are those of `malta.excite`."""
    return Check(
        "loop", "Is the loop as predicted, and in zone A?", "the mover in flight, the excitation in the law",
        "touchdown, a force at its limit", partial(_record_loop, options), partial(judge_loop, box=box),
    )  # fmt: skip


def _own_loop(controller: Controller) -> Loop:
    """The loop of the gain file's own machine."""
    return loop(plant_of(controller.parameters), controller)


def _record_loop(options: Mapping[str, Any], bench: Bench) -> Log:
    plan = plan_measurement(_own_loop(bench.controller), **options).excitations[0]
    return fly(bench, Scenario.excited(plan.signal, plan.duration))


def judge_loop(controller: Controller, log: Log, box: Mapping[str, float]) -> list[StepFinding]:
    """The largest |S| of each sensor and the disk margin.

    box : parameters that are uncertain, each with its share; without any, |S| is compared with no prediction

    The limits are zone A and a disk margin of 0.2. Of a design that promises less, |S| may be 1.2 times what it
    promises over the box, and the interval of the disk margin has to be above 0.

    Raises CheckError where another law flew, or |S| or |T| is not as predicted.
    """
    found = measure(controller, log, uncertainty=box)
    if found.refusal:
        raise CheckError(f"{log.source}: {found.refusal}")
    peaks = []
    for k, (name, (value, high, _)) in enumerate(found.peaks.items()):
        own = float(found.S.high[:, k].max())
        what, most = ("", MAX_PEAK) if own < MAX_PEAK else (f", {own:.3g} by design", SLACK * own)
        peaks.append(StepFinding(f"largest |S| of {name}{what}", Interval95(value, high - value), 0.0, most))
    (disk, low), own = found.disks[-1], float(disk_sizes(cut_loop(_own_loop(controller), found.w).S).min())
    what, least = ("", MIN_DISK_MARGIN) if own > SLACK * MIN_DISK_MARGIN else (f", {own:.3g} by design", 0.0)
    margin = StepFinding(f"disk margin of all sensors{what}", Interval95(disk.size, disk.size - low), least)
    return [*peaks, margin, *judge_drive(controller, log)]


def judge_drive(controller: Controller, log: Log) -> list[StepFinding]:
    """R and L of the windings over those of the gain file, the dead time, and the phase margin of the current loops.

    None of a machine without windings, and where the log has no voltages.
    """
    if plant_of(controller.parameters).actuator.windings is None or not log.names("u"):
        return []
    found = identify_windings(controller, log)
    R, L, dead_time = found.believed
    shares = (("R", found.R, R), ("L", found.L, L))
    half = controller.sample_time / 2
    return [
        *(
            StepFinding(
                f"{name} of the drive over the gain file's", Interval95(e.value / own, e.half / own), *DRIVE
            )
            for name, e, own in shares
        ),
        StepFinding("dead time of the drive", found.dead_time, dead_time - half, dead_time + half),
        StepFinding(
            "phase margin of the current loops", Interval95(found.phase_margin, 0.0, "rad"), CURRENT_MARGIN
        ),
    ]


def _record_stroke(bench: Bench) -> Log:
    return fly(bench, stroke_of(bench.truth, bench.controller))


def _largest_error(plant: Plant, log: Log) -> float:
    """Of the stroke, m."""
    name = [plant.stroke.name]
    return float(np.abs(log.table("y", name) - log.table("reference", name)).max())


def judge_stroke(controller: Controller, log: Log) -> list[StepFinding]:
    """The largest error along the stroke, and the thrust that it took over what the law expects."""
    plant = plant_of(controller.parameters)
    error, most, what = _largest_error(plant, log), ERROR * plant.stroke.travel, ""
    if error > most:  # of a law that follows its reference late
        own = _largest_error(plant, own_stroke(controller, log))
        if SLACK * own > most:
            what, most = f", {1e3 * own:.3g} mm by design", SLACK * own
    noise = float(plant.sensors.noise[plant.stroke_output])
    taught = learn(controller, log)
    return [
        StepFinding(f"largest axial error{what}", Interval95(error, 2 * noise, "m"), 0, most),
        StepFinding(
            f"thrust over that of {taught.parameter or 'the law, as no parameter scales it alone'}",
            Interval95(taught.factor, 1.96 * taught.deviation),
            *FACTORS,
        ),
    ]
