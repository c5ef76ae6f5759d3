"""The folder of a campaign: its manifest, and a file for each block of runs that is done.

    campaign.json        the plan's manifest, the number of runs in a block, and which gain file was read
    runs_00000000.npz    the block that begins with run 0: the machines of its runs and their figures
    runs_00001024.npz    ...

Every file is written whole or not at all. A block names the plan that it belongs to, and ends with a seal: the sha256
of the plan's identity, the index of the first run and all arrays. The runs of a damaged block, whose seal does not fit
or whose numbers no run can have, are simulated again.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from malta.arrays import FloatArray
from malta.campaigns.plan import (
    PRECISIONS,
    SCHEMA,
    VERSION,
    Machines,
    Plan,
    draw_machines,
    planned_run,
    varied_names,
)
from malta.errors import InputError
from malta.files import file_exists, read_file
from malta.firmware.flight import engine_of_c
from malta.model.fingerprint import fingerprint
from malta.simulation.engine.batch import is_compiled, simulate_many
from malta.simulation.engine.compiled import MOST_LANES
from malta.simulation.engine.digest import MAX_FIGURE, Batch, verdicts
from malta.simulation.experiments import Progress
from malta.simulation.scenario import Scenario
from malta.synthesis.controller import Controller
from malta.tables import read_npz
from malta.writing import remove_leftovers, replace_files, writer

# A block: some consecutive runs of a plan, simulated together.


class RunBlock(NamedTuple):
    """The runs of a block, a row for each."""

    values: FloatArray  # runs x names, SI: drawn parameters and errors of the sensors
    batch: Batch
    engine: str  # that simulated them, see store.ENGINES


def simulate_machines(
    plan: Plan,
    machines: Machines,
    scenario: Scenario | None = None,
    *,
    first: int = 0,
    noise: NDArray[np.int64] | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Batch:
    """Simulate a plan's scenario, or another one, on machines; first, noise, workers as in `simulate_many`."""
    return simulate_many(
        plan.plant,
        plan.controller,
        planned_run(plan).scenario if scenario is None else scenario,
        machines.changes,
        sensor_errors=machines.sensor_errors,
        first=first,
        noise=noise,
        workers=workers,
        engine=None if plan.law == "own" else engine_of_c(PRECISIONS[plan.law]),
        progress=progress,
    )


def fly(
    plan: Plan, first: int, count: int, workers: int | None = None, progress: Progress | None = None
) -> RunBlock:
    """Simulate the `count` runs of a plan from run `first` on.

    first : a multiple of MOST_LANES, so that a run has the same place in its group of machines in every block
    workers : threads; None: one for each core
    """
    machines = draw_machines(plan, first, count)
    batch = simulate_machines(plan, machines, first=first, workers=workers, progress=progress)
    return RunBlock(machines.values, batch, _engine_name(plan))


def _engine_name(plan: Plan) -> str:
    """What simulates a plan's runs."""
    if plan.law != "own":
        return f"exported C, {PRECISIONS[plan.law]}"
    compiled = is_compiled(plan.plant, plan.controller, planned_run(plan).scenario)
    return "compiled" if compiled else "virtual machine"


MANIFEST, GAINS = "campaign.json", "gains_file"
HEADERS = 1_000_000  # bytes of a block beside its numbers, at most


def block_name(first: int) -> str:
    """The file of the block that begins with this run."""
    return f"runs_{first:08d}.npz"


def open_folder(folder: Path, plan: Plan, block: int, gains: Path | None = None) -> int:
    """Make sure that a folder has the manifest of a plan; the number of runs in its blocks.

    gains : file of the controller, noted in a new folder for those who look into it later

    Raises InputError for a folder that has another campaign, or blocks without a manifest, or cannot be written to.
    """
    path = folder / MANIFEST
    try:
        for stale in folder.glob(f".*.npz.{writer()}.*"):  # left by a killed process that had the same id
            stale.unlink(missing_ok=True)
        remove_leftovers(folder, "*.npz")
        begun = path.exists()
    except OSError as error:
        raise InputError(
            folder, "", error.strerror or str(error), "a folder to keep a campaign in"
        ) from error
    if begun:
        found, size = read_manifest(path)
        require_same(path, found, plan.manifest)
        return size
    blocks = sorted(folder.glob("runs_*.npz"))
    if blocks:
        raise InputError(
            folder, "", f"{blocks[0].name} without {MANIFEST}", "a campaign's folder or an empty one"
        )
    noted = {} if gains is None else {GAINS: str(gains.absolute())}
    text = json.dumps(plan.manifest | {"block": block} | noted, indent=1) + "\n"
    replace_files({path: text.encode()})
    return block


def forget_folder(folder: Path) -> None:
    """Delete the manifest of a campaign that was refused before it had any run, and the folder if it is empty."""
    (folder / MANIFEST).unlink(missing_ok=True)
    with suppress(OSError):
        folder.rmdir()


def read_manifest(path: Path) -> tuple[dict[str, Any], int]:
    """A manifest, and the number of runs in a block. Raises InputError for any other file."""
    text = _manifest_text(path)
    try:
        content = json.loads(text)
        size, _ = content.pop("block"), content.pop(GAINS, None)
    except (ValueError, RecursionError, AttributeError, KeyError, TypeError) as error:
        raise InputError(path, "", "a damaged or foreign file", "the manifest of a campaign") from error
    for key, expected in (("schema", SCHEMA), ("version", VERSION)):
        if content.get(key) != expected:
            raise InputError(path, key, repr(content.get(key, "nothing")), repr(expected))
    if not isinstance(size, int) or size < 1 or size % MOST_LANES:
        raise InputError(path, "block", repr(size), f"a multiple of {MOST_LANES}")
    return content, size


def _manifest_text(path: Path) -> str:
    return read_file(path, "campaign's manifest", lambda p: p.read_text(encoding="utf-8"))


def noted_gains(folder: str | Path) -> Path:
    """The gain file of the campaign in a folder. Raises InputError where none is noted."""
    path = Path(folder) / MANIFEST
    read_manifest(path)
    noted = json.loads(_manifest_text(path)).get(GAINS)
    if not isinstance(noted, str):
        raise InputError(path, GAINS, "none noted", "the campaign's gain file as an argument")
    return Path(noted)


def read_plan(folder: str | Path, controller: Controller) -> Plan:
    """The plan of the campaign in a folder.

    Raises InputError for a folder without a campaign, a damaged manifest, or a campaign of another controller.
    """
    path = Path(folder) / MANIFEST
    content, _ = read_manifest(path)
    own = fingerprint(controller)
    try:
        gains, scenario, machine = content["gains"], content["scenario"], content["machine"]
        if gains["sha256"] != own:
            found = f"a campaign of {gains['name']}, sha256 {shorten(gains['sha256'])}"
            raise InputError(path, "gains", found, f"one of {controller.name}, sha256 {shorten(own)}")
        values = {name: float(value) for name, value in machine["parameters"].items()}
        plan = Plan(
            controller,
            scenario["name"],
            content["spread"],
            content["sensor_spread"],
            content["samples"],
            content["seed"],
            content["sampler"],
            replace(controller.parameters, **values, preset=machine["preset"]),
            scenario["case"],
            scenario["options"],
            content.get("controller", {}).get("law", "own"),
        )
    except InputError as error:
        raise InputError(path, error.field, error.found, error.expected) from error
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise InputError(
            path, "", f"a damaged or foreign file ({error})", "the manifest of a campaign"
        ) from error
    require_same(path, content, plan.manifest)
    return plan


def read_blocks(
    place: Path, plan: Plan, parts: Mapping[int, int]
) -> Iterator[tuple[int, Path, RunBlock | None]]:
    """(first run, file, block) for each of the blocks `parts`, first run -> number of runs, that a folder has.

    None stands for the block of a damaged file.
    """
    for first, count in parts.items():
        path = place / block_name(first)
        if file_exists(path):
            yield first, path, read_block(path, plan, first, count)


def require_same(path: Path, found: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    """InputError that names the first entry in which two manifests differ; the revision last, as it follows others."""
    for key, (one, other) in sorted(
        _differences(found, expected), key=lambda entry: entry[0].startswith("revision")
    ):
        raise InputError(
            path,
            key,
            f"{shorten(one)}: another campaign",
            f"{shorten(other)}, or a folder of its own for this one",
        )


def _differences(found: Any, expected: Any, key: str = "") -> Iterator[tuple[str, tuple[Any, Any]]]:
    """(key, (found, expected)) for every entry in which two nested tables differ."""
    if isinstance(found, Mapping) and isinstance(expected, Mapping):
        for name in {**expected, **found}:
            inner = f"{key}.{name}" if key else name
            yield from _differences(found.get(name, "nothing"), expected.get(name, "nothing"), inner)
    elif found != expected:
        yield key, (found, expected)


def shorten(value: Any) -> str:
    """A value as text of at most 40 characters."""
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 40 else text[:12] + "..."


def encode_block(block: RunBlock, plan: Plan, first: int) -> bytes:
    """The block that begins with run `first` as an .npz archive, with the identity of its plan and its seal."""
    buffer = io.BytesIO()
    arrays: dict[str, Any] = {
        "campaign": np.array(plan.identity),
        "engine": np.array(block.engine),
        "names": np.array(varied_names(plan)),
        "values": block.values,
    } | {name: getattr(block.batch, name) for name in Batch.__dataclass_fields__}
    np.savez(buffer, **arrays, seal=np.array(seal(arrays, first)))
    return buffer.getvalue()


def seal(arrays: Mapping[str, Any], first: int) -> str:
    """sha256 of the arrays of the block that begins with run `first`: names, types, shapes and contents."""
    marks = hashlib.sha256(f"malta block {first};".encode())
    for name, array in sorted(arrays.items()):
        marks.update(f"{name} {array.dtype.str} {array.shape};".encode())
        marks.update(np.ascontiguousarray(array).tobytes())
    return marks.hexdigest()


def read_block(path: Path, plan: Plan, first: int, count: int) -> RunBlock | None:
    """The block of `count` runs from `first` on; None for a damaged file.

    Raises InputError for a block of another campaign.
    """
    machines = draw_machines(plan, first, count)
    figures = sum(math.prod(shape) for shape in figure_shapes(plan).values())
    largest = 16 * count * (figures + machines.values.shape[1]) + HEADERS  # twice what it takes
    data = read_file(path, "block of a campaign", Path.read_bytes, largest)
    try:
        arrays = read_npz(data)  # checks the archive's checksums
        identity, kind, sealed = (str(arrays[name]) for name in ("campaign", "engine", "seal"))
        columns = {name: arrays[name] for name in Batch.__dataclass_fields__}
        values = arrays["values"]
    except (ValueError, KeyError):  # a damaged archive, or one without an array
        return None
    if identity != plan.identity:
        raise InputError(path, "", "a block of another campaign", f"one of that in {MANIFEST}")
    rest = {name: array for name, array in arrays.items() if name != "seal"}
    whole = (
        sealed == seal(rest, first)
        and kind in ENGINES
        and np.array_equal(arrays.get("names", ""), machines.names)
        and np.array_equal(values, machines.values)
        and _are_possible(columns, plan, count)
    )
    return RunBlock(values, Batch(**columns), kind) if whole else None


ENGINES = ("compiled", "virtual machine", "exported C, double", "exported C, float")


def _are_possible(columns: Mapping[str, Any], plan: Plan, count: int) -> bool:
    """Whether `count` runs of a plan can leave these figures: shapes, ranges, and verdicts that fit the rest."""
    for name, shape in figure_shapes(plan).items():
        if columns[name].dtype != np.float64 or columns[name].shape != (count, *shape):
            return False
    verdict, completed = columns["verdict"], columns["completed"]
    Ts, scenario = plan.controller.sample_time, planned_run(plan).scenario
    ranges = {
        "duration": (-scenario.settling_samples(Ts) * Ts, scenario.duration + Ts),
        "saturated": (0, 1),
        "verdict": (0, len(verdicts(plan.plant)) - 1),
    }
    inside = [
        ((columns[name] >= low) & (columns[name] <= high)).all() for name, (low, high) in ranges.items()
    ]
    # Figures of a run that diverged may be infinite or NaN, and rise and overshoot of a run that ended early are NaN.
    positive = [not (columns[name] < 0).any() for name in ("deviation", "rms", "force", "rise", "overshoot")]
    finite = [(np.abs(columns[name][completed == 1]) < MAX_FIGURE).all() for name in FINITE_COLUMNS]
    finite += [
        not (np.isfinite(columns[name]) & (columns[name] >= MAX_FIGURE)).any()
        for name in ("rise", "overshoot")
    ]
    codes = (verdict == np.floor(verdict)).all() and np.array_equal(completed, verdict == 0)
    return all(inside) and all(positive) and all(finite) and bool(codes)


FINITE_COLUMNS = ("deviation", "rms", "force", "contact", "last")  # where a run was completed


def figure_shapes(plan: Plan) -> dict[str, tuple[int, ...]]:
    """The shape of each figure of one run, by the names of Batch."""
    plant = plan.plant
    p, m = len(plant.outputs), len(plant.inputs)
    rows = {
        "deviation": (p,),
        "rms": (p,),
        "last": (p,),
        "force": (m,),
        "saturated": (m,),
        "contact": (len(plant.contacts.names),),
    }
    return {name: rows.get(name, ()) for name in Batch.__dataclass_fields__}
