"""Writing a gain file from a controller and its margins, and comparing one with them."""

from __future__ import annotations

import math
import platform
from collections.abc import Mapping
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.arguments import is_number
from malta.errors import CheckError, InputError
from malta.files import require_plain_name, version
from malta.gains.contents import LINEAR_MACHINE_NAME
from malta.gains.encodings import SUFFIXES as SUFFIXES, content_sha256, encode
from malta.gains.file import SCHEMA, content_of
from malta.model.linear.parameters import LinearSystem, is_linear
from malta.model.machines import build_plant
from malta.model.parameters import units_of, values_of
from malta.synthesis.controller import Controller
from malta.synthesis.schedule import SCHEDULED_MATRICES, Schedule
from malta.writing import replace_files

if TYPE_CHECKING:
    pass

if TYPE_CHECKING:
    from malta.margins.loop_report import LoopReport


def document(controller: Controller, margins: LoopReport) -> dict[str, Any]:
    """Make the content of a controller's gain file, as plain tables, lists and numbers.

    controller : the controller
    margins : its margins, from `malta.verify`

    Returns the tables of the file without encoding, see the format of gain files.

    Raises CheckError when the loop is not stable, InputError for a name that no file could have.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> model = malta.linearize(spec.plant, spec.plant.at())
    >>> controller = malta.synthesize(spec, model)
    >>> content = malta.gains.document(controller, malta.verify(model, controller))
    >>> content["schema"], content["sample_time"], content["signals"]["forces"]
    ('malta-gains', 0.0002, [{'name': 'f', 'unit': 'N'}])
    """
    require_stable(margins, controller.name)
    c = controller
    units, linear = units_of(c.parameters), is_linear(c.parameters)
    require_plain_name(c.name, "gain file", "design.name")
    if linear:
        require_plain_name(c.parameters.preset, "gain file", "plant.preset")
    in_positions = c.cost is not None and c.cost.coordinates == "positions"
    ahead = c.commutation is not None
    law: dict[str, Any] = {"tracks": c.tracks} | ({"coordinates": "positions"} if in_positions else {})
    law |= {key: getattr(c, key) for key in ("pause", "braking", "references") if getattr(c, key).size}
    law |= {"fraction": c.fraction} if c.fraction else {}
    extended = linear or ahead or c.tracks == "errors" or c.schedule is not None or bool(c.lagging)
    extended = extended or len(law) > 1 or not c.feedforward.rate.size or bool(c.feedforward.position.size)
    tables: dict[str, Any] = {
        "schema": SCHEMA,
        "version": 2 if extended else 1,
        "design": {"name": c.name, "spec_sha256": c.spec_sha256},
        "plant": {
            "name": LINEAR_MACHINE_NAME if linear else build_plant(c.parameters).name,
            "preset": c.parameters.preset,
            "parameters": {k: {"value": v, "unit": units[k]} for k, v in values_of(c.parameters).items()},
            **({"linear": linear_table(c.parameters)} if linear else {}),
        },
        "operating_point": {"x": c.operating_point[0], "u": c.operating_point[1]},
        "sample_time": c.sample_time,
        **({"law": law} if extended else {}),
        "signals": signal_tables(c, "states", "forces", "measurements"),
        "model": {key: getattr(c, key) for key in ("A", "B", "C", "Ad", "Bd", "Cd")},
        "gains": {key: getattr(c, key) for key in ("K", "Ki", "L")},
        "cost": _table(c.cost, "state", "input", "integral"),
        "noise": _table(c.noise, "process", "sensor", "drift", later=("correlation",)),
        "feedforward": _table(c.feedforward, "inertia", "speed", "rate", "z_grid", "v0", later=("position",)),
        "current_loop": _table(c.current_loop, "Kp", "Ki", "sample_time"),
        **({"commutation": _table(c.commutation, "lead", "pull")} if ahead else {}),
        **({} if c.schedule is None else {"schedule": _schedule_table(c.schedule)}),
        "limits": _table(c.limits, "current", "voltage", "force"),
        "verification": {
            "poles": margins.poles.pairs,
            "bandwidth": dict(margins.bandwidth),
            "peak_sensitivity": dict(margins.peak_sensitivity),
            "robust": _robust(margins),
        },
        "provenance": {"malta": version(), "python": platform.python_version()}
        | {name: metadata.version(name) for name in ("numpy", "scipy", "control", "casadi")},
    }
    for key, limit in tables["limits"].items():
        if not np.isfinite(limit).all():
            tables["limits"][key] = None
    plain: dict[str, Any] = _plain(tables)
    plain["sha256"] = content_sha256(plain)
    return plain


def _table(record: Any, *keys: str, later: tuple[str, ...] = ()) -> dict[str, Any] | None:
    """Some fields of a record, and those that came later where they are not empty; None for None."""
    if record is None:
        return None
    used = tuple(key for key in later if getattr(record, key).size)
    return {key: getattr(record, key) for key in keys + used}


def _schedule_table(schedule: Schedule) -> dict[str, Any]:
    """A schedule: the matrices of one place below those of another."""
    stacked = {name: np.vstack([*getattr(schedule, name)]) for name in SCHEDULED_MATRICES}
    return {"variable": schedule.variable, "places": schedule.places, **stacked}


def _robust(margins: LoopReport) -> dict[str, Any] | None:
    """Bounds of the margin: lower is null if nothing is proven, upper is null without a witness."""
    margin = margins.robust
    if margin is None:
        return None
    box: Mapping[str, Any] = margins.uncertainty
    for name, share in box.items():
        if not is_number(share):
            found = f"the interval {share[0]:g} to {share[1]:g}"
            raise InputError("gains.write", f"uncertainty.{name}", found, "a share of its value, as 0.2")
    return {
        "uncertainty": dict(margins.uncertainty),
        "lower": margin.lower,
        "upper": None if margin.exhausted else margin.upper,
        "witness": None if margin.witness is None else dict(margin.witness),
    }


def require_stable(found: LoopReport, name: str) -> None:
    """Raise CheckError when a stage is unstable: such gains are not written to files."""
    for stage in found.stages:
        if not stage.stable:
            raise CheckError(
                f"{name}: the loop ({stage.name}) is unstable, |lambda| = {stage.spectral_radius:.6f}"
            )


def write(controller: Controller, margins: LoopReport, *paths: str | Path) -> None:
    """Write a controller to gain files.

    All files are completed beside their targets before any is renamed into place, so a failure leaves the old ones.

    controller : the controller
    margins : its margins, from `malta.verify`
    paths : of the files; the suffix (.json, .npz, .mat) gives the encoding

    Raises InputError for an unknown suffix or a folder that cannot be written to, and CheckError when the loop is not
    stable.

    >>> import malta
    >>> A, B, C = [[0, 1], [400, 0]], [[0], [2]], [[1, 0]]
    >>> cart = malta.linear_machine(A, B, C, name="cart")
    >>> model = malta.linearize(cart, cart.at())
    >>> weights = malta.synthesis.weights([1e6, 0], [1], [1e-2], [1e-12])
    >>> controller = malta.lqg(model, weights, Ts=1e-3)
    >>> margins = malta.verify(model, controller)
    >>> malta.gains.write(controller, margins, "build/cart.json", "build/cart.mat")
    >>> malta.gains.read("build/cart.mat").K.shape
    (1, 2)
    """
    replace_files(file_contents(controller, margins, *paths))


def file_contents(controller: Controller, margins: LoopReport, *paths: str | Path) -> dict[Path, bytes]:
    """Make the contents of the gain files that `malta.gains.write` writes.

    controller : the controller
    margins : its margins, from `malta.verify`
    paths : of the files; the suffix (.json, .npz, .mat) gives the encoding

    Returns bytes by path.

    Raises InputError for an unknown suffix, and CheckError when the loop is not stable.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> model = malta.linearize(spec.plant, spec.plant.at())
    >>> controller = malta.synthesize(spec, model)
    >>> margins = malta.verify(model, controller)
    >>> files = malta.gains.file_contents(controller, margins, "ball.json", "ball.mat")
    >>> [path.name for path in files]
    ['ball.json', 'ball.mat']
    """
    content = document(controller, margins)
    return {Path(path): encode(content, Path(path)) for path in paths}


def _plain(value: Any) -> Any:
    """Tables, lists, numbers and nulls for empty ones; no negative zeros, which some readers of JSON may lose."""
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()} or None
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list):
        return [_plain(entry) for entry in value] or None
    return value + 0.0 if isinstance(value, float) else value


# Comparison of gain files with a design: a file whose numbers agree need not be written again.
#
# Another processor or another patch version of a library changes last digits. A file that differs only in them, or in
# its provenance, is left as it is.


AGREEMENT_TOLERANCE = 1e-9  # of the largest number in the same array
VERIFICATION_TOLERANCE = 1e-6  # of poles and bandwidths, which magnify what moves a matrix
MAX_TIGHTENING = 1.01  # largest ratio by which the new bounds of a margin may be tighter
UNCOMPARED_TABLES = {
    "provenance",
    "sha256",
    "verification",
}  # tables that are not compared with AGREEMENT_TOLERANCE


def agrees(controller: Controller, margins: LoopReport, *paths: str | Path) -> bool:
    """Compare gain files with a controller and its margins: files whose numbers agree need not be written again.

    Each array has to agree to 1e-9 of its largest entry, poles and bandwidths to 1e-6. The bounds of the margin must
    not contradict those in the file, nor be narrower by more than 1 %: a slower computer proves less in the same time.

    controller : the controller
    margins : its margins, from `malta.verify`
    paths : the gain files

    Returns True where all files exist, are sound, and hold this controller.

    Raises CheckError when the loop is not stable, as `malta.gains.document` does.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> model = malta.linearize(spec.plant, spec.plant.at())
    >>> controller = malta.synthesize(spec, model)
    >>> margins = malta.verify(model, controller, spec.uncertainty)
    >>> malta.gains.write(controller, margins, "build/ball.json")
    >>> malta.gains.agrees(controller, margins, "build/ball.json")
    True
    """
    wanted = document(controller, margins)
    with suppress(InputError):
        return all(_agree(wanted, content_of(Path(path))[1]) for path in paths)
    return False


def _agree(wanted: Mapping[str, Any], found: dict[str, Any]) -> bool:
    """Whether two documents hold the same controller and margins that do not contradict each other."""
    if set(wanted) != set(found) or not all(
        _close(wanted[key], found[key], AGREEMENT_TOLERANCE) for key in set(wanted) - UNCOMPARED_TABLES
    ):
        return False
    verified, before = (dict(content["verification"]) for content in (wanted, found))
    robust, earlier = verified.pop("robust"), before.pop("robust")
    poles, others = verified.pop("poles"), before.pop("poles")
    return (
        _close(verified, before, VERIFICATION_TOLERANCE)
        and all(_same_poles(poles[name], others[name]) for name in poles)
        and _hardly_narrower(robust, earlier)
    )


def _same_poles(one: Any, two: Any) -> bool:
    """Whether two lists of poles agree in any order: rounding orders neighbours, and signs of +-j pi / Ts, anew."""
    if not one or not two or len(one) != len(two):
        return bool(one == two)
    first, second = (np.array(rows)[:, 0] + 1j * np.abs(np.array(rows)[:, 1]) for rows in (one, two))
    room, left = VERIFICATION_TOLERANCE * np.abs(first).max(), second.tolist()
    for pole in first.tolist():  # each takes the nearest that is left
        nearest = min(left, key=lambda other: abs(other - pole))
        if abs(nearest - pole) > room:
            return False
        left.remove(nearest)
    return True


def _hardly_narrower(now: Mapping[str, Any] | None, before: Mapping[str, Any] | None) -> bool:
    """Whether the bounds of a margin agree with earlier ones and are at most MAX_TIGHTENING times as tight."""
    if now is None or before is None or now["uncertainty"] != before["uncertainty"]:
        return now == before
    lower, upper = _bounds(now)
    lowest, highest = _bounds(before)
    room = 1 + VERIFICATION_TOLERANCE
    agree = lower <= highest * room and lowest <= upper * room
    return agree and lower <= lowest * MAX_TIGHTENING and upper >= highest / MAX_TIGHTENING


def _bounds(robust: Mapping[str, Any]) -> tuple[float, float]:
    """Lower and upper bound; 0 and infinity where the file has null."""
    lower, upper = robust["lower"], robust["upper"]
    return 0.0 if lower is None else lower, math.inf if upper is None else upper


def _close(a: Any, b: Any, share: float) -> bool:
    """Whether two plain values agree: tables by their keys, arrays within a share of their largest entry."""
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return set(a) == set(b) and all(_close(a[key], b[key], share) for key in a)
    try:
        first, second = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    except (TypeError, ValueError):  # words, signals, nothing
        if isinstance(a, list) and isinstance(b, list):
            return len(a) == len(b) and all(_close(x, y, share) for x, y in zip(a, b, strict=True))
        return bool(a == b)
    if first.shape != second.shape or isinstance(a, str) or isinstance(b, str) or (a is None) != (b is None):
        return bool(a == b)
    if not first.size or a is None:
        return True
    return bool(np.abs(first - second).max() <= share * np.abs(first).max())


def signal_tables(record: Any, *keys: str) -> dict[str, Any]:
    """Signals of a record, a table for each."""
    return {key: [s._asdict() for s in getattr(record, key)] for key in keys}


def linear_table(parameters: Any) -> dict[str, Any]:
    """The table plant.linear of such a machine's parameters."""
    s: LinearSystem = parameters.system
    matrices, terms = (
        [dict(zip("ABC", (np.array(M) for M in one), strict=True)) for one in several]
        for several in ([s.matrices], [found for _, found in s.terms])
    )
    later = {
        "formulas": dict(s.formulas),
        "parameter_limits": {
            name: {"above": _finite_or_none(above), "below": _finite_or_none(below)}
            for name, above, below in s.limits
        },
    }
    return {
        **signal_tables(s, "states", "inputs", "outputs"),
        "matrices": matrices[0],
        "terms": dict(zip([name for name, _ in s.terms], terms, strict=True)),
        **{key: table for key, table in later.items() if table},
        "limit": np.array(s.limit) if np.isfinite(s.limit).all() else None,
        "noise": np.array(s.noise),
        "dead_time": s.dead_time,
        **({"computation_time": s.computation_time} if s.computation_time else {}),
        **({"range": np.array(s.range)} if any(s.range) else {}),
    }


def _finite_or_none(x: float) -> float | None:
    return x if math.isfinite(x) else None
