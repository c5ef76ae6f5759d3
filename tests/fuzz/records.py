"""What malta keeps or measures: campaigns, certificates, logs, trials."""

from __future__ import annotations

import io
import json
import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import malta
from fuzz.cases import ROOT, Case
from fuzz.edits import cut, edited
from fuzz.oracle import Defect, Ended, line, observe
from malta.campaigns.limits import limit_of
from malta.campaigns.plan import Plan
from malta.campaigns.rare import rare_event, read_design_point, write_event
from malta.campaigns.run import campaign
from malta.campaigns.store import MANIFEST, block_name, read_plan, seal
from malta.checker import file as checked_file
from malta.firmware.signals import Target
from malta.firmware.sources import LAYOUT, MAGIC, MEMBERS, ORDER, RingLayout, ring_of
from malta.gains.certified import check
from malta.identification.calibration import Interval95
from malta.identification.commission import Commissioning, JournalEntry, StepFinding, read_journal
from malta.linear.uncertain import Compensator
from malta.proof import certificate
from malta.report import campaign_tables
from malta.report.page.binder import binder_page, binder_text
from malta.report.page.motion import motion_page, read_motion
from malta.report.tables.experiments import findings_table
from malta.simulation.trajectory_file import save as save_run
from malta.tuning.search import Journal
from malta_papers.tubular.recording import forces_of, record

RARE, BOUND = "deviation-y1", 1.1e-6  # m, which few runs exceed
PATIENCE = 3.0  # s for the check of a certificate


QUICK: dict[str, Any] = {"fidelity": "force", "duration": 0.01, "rise": 3e-3}


@cache
def _plan() -> Plan:
    controller = malta.gains.read(ROOT / "design" / "gains" / "calibrated.json")
    return Plan(controller, spread={"m": 0.2, "K_A": 0.2}, samples=16, options=QUICK)


@cache
def _campaign_files() -> dict[str, bytes]:
    """The files of a sound campaign of two blocks."""
    with tempfile.TemporaryDirectory() as folder:
        campaign(_plan(), folder, block=8)
        return {path.name: path.read_bytes() for path in Path(folder).iterdir()}


def read_campaign(case: Case, folder: Path) -> Ended | None:
    """Go on with a campaign whose manifest or second block was edited."""
    files = dict(_campaign_files())
    name = block_name(8) if case.base == "block" else MANIFEST
    try:
        files[name] = _block(files[name], case) if case.base == "block" else _manifest(files[name], case)
    except Exception:  # numpy does not write every array
        return None
    for key, data in files.items():
        (folder / key).write_bytes(data)
    path = str(folder / name)
    if case.base != "block":
        ended = observe(lambda: read_plan(folder, _plan().controller), folder, [path])
        if ended.code == 0 and ended.value.manifest != _without_block(files[MANIFEST]):
            raise Defect("a plan of another manifest was read")
        return ended
    ended = observe(lambda: _go_on(folder), None, [path])
    left = {entry.name for entry in folder.iterdir()} - set(files)
    if left:
        raise Defect(f"files left behind: {left}")
    return ended


@cache
def _event_files() -> dict[str, bytes]:
    """The files of a sound rare event: its repetitions, and its record."""
    with tempfile.TemporaryDirectory() as folder:
        event = rare_event(_rare_plan(), limit_of(_rare_plan(), RARE, BOUND), folder, workers=1)
        write_event(event, Path(folder))
        return {path.name: path.read_bytes() for path in Path(folder).iterdir()}


def _rare_plan() -> Plan:
    return replace(_plan(), samples=2000, options=QUICK | {"duration": 1e-3, "noise": 0.0})


def read_rare_event(case: Case, folder: Path) -> Ended | None:
    """Go on with a rare event whose first repetition was edited, or read its edited record."""
    files = dict(_event_files())
    name = sorted(files)[0 if case.base == "record" else 1]
    path = folder / name
    try:
        files[name] = _manifest(files[name], case) if case.base == "record" else _block(files[name], case, 0)
    except Exception:  # numpy does not write every array
        return None
    for key, data in files.items():
        (folder / key).write_bytes(data)
    if case.base == "record":
        return observe(lambda: read_design_point(path, _rare_plan()), folder, [str(path)])
    limit = limit_of(_rare_plan(), RARE, BOUND)
    ended = observe(lambda: rare_event(_rare_plan(), limit, folder, workers=1), None, [str(path)])
    if ended.code == 0:
        low, high = ended.value.found.interval()
        if not 0 <= low <= ended.value.found.probability <= high <= 1:
            raise Defect(f"{low} .. {high} about {ended.value.found.probability}")
    return ended


def _without_block(manifest: bytes) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(manifest)
    return {key: value for key, value in content.items() if key != "block"}


def _go_on(folder: Path) -> Any:
    found = campaign(_plan(), folder)
    if len(found.index) != 16 or not np.isfinite(found.batch.duration).all():
        raise Defect("runs that no campaign can leave")
    campaign_tables(found, None, 3)
    return found


def _manifest(data: bytes, case: Case) -> bytes:
    return cut(json.dumps(edited(json.loads(data), case.edits)).encode(), case.cuts)


def _block(data: bytes, case: Case, first: int = 8) -> bytes:
    """A block with edited arrays and a new seal; cuts change the file, and the old seal stays."""
    if case.cuts:
        return cut(data, case.cuts)
    with np.load(io.BytesIO(data)) as file:
        tree = {name: file[name].tolist() for name in file.files}
    arrays: dict[str, Any] = {name: np.array(value) for name, value in edited(tree, case.edits).items()}
    if case.sealed:
        arrays["seal"] = np.array(seal({k: v for k, v in arrays.items() if k != "seal"}, first))
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


@cache
def _certificate(name: str) -> dict[str, Any]:
    def matrices(m: Any, k: Any) -> Any:
        return [[0, 1], [-k / m, -0.2 / m]], [[0], [1 / m]], [[1, 0]]

    system = malta.uncertain(matrices, {"m": 1.0, "k": 4.0})
    none = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[1.0]])
    own = np.array([[0.5]]), np.array([[1.0]]), np.array([[0.3]]), np.array([[-0.4]])
    law = (
        Compensator(*none) if name == "continuous" else Compensator(*own, sample_time=0.05, delay=1, lag=50.0)
    )
    ranges = {"m": 0.1, "k": 0.1}
    margin = malta.robust_margin(system, law, ranges)
    return certificate.certificate_of([(system, law)], ranges, None, margin)


def check_certificate(case: Case, folder: Path) -> Ended | None:
    """Check an edited certificate; one that claims more than the loop has must not hold."""
    original = _certificate(case.base)
    content = edited(original, case.edits)
    if case.sealed and isinstance(content, dict):
        content["sha256"] = checked_file.digest(content)
    path = folder / "mine.json"
    path.write_bytes(cut(json.dumps(content).encode(errors="surrogatepass"), case.cuts))
    ended = observe(lambda: check(path, seconds=PATIENCE), folder, [str(path)])
    if ended.code == 0 and ended.value.ok and isinstance(content, dict):
        _require_true(content, original, ended.value.claim)
    return ended


def _require_true(content: dict[str, Any], original: dict[str, Any], claim: float) -> None:
    """Raise Defect where a certificate of the same loop and the same box holds for more than the margin."""
    claims: Any = content.get("claim"), original["claim"]
    boxes = [
        {key: value for key, value in p.items() if key != "interval"}
        for claim in claims
        for p in (claim["parameters"] if isinstance(claim, dict) else ())
    ]
    same = boxes[: len(boxes) // 2] == boxes[len(boxes) // 2 :]
    described = [key for key in original["loops"][0] if key not in ("groups", "units")]
    loops: Any = content.get("loops")
    same = same and isinstance(loops, list) and len(loops) == 1 and isinstance(loops[0], dict)
    same = same and all(loops[0].get(key) == original["loops"][0][key] for key in described)
    if same and claim > 1.002 * original["claim"]["lower"]:
        raise Defect(f"{claim} is proven, where the margin is {original['claim']['lower']}")


@cache
def _log_rows() -> tuple[tuple[str, ...], Any]:
    """The columns of a slow stroke there and back of the tubular machine."""
    plant = _plan().plant
    t = np.linspace(0, 6, 1200)
    z = -0.99 * plant.stroke.travel * np.cos(np.pi * t / 3)
    forces = np.outer(1 + z / plant.stroke.travel, [0.1, 1.0, -0.2, 2.0, 0.5])
    headings = ("t [s]", f"{plant.stroke.name} [m]", *(f"{s.name} [{s.unit}]" for s in plant.inputs))
    return headings, np.column_stack([t, z, forces])


def read_log_file(case: Case, folder: Path) -> Ended | None:
    """Read a log as .csv or .npz and record v0(z) from it where it can be read."""
    headings, rows = _log_rows()
    path = folder / f"mine.{case.base}"
    tree = {"headings": list(headings), "rows": rows.tolist()}
    try:
        tree = edited(tree, case.edits)
        path.write_bytes(_csv(tree, case) if case.base == "csv" else _log_npz(tree, case))
    except Exception:  # numpy does not write every array
        return None
    plant = _plan().plant

    def recorded() -> Any:
        return record(forces_of(malta.identification.read_log(path), plant), plant)

    shown = observe(line("log", str(path)), folder, [str(path)])
    ended = observe(recorded, folder, [str(path)]) if shown.code == 0 else shown
    if ended.code == 0 and not np.isfinite(ended.value.v0).all():
        raise Defect(f"v0 was recorded as {ended.value.v0}")
    return ended


def read_response_file(case: Case, folder: Path) -> Ended | None:
    """Read a response of an analyser; what is read is finite, at rising frequencies."""
    f = np.geomspace(1, 100, 8)
    rows = np.column_stack([f, *((1 / (1 + 1j * f)).real, (1 / (1 + 1j * f)).imag)])
    tree: Any = {"headings": ["frequency [Hz]", f"{case.base} re", f"{case.base} im"], "rows": rows.tolist()}
    path = folder / "mine.csv"
    try:
        path.write_bytes(_csv(edited(tree, case.edits), case))
    except Exception:  # an edit that leaves no table
        return None
    ended = observe(lambda: malta.identification.read_response(path), folder, [str(path)])
    if ended.code == 0:
        found = ended.value
        if not (np.isfinite(found.values).all() and (np.diff(found.w, prepend=0.0) > 0).all()):
            raise Defect(f"a response was read as {found.w} {found.values}")
    return ended


@cache
def _run_file() -> bytes:
    """The file of a short run."""
    controller = _plan().controller
    run = malta.simulate(
        malta.plant_of(controller.parameters),
        controller,
        malta.Scenario.stroke(1e-3, rise=3e-3, duration=0.01),
    )
    with tempfile.TemporaryDirectory() as folder:
        return save_run(run, Path(folder) / "run.npz").read_bytes()


def read_run_file(case: Case, folder: Path) -> Ended | None:
    """Show the motion of a run whose file was edited, where it can be read."""
    path = folder / "run.npz"
    try:
        path.write_bytes(_block(_run_file(), case))
    except Exception:  # numpy does not write every array
        return None
    ended = observe(lambda: motion_page(read_motion(path, _plan().plant, frames=8)), folder, [str(path)])
    if ended.code == 0 and any(word in ended.value.html for word in ("NaN", "Infinity")):
        raise Defect("numbers that are not finite stand in the page")
    return ended


def _csv(tree: Any, case: Case) -> bytes:
    lines = [",".join(map(str, row)) for row in (tree["headings"], *tree["rows"])]
    return cut("\n".join(lines).encode(errors="surrogatepass"), case.cuts)


def _log_npz(tree: Any, case: Case) -> bytes:
    buffer = io.BytesIO()
    rows = np.array(tree["rows"])
    headings = np.array(tree["headings"])
    arrays: dict[str, Any] = {"t": rows[:, 0], "y": rows[:, 1:2], "y_columns": headings[1:2]}
    np.savez(buffer, **arrays, v=rows[:, 2:], v_columns=headings[2:])
    return cut(buffer.getvalue(), case.cuts)


@cache
def _dump() -> tuple[RingLayout, dict[str, Any]]:
    """The ring of the Halbach motor, and its dump as tables: members of the head, lines of text, samples."""
    controller = malta.gains.read(ROOT / "design" / "gains" / "halbach.json")
    ring = ring_of(Target(controller, "float", logged=4.0), "0" * 64)
    members = dict.fromkeys((name for name, _ in MEMBERS), 0) | {"next": 60, "watched": -1, "triggered": -1}
    rows = np.random.default_rng(1).normal(size=(ring.rows + 1, ring.numbers)).round(3)
    return ring, {"members": members, "text": [line.split("\t") for line in ring.text], "rows": rows.tolist()}


@np.errstate(over="ignore", invalid="ignore")
def _dump_bytes(ring: RingLayout, tree: Any) -> bytes:
    lines = ["\t".join(map(str, line)) for line in tree["text"]]
    text = "\n".join([*lines, ""]).encode(errors="surrogatepass")
    text += bytes(-len(text) % 8)
    head = np.array([LAYOUT, len(text), *tree["members"].values()], "<i4")
    states = bytes(ring.real_bytes * (1 + ring.blocks * ring.remembered))
    order = np.array(ORDER, "<u4").tobytes()
    after = states[: ring.real_bytes] + text + states[ring.real_bytes :]
    return MAGIC + order + head.tobytes() + after + np.array(tree["rows"], "<f4").tobytes()


def read_dump_file(case: Case, folder: Path) -> Ended | None:
    """Read the edited dump of a ring buffer as a log, and show it."""
    ring, tree = _dump()
    path = folder / "mine.dump"
    try:
        path.write_bytes(cut(_dump_bytes(ring, edited(tree, case.edits)), case.cuts))
    except Exception:  # numpy does not write every array
        return None
    ended = observe(lambda: malta.identification.read_log(path), folder, [str(path)])
    if ended.code == 0 and not np.isfinite(ended.value.t).all():
        raise Defect("times that are not finite were read")
    return observe(line("log", str(path)), folder, [str(path)]) if ended.code == 0 else ended


@cache
def _journal() -> dict[str, Any]:
    """A day's journal of two steps, the second of which failed."""
    estimate = Interval95(0.4e-6, 0.01e-6, "m")
    findings = (
        StepFinding("noise of x1", estimate, 0.0, 1e-6),
        StepFinding("disk margin", Interval95(0.3, 0.02), 0.2),
    )
    entries = (
        JournalEntry("still", "Is it quiet?", "still.npz", "0" * 64, findings),
        JournalEntry("loop", "Is it as predicted?", "", "", (), "too loud"),
    )
    done = Commissioning("mine.json", "1" * 64, "tubular", "", entries, ("still", "loop", "stroke"))
    return done.document | {"signature": done.signature}


def read_day(case: Case, folder: Path) -> Ended | None:
    """Read the edited journal of a day of commissioning, and write its page."""
    path = folder / "mine.json"
    path.write_bytes(
        cut(json.dumps(edited(_journal(), case.edits)).encode(errors="surrogatepass"), case.cuts)
    )
    ended = observe(lambda: read_journal(path), folder, [str(path)])
    if ended.code:
        return ended
    done = ended.value[0]
    return observe(lambda: (binder_page(done).content, binder_text(done), findings_table(done)), folder)


def read_trials(case: Case, folder: Path) -> Ended | None:
    """Read the journal of a search."""
    lines: list[Any] = [
        {"malta-tune": 1, "problem": "p"},
        ["a", {"margin": 3.0, "motion y": 1e-6}],
        ["b", {}],
    ]
    changed = edited(lines, case.edits)
    if not isinstance(changed, list):
        return None
    path = folder / "mine_trials.jsonl"
    path.write_bytes(cut("\n".join(json.dumps(entry) for entry in [*changed, ""]).encode(), case.cuts))
    ended = observe(lambda: Journal(path, "p", restart=False), None, [str(path)])
    if ended.code == 0:
        for key, figures in ended.value.known.items():
            sound = isinstance(key, str) and isinstance(figures, dict)
            if not sound or not all(isinstance(x, int | float) for x in figures.values()):
                raise Defect(f"a trial {key!r}: {figures!r}")
    return ended
