"""Sound files of every kind, written with edits and with a seal of what they hold then; and how each kind is read."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomlkit
from hypothesis import strategies as st
from pydantic import ValidationError

import malta
from fuzz.edits import CUTS, EDITS, Cut, Edit, cut, edited
from fuzz.lines import LINES, run_line
from fuzz.oracle import Defect, Ended, line, observe
from malta.campaigns.plan import Plan, box_of
from malta.campaigns.run import campaign
from malta.campaigns.store import MANIFEST, block_name, read_plan, seal
from malta.gains import encodings
from malta.gains.file import content_of
from malta.gains.schema import GainFile
from malta.margins import certificate, checked_file
from malta.margins.check import check
from malta.margins.uncertain import Compensator
from malta.report import campaign_tables
from malta.simulation.force_log import columns_of_log, read_log
from malta.simulation.recording import record
from malta.synthesis.design_file import read_design
from malta.tuning.search import Journal

ROOT = Path(__file__).parents[2]
GAINS = ("table2", "robust", "tubular_pid", "halbach", "planar", "linear")
DESIGNS = ("table2", "robust", "robust_observer", "tubular_pid", "halbach", "halbach_pid", "planar")
DATA = ("tubular", "halbach", "planar")
EXAMPLES = ("ball", "rotor")
PATIENCE = 3.0  # s for the check of a certificate


class Case(NamedTuple):
    """A sound file with edits of its tables, cuts of its bytes, and whether its seal is made anew."""

    base: str
    edits: tuple[Edit, ...] = ()
    cuts: tuple[Cut, ...] = ()
    sealed: bool = True


def cases(bases: Sequence[str], *, tables: bool = True) -> st.SearchStrategy[Case]:
    """Cases with one to four changes; `tables`: of the tables too, where the kind has them."""
    some_edits = st.lists(EDITS, min_size=1, max_size=4).map(tuple)
    some_cuts = st.lists(CUTS, min_size=1, max_size=3).map(tuple)
    base, seals = st.sampled_from(tuple(bases)), st.sampled_from((True, True, True, True, False))
    by_bytes = st.builds(Case, base, st.just(()), some_cuts, seals)
    if not tables:
        return by_bytes
    by_tables = st.builds(Case, base, some_edits, st.just(()), seals)
    return st.one_of(by_tables, by_tables, by_tables, by_bytes)


# Gain files


@cache
def _gain_document(name: str) -> dict[str, Any]:
    """The document of a gain file; "linear": of a loop of plain matrices."""
    if name != "linear":
        return encodings.decode(ROOT / "design" / "gains" / f"{name}.json")
    plant = malta.linear_machine(
        [[0, 1], [100, -1]], [[0], [2]], [[1, 0]],
        name="cart", states=["z [m]", "v [m/s]"], inputs=["u [N]"], outputs=["z [m]"],
        nominal={"k": 1.0}, terms={"k": [[[0, 0], [1, 0]]]}, noise=1e-6, limit=10.0,
    )  # fmt: skip
    model = malta.linearize(plant, plant.at())
    weights = malta.weights([10, 1], [1], [1e-2], [1e-8], q_i=[10])
    controller = malta.lqg(model, weights, 1e-3, name="cart")
    return malta.gains.document(controller, malta.verify(model, controller))


def _signed(document: Any) -> Any:
    """A document with the sha256 of what its reader makes of it."""
    if not isinstance(document, dict):
        return document
    try:
        plain = GainFile.model_validate(document).model_dump(by_alias=True, exclude_unset=True)
    except (ValidationError, RecursionError, ValueError):
        return document
    return document | {"sha256": encodings.content_sha256(plain)}


def _gain_json(document: Any, case: Case) -> bytes:
    return cut(json.dumps(document).encode(errors="surrogatepass"), case.cuts)


def _gain_npz(document: Any, case: Case) -> bytes:
    """Cuts change the members before their checksums are made."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        entries = list(encodings._flat(encodings._columns(document)).items())
        chosen = int(case.cuts[0].at * len(entries)) if case.cuts and case.sealed else -1
        for k, (name, value) in enumerate(entries):
            member = io.BytesIO()
            np.lib.format.write_array(member, np.zeros(0) if value is None else np.array(value))
            data = cut(member.getvalue(), case.cuts[1:] or case.cuts) if k == chosen else member.getvalue()
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), data)
    return buffer.getvalue() if case.sealed else cut(buffer.getvalue(), case.cuts)


def _gain_mat(document: Any, case: Case) -> bytes:
    body = cut(encodings._to_mat(document)[encodings.MAT_HEADER :], case.cuts)
    return encodings.mat_header(body) + body


_FORMS: dict[str, Callable[[Any, Case], bytes]] = {
    ".json": _gain_json,
    ".npz": _gain_npz,
    ".mat": _gain_mat,
}


def read_gain_file(case: Case, folder: Path, suffix: str) -> Ended | None:
    """Read a gain file; None where this form cannot hold the edited document. What was read is finite."""
    document = edited(_gain_document(case.base), case.edits)
    path = folder / f"mine{suffix}"
    try:
        path.write_bytes(_FORMS[suffix](_signed(document) if case.sealed else document, case))
    except Exception:  # numpy and scipy do not write every document
        return None
    ended = observe(lambda: malta.gains.read(path), folder, [str(path)])
    if ended.code == 0:
        _require_finite(ended.value)
        if not case.sealed and not case.cuts and content_of(path)[1] != _content(case.base):
            raise Defect("a changed document with the old seal was read")
    return ended


@cache
def _content(name: str) -> dict[str, Any]:
    """The document of a gain file as its reader returns it."""
    return GainFile.model_validate(_gain_document(name)).model_dump(by_alias=True, exclude_unset=True)


def _require_finite(controller: Any) -> None:
    for name in ("A", "B", "C", "Ad", "Bd", "Cd", "K", "Ki", "L", "sample_time", "operating_point"):
        values = getattr(controller, name)
        for part in values if isinstance(values, tuple) else (values,):
            if not np.isfinite(part).all():
                raise Defect(f"{name} was read as {part}")


# Design and data files


def _text_of(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def _toml(tree: Any) -> str:
    """Tables as TOML, which has no null; integers beyond 64 bits are written as they are."""
    if isinstance(tree, dict):
        tree = {str(key): value for key, value in tree.items()}

    def plain(node: Any) -> Any:
        if isinstance(node, dict):
            return {str(key): plain(value) for key, value in node.items()}
        if isinstance(node, list):
            return [plain(value) for value in node]
        return "null" if node is None else node

    return tomlkit.dumps(plain(tree) if isinstance(tree, dict) else {"x": plain(tree)})


def _write_toml(case: Case, source: Path, target: Path) -> bool:
    """Write an edited TOML file; False where TOML cannot hold it."""
    data = source.read_bytes()
    if case.edits:
        try:
            data = _toml(edited(tomlkit.parse(_text_of(source)).unwrap(), case.edits)).encode()
        except Exception:  # surrogates, keys of control characters
            return False
    target.write_bytes(cut(data, case.cuts))
    return True


def _link_shipped(folder: Path) -> None:
    """The machines' data beside a design file of the user's own."""
    for name in ("data", "examples"):
        if not (folder / name).exists():
            (folder / name).symlink_to(ROOT / name)


def read_design_file(case: Case, folder: Path) -> Ended | None:
    """Read a design file, linearize its machine and synthesize its gains where it can be read."""
    example = case.base in EXAMPLES
    source = ROOT / (f"examples/{case.base}" if example else "") / "design" / f"{case.base}.toml"
    path = folder / "own" / "design" / "mine.toml"
    path.parent.mkdir(parents=True, exist_ok=True)
    data = path.parent.parent / (f"{case.base}.toml" if example else "data")
    if not data.exists():
        _bring_data(data, case.base, example=example)
    if not _write_toml(case, source, path):
        return None
    ended = observe(lambda: read_design(path), folder, [str(folder)])
    if ended.code == 0 and case.base not in ("planar", "rotor"):
        spec = ended.value

        def synthesize() -> Any:
            return malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at(**spec.operating_point)))

        made = observe(synthesize, folder)
        if made.code == 0:
            _require_finite(made.value)
    return ended


def _bring_data(target: Path, name: str, *, example: bool) -> None:
    """Copies of what design files name: the data of the machines, and the modules of the examples."""
    sources = (ROOT / "examples" / name).glob("*.*") if example else (ROOT / "data").rglob("*.toml")
    for source in sources:
        inside = source.name if example else str(source.relative_to(ROOT / "data"))
        place = target.parent / inside if example else target / inside
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(source.read_bytes())


def read_data_file(case: Case, folder: Path) -> Ended | None:
    """Read a data file and build its machine where it can be read."""
    example = case.base in EXAMPLES
    source = ROOT / (f"examples/{case.base}" if example else "data") / f"{case.base}.toml"
    path = folder / "mine.toml"
    if example and not (folder / f"{case.base}.py").exists():
        _bring_data(path, case.base, example=True)
    if not _write_toml(case, source, path):
        return None
    ended = observe(lambda: malta.read(path), folder, [str(folder)])
    if ended.code == 0:
        for name, value in vars(ended.value).items():
            if isinstance(value, float) and not np.isfinite(value):
                raise Defect(f"{name} was read as {value}")
        if case.base != "planar":
            observe(lambda: malta.linearize(malta.plant_of(ended.value), malta.plant_of(ended.value).at()))
    return ended


# Campaigns

QUICK: dict[str, Any] = {"fidelity": "force", "duration": 0.01, "rise": 3e-3}


@cache
def _plan() -> Plan:
    controller = malta.gains.read(ROOT / "design" / "gains" / "calibrated.json")
    return Plan(controller, spread={"m": 0.2, "K_A": 0.2}, samples=16, options=QUICK)


@cache
def _campaign_files() -> dict[str, bytes]:
    """The files of a sound campaign of two blocks."""
    import tempfile

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


def _block(data: bytes, case: Case) -> bytes:
    """A block with edited arrays and a new seal; cuts change the file, and the old seal stays."""
    if case.cuts:
        return cut(data, case.cuts)
    with np.load(io.BytesIO(data)) as file:
        tree = {name: file[name].tolist() for name in file.files}
    arrays: dict[str, Any] = {name: np.array(value) for name, value in edited(tree, case.edits).items()}
    if case.sealed:
        arrays["seal"] = np.array(seal({k: v for k, v in arrays.items() if k != "seal"}, 8))
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


# Certificates


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
    same = all(content.get(key) == original[key] for key in ("parameters", "gains"))
    described = [key for key in original["loops"][0] if key not in ("groups", "units")]
    loops: Any = content.get("loops")
    same = same and isinstance(loops, list) and len(loops) == 1 and isinstance(loops[0], dict)
    same = same and all(loops[0].get(key) == original["loops"][0][key] for key in described)
    if same and claim > 1.002 * float.fromhex(original["lower"]):
        raise Defect(f"{claim} is proven, where the margin is {float.fromhex(original['lower'])}")


# Logs, trials, units


@cache
def _log_rows() -> tuple[tuple[str, ...], Any]:
    """The columns of a slow stroke there and back of the tubular machine."""
    plant = _plan().plant
    t = np.linspace(0, 6, 1200)
    z = -0.99 * plant.travel * np.cos(np.pi * t / 3)
    forces = np.outer(1 + z / plant.travel, [0.1, 1.0, -0.2, 2.0, 0.5])
    return columns_of_log(plant), np.column_stack([t, z, forces])


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
        return record(read_log(path, plant), plant)

    ended = observe(recorded, folder, [str(path)])
    if ended.code == 0 and not np.isfinite(ended.value.v0).all():
        raise Defect(f"v0 was recorded as {ended.value.v0}")
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


def read_shares_of(case: Case, folder: Path) -> Ended | None:
    """Read the spread of a campaign from a gain file."""
    path = folder / "mine.json"
    document = edited(_gain_document(case.base), case.edits)
    path.write_bytes(_gain_json(_signed(document), case))
    read = observe(lambda: malta.gains.read(path), folder, [str(path)])
    return observe(lambda: box_of(path), folder, [str(path)]) if read.code == 0 else read


def show_scenarios(case: Case, folder: Path) -> Ended | None:
    """`malta simulate FILE --scenario help`, which reads a gain file as every command does."""
    path = folder / "mine.json"
    document = edited(_gain_document(case.base), case.edits)
    path.write_bytes(_gain_json(_signed(document), case))
    return observe(line("simulate", str(path), "--scenario", "help"), folder, [str(path)])


Read = Callable[[Case, Path], Ended | None]


class Kind(NamedTuple):
    """A kind of input: its cases, how it is read, and how many of 2000 cases it gets."""

    cases: st.SearchStrategy[Any]
    read: Callable[[Any, Path], Ended | None]
    share: int


def _of_form(suffix: str) -> Read:
    def read(case: Case, folder: Path) -> Ended | None:
        return read_gain_file(case, folder, suffix)

    return read


KINDS: dict[str, Kind] = {
    "gains.json": Kind(cases(GAINS), _of_form(".json"), 300),
    "gains.npz": Kind(cases(GAINS), _of_form(".npz"), 220),
    "gains.mat": Kind(cases(GAINS), _of_form(".mat"), 220),
    "design": Kind(cases((*DESIGNS, *EXAMPLES)), read_design_file, 260),
    "data": Kind(cases((*DATA, *EXAMPLES)), read_data_file, 220),
    "campaign": Kind(cases(("manifest", "block")), read_campaign, 180),
    "certificate": Kind(cases(("continuous", "sampled")), check_certificate, 180),
    "log": Kind(cases(("csv", "npz")), read_log_file, 160),
    "trials": Kind(cases(("trials",)), read_trials, 60),
    "shares": Kind(cases(("table2", "linear")), read_shares_of, 40),
    "lines": Kind(LINES, run_line, 120),
    "commands": Kind(cases(("table2", "halbach", "linear")), show_scenarios, 40),
}
