"""Sealed blocks and the identity of a plan: changed outcomes are no results, and runs of two revisions never mix."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest
from conftest import Run, refusal

import malta
from malta.campaigns import plan as identity
from malta.campaigns.dask import simulate_at_worker, task_of
from malta.campaigns.plan import Plan, planned_run, revision_of
from malta.campaigns.result import Campaign
from malta.campaigns.run import campaign
from malta.campaigns.store import MANIFEST, block_name, read_plan, seal
from malta.model.fingerprint import fingerprint
from malta.simulation.engine.digest import Batch

if TYPE_CHECKING:
    from conftest import Design

    from malta.synthesis.controller import Controller

pytestmark = pytest.mark.usefixtures("proven_once")
GAINS = "design/gains/calibrated.json"
QUICK: dict[str, Any] = {"fidelity": "force", "duration": 0.01, "rise": 3e-3}
ARRAYS = ("campaign", "engine", "names", "values", *Batch.__dataclass_fields__, "seal")


@pytest.fixture(scope="module")
def controller(designs: dict[str, Design]) -> Controller:
    return designs["calibrated"].controller


@pytest.fixture(scope="module")
def plan(controller: Controller) -> Plan:
    return Plan(controller, spread={"m": 0.2, "K_A": 0.2}, samples=16, options=QUICK)


@pytest.fixture(scope="module")
def whole(plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> tuple[Campaign, dict[str, bytes]]:
    """A campaign of two blocks, and its files."""
    folder = tmp_path_factory.mktemp("whole")
    found = campaign(plan, folder, block=8)
    return found, {path.name: path.read_bytes() for path in folder.iterdir()}


def _copy(files: dict[str, bytes], folder: Path) -> None:
    for name, data in files.items():
        (folder / name).write_bytes(data)


def _edit(path: Path, change: Callable[[dict[str, Any]], Any], first: int | None = None) -> None:
    """Change the arrays of a block; with a new seal where `first` says which block it is."""
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    assert tuple(arrays) == ARRAYS
    change(arrays)
    if first is not None:
        arrays["seal"] = np.array(seal({k: v for k, v in arrays.items() if k != "seal"}, first))
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    path.write_bytes(buffer.getvalue())


def _assert_flown_again(
    whole: tuple[Campaign, dict[str, bytes]], folder: Path, name: str = block_name(8)
) -> None:
    first, files = whole
    again = campaign(first.plan, folder)
    assert again.damaged == (folder / name,)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == files
    assert again.ends == first.ends
    assert np.array_equal(again.batch.deviation, first.batch.deviation)


def _altered(array: Any) -> Any:
    """Another array of the same type and shape: the first entry differs in its last digit or letter."""
    other = array.copy()
    if array.dtype.kind == "U":
        text = str(other.flat[0])
        other.flat[0] = ("0" if text[0] != "0" else "1") + text[1:]
    else:
        other.flat[0] = np.nextafter(other.flat[0], 1e9) if np.isfinite(other.flat[0]) else 0.0
    return other


@pytest.mark.parametrize("name", [name for name in ARRAYS if name != "campaign"])
def test_a_block_with_any_change_is_flown_again(
    whole: tuple[Campaign, dict[str, bytes]], tmp_path: Path, name: str
) -> None:
    """A last digit of any array, in a sound archive."""
    _copy(whole[1], tmp_path)
    _edit(tmp_path / block_name(8), lambda arrays: arrays.update({name: _altered(arrays[name])}))
    _assert_flown_again(whole, tmp_path)


@pytest.mark.parametrize("extra", [{"note": np.zeros(1)}, {"seal": np.array("")}, {"seal": np.zeros(3)}])
def test_a_block_with_more_or_without_a_seal_is_flown_again(
    whole: tuple[Campaign, dict[str, bytes]], tmp_path: Path, extra: dict[str, Any]
) -> None:
    _copy(whole[1], tmp_path)
    _edit(tmp_path / block_name(8), lambda arrays: arrays.update(extra))
    _assert_flown_again(whole, tmp_path)


def _first(name: str, value: float) -> Callable[[dict[str, Any]], Any]:
    def change(arrays: dict[str, Any]) -> None:
        arrays[name] = arrays[name].copy()
        arrays[name].flat[0] = value

    return change


IMPOSSIBLE: dict[str, Callable[[dict[str, Any]], Any]] = {
    "a verdict beyond the last": _first("verdict", 7.0),
    "a verdict before the first": _first("verdict", -1.0),
    "half a verdict": lambda a: (_first("verdict", 1.5)(a), _first("completed", 0.0)(a)),
    "a verdict of NaN": _first("verdict", np.nan),
    "a failure that completed": _first("verdict", 1.0),
    "a success that did not": _first("completed", 0.0),
    "completed twice": _first("completed", 2.0),
    "all not completed": lambda a: a.update(completed=np.zeros_like(a["completed"])),
    "NaN of the samples at the limit": _first("saturated", np.nan),
    "more samples at the limit than all": _first("saturated", 1.1),
    "a time before the start": _first("duration", -1e-3),
    "a time after the end": _first("duration", 1.0),
    "a time of NaN": _first("duration", np.nan),
    "a negative deviation": _first("deviation", -1e-6),
    "a negative rms": _first("rms", -1e-6),
    "a negative force": _first("force", -1.0),
    "a negative rise": _first("rise", -1e-3),
    "a negative overshoot": _first("overshoot", -1e-3),
    "an infinite deviation of a completed run": _first("deviation", np.inf),
    "NaN of the last error of a completed run": _first("last", np.nan),
    "NaN of the clearances of a completed run": _first("contact", np.nan),
    "single precision": lambda a: a.update(rms=a["rms"].astype("f4")),
    "other columns": lambda a: a.update(force=a["force"][:, :2]),
    "other machines": _first("values", 0.5),
    "other names": lambda a: a.update(names=a["names"][::-1]),
    "an unknown engine": lambda a: a.update(engine=np.array("steam")),
}


@pytest.mark.parametrize("change", IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_numbers_that_no_run_has_are_flown_again_under_a_seal_that_fits(
    whole: tuple[Campaign, dict[str, bytes]], tmp_path: Path, change: Callable[[dict[str, Any]], Any]
) -> None:
    _copy(whole[1], tmp_path)
    _edit(tmp_path / block_name(8), dict, first=8)
    assert (tmp_path / block_name(8)).read_bytes() == whole[1][block_name(8)]
    _edit(tmp_path / block_name(8), change, first=8)
    _assert_flown_again(whole, tmp_path)


def test_blocks_of_equal_machines_do_not_change_places(controller: Controller, tmp_path: Path) -> None:
    """Without spread all machines are equal, and the noise of the blocks is not: the seal knows the block's place."""
    first = campaign(Plan(controller, spread={"m": 0.0}, samples=16, options=QUICK), tmp_path, block=8)
    files = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    (tmp_path / block_name(0)).write_bytes(files[block_name(8)])
    _assert_flown_again((first, files), tmp_path, block_name(0))


@pytest.mark.slow
def test_changed_outcomes_are_named_and_not_reported(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`completed` zeroed, with and without a verdict that no run has: the yield stays, without a traceback."""
    monkeypatch.setattr("malta.cli.campaign.draw_figures", lambda *_: [])
    command = (
        "campaign",
        GAINS,
        "--samples",
        "8",
        "--option",
        "fidelity=force",
        "--option",
        "rise=3ms",
        "--out",
        tmp_path,
    )
    path, wanted = tmp_path / block_name(0), run(*command)
    zeroed = {"completed": np.zeros(8)}
    for more in ({}, {"verdict": np.full(8, 7.0)}, {"saturated": np.full((8, 5), np.nan)}):
        _edit(path, partial(dict.update, **zeroed | more))
        code, out, err = run(*command)
        assert (code, out) == wanted[:2]
        assert "\n" not in err.strip()
        assert f"{block_name(0)}: a damaged block, flown again" in err


# --- the revision of engine and law ---


def test_hashes_tell_where_a_part_ends() -> None:
    """A line that moves from one module to the next changes the revision."""
    assert identity._sha256([b"ab", b"c"]) != identity._sha256([b"a", b"bc"])
    assert identity._sha256([b"ab", b"c"]) == identity._sha256([b"ab", b"c"])


def test_a_folder_of_another_engine_is_refused(
    whole: tuple[Campaign, dict[str, bytes]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A module of the simulation that says something else: neither read nor gone on with."""
    _copy(whole[1], tmp_path)
    found, path = whole[0], tmp_path / MANIFEST
    monkeypatch.setattr(identity, "_engine_sha256", lambda: "0" * 64)
    revision_of.cache_clear()
    try:
        for read in (
            lambda: campaign(found.plan, tmp_path),
            lambda: read_plan(tmp_path, found.plan.controller),
        ):
            assert "revision.engine: found" in str(refusal(read, path))
    finally:
        revision_of.cache_clear()


@pytest.mark.parametrize(
    "edited", ["simulation/engine/digest.py", "simulation/engine/engine.c", "model/plant.py"]
)
def test_a_module_that_decides_runs_changes_the_revision(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, edited: str
) -> None:
    for package in identity.PACKAGES:
        (tmp_path / package).mkdir()
        for file in (Path(malta.__file__).parent / package).iterdir():
            if file.is_file():
                (tmp_path / package / file.name).write_bytes(file.read_bytes())
    monkeypatch.setattr(identity, "files", lambda _: tmp_path)
    before = identity._engine_sha256.__wrapped__()
    assert before == identity._engine_sha256()
    changed = tmp_path / edited
    changed.write_bytes(changed.read_bytes() + b"\n")
    assert identity._engine_sha256.__wrapped__() != before


@pytest.mark.slow
def test_the_law_is_that_of_the_scenario(plan: Plan) -> None:
    """Other functions, other law: fidelity, delay, sensors. The same functions: the same law."""
    plans = [
        plan,
        replace(plan, options=QUICK | {"fidelity": "dq"}),
        replace(plan, options=QUICK | {"delay": 2}),
        replace(plan, options=QUICK | {"quantize": True}),
    ]
    laws = [revision_of(p.plant, p.controller, planned_run(p).scenario)["law"] for p in plans]
    assert len(set(laws)) == len(plans)
    again = replace(plan, seed=3)
    assert revision_of(again.plant, again.controller, planned_run(again).scenario)["law"] == laws[0]


@pytest.mark.slow
def test_a_machine_that_looks_up_a_table_has_a_law_too() -> None:
    """The numbers of the table are part of it."""
    c = malta.gains.read("design/gains/planar.json")
    laws = []
    for cells, delay in ((4.0, 1), (4.0, 1), (4.0, 2), (5.0, 1)):
        looking_up = replace(c, parameters=replace(cast("Any", c.parameters), cells=cells))
        options = {"duration": 1e-3, "delay": delay}
        plan = Plan(looking_up, "step", {"m": 0.1}, samples=8, options=options)
        laws.append(plan.manifest["revision"]["law"])
    assert laws[0] == laws[1]
    assert len(set(laws)) == 3


ROTOR = Path("examples/rotor/rotor.py")


def test_another_text_of_a_machine_is_another_campaign(tmp_path: Path) -> None:
    """A comment suffices: whether it changes a run, nobody can tell from outside."""
    found = []
    for more in ("", "# otherwise\n"):
        (tmp_path / "spindle.py").write_text(ROTOR.read_text(encoding="utf-8") + more, encoding="utf-8")
        module = malta.machine(tmp_path / "spindle.py")
        found.append(identity._module_parts(module.__name__))
    assert found[0][1:] != found[1][1:]
    assert identity._module_parts("__main__") == [b"__main__"]


def test_model_and_experiments_are_in_the_revision(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an experiment every module of its folder."""
    names: list[str] = []

    def parts(name: str) -> list[bytes]:
        names.append(name)
        return [str(len(names)).encode()]

    monkeypatch.setattr(identity, "_module_parts", parts)
    found = []
    for _ in range(2):
        arguments = (plan.plant, plan.controller, planned_run(plan).scenario)
        found.append(revision_of.__wrapped__(*arguments)["machine"])
    assert found[0] != found[1]
    own = "malta.machines.tubular"
    assert names[:3] == [f"{own}.plant", f"{own}.parameters", f"{own}.experiments"]
    monkeypatch.undo()
    assert len(identity._module_parts(names[2])) > len(identity._module_parts(names[0])) == 2


def test_a_worker_of_another_revision_is_refused(plan: Plan) -> None:
    from importlib.metadata import version

    task = replace(task_of(plan, version("malta")), identity="0" * 64)
    assert simulate_at_worker(task, 0, 8) == (
        *("--cluster", "a worker", "another revision of malta or of the machine"),
        "the same as here",
    )


# --- fingerprints ---


def _variants(value: Any) -> Iterator[tuple[str, Any]]:
    """The value with one leaf changed, for every leaf of its records and tuples; named by the way to the leaf."""
    if is_dataclass(value):
        for f in fields(value):
            for way, other in _variants(getattr(value, f.name)):
                with suppress(malta.InputError):  # no such record: braking of outputs that are no states
                    yield f".{f.name}{way}", replace(cast("Any", value), **{f.name: other})
    elif isinstance(value, tuple):
        make = getattr(value, "_make", tuple)
        for k, entry in enumerate(value):
            for way, other in _variants(entry):
                yield f"[{k}]{way}", make((*value[:k], other, *value[k + 1 :]))
    elif isinstance(value, np.ndarray):
        yield "", np.append(value, 1.0) if not value.size else _nudged(value)
    elif isinstance(value, float):  # by a last digit: parameters have ranges
        yield "", math.nextafter(value, math.inf)
    else:
        yield "", 1.0 if value is None else value + ("x" if isinstance(value, str) else 1)


def _nudged(array: Any) -> Any:
    other = array.copy()
    other.flat[-1] = np.nextafter(other.flat[-1], np.inf) if np.isfinite(other.flat[-1]) else 0.0
    return other


@pytest.mark.parametrize("name", ["calibrated", "tubular_pid", "planar"])
def test_every_entry_of_a_controller_is_in_its_fingerprint(name: str) -> None:
    """The operating point and the signals too: no two of the controllers that differ in one place share one."""
    controller = malta.gains.read(f"design/gains/{name}.json")
    variants = dict(_variants(controller))
    for way in (".operating_point[0]", ".operating_point[1]", ".states[0].name", ".measurements[1].unit"):
        assert way.replace(".name", "[0]").replace(".unit", "[1]") in variants
    found = [fingerprint(c) for c in (controller, *variants.values())]
    assert len(set(found)) == len(found) > 60


ALIKE: dict[str, tuple[Any, Any]] = {
    "a bracket further": (((1.0, 2.0), (3.0,)), ((1.0,), (2.0, 3.0))),
    "an entry further in": (((1.0,), 2.0), ((1.0, 2.0),)),
    "one bracket less": ((1.0, 2.0), ((1.0, 2.0),)),
    "a letter further": (("ab", "c"), ("a", "bc")),
    "a text of a list": ("('a', 'b')", ("a", "b")),
    "a shape": (np.zeros((2, 3)), np.zeros((3, 2))),
    "empty shapes": (np.zeros((0, 3)), np.zeros((0, 2))),
    "nothing or its name": (None, "None"),
    "empty lists": (((), (1.0,)), ((1.0,), ())),
    "a name further": ({"a": {"b": 1.0}}, {"a": {}, "b": 1.0}),
}


@pytest.mark.parametrize(("one", "other"), ALIKE.values(), ids=ALIKE)
def test_structure_is_part_of_a_fingerprint(one: Any, other: Any) -> None:
    assert fingerprint(one) != fingerprint(other)


def test_a_fingerprint_does_not_tell_what_files_do_not_store() -> None:
    """Whole numbers, zeros with a sign, lists for tuples."""
    assert fingerprint((1, -0.0, np.float64(2), np.int64(3))) == fingerprint([1.0, 0.0, 2, 3])
    assert fingerprint({"a": 1, "b": 2}) == fingerprint({"b": 2, "a": 1})


def test_plans_on_other_matrices_are_other_plans(designs: dict[str, Design]) -> None:
    """A linear machine's matrices, limits and signals are no parameters with a unit; the plan has them all the same."""
    machines = [
        malta.linear_machine(
            [[0, 1], [a, 0]], [[0], [2]], [[1, 0]], name="cart", limit=limit, states=[*states]
        )
        for a, limit, states in ((0, 1, "xv"), (1e-9, 1, "xv"), (0, 2, "xv"), (0, 1, "xw"))
    ]
    found = [fingerprint(machine.parameters) for machine in machines]
    assert len(set(found)) == 4
    plan = Plan(designs["calibrated"].controller, spread={"m": 0.1}, samples=8, options=QUICK)
    assert plan.manifest["machine"]["sha256"] == fingerprint(plan.parameters)
