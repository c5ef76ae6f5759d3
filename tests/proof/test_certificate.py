"""Certificates of margins: those of loops that are known hold, and whatever is changed in one is refused."""

from __future__ import annotations

import ast
import copy
import json
import math
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import flint
import numpy as np
import pytest
from conftest import Run
from flint import arb, fmpq
from tampering import claiming, written

import malta
from malta.checker.check import tiles_box
from malta.checker.loop import determinant_bounds
from malta.errors import CheckError, InputError
from malta.gains.certified import check, origin_of
from malta.linear.uncertain import Compensator
from malta.loops.windings import LAST_STAGE
from malta.margins.travel import travel_loops, travel_margin
from malta.proof import certificate

pytestmark = [pytest.mark.usefixtures("proven_once"), pytest.mark.first]

ROOT = Path(__file__).parents[2]
HALBACH = ROOT / "design" / "gains" / "halbach.json"
Change = Callable[[dict[str, Any]], None]


@pytest.fixture(scope="module")
def document(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The certificate of the Halbach stage's loop: sampled, with hold and lag, along its travel."""
    return shipped("halbach", tmp_path_factory.mktemp("certificate"))[1]


def shipped(name: str, folder: Path) -> tuple[Path, dict[str, Any]]:
    """A design's certificate for 20 % of every parameter that its machine names, or 10 %."""
    gains = ROOT / "design" / "gains" / f"{name}.json"
    controller = malta.gains.read(gains)
    plant = malta.plant_of(controller.parameters)
    # Four parameters of the tubular machine beside its position and its cogging take ten minutes.
    ranges = dict.fromkeys(("m", "A", "b") if plant.name == "halbach" else ("m", "K_A"), 0.2)
    margin = travel_margin(plant, controller, ranges)
    places, over = travel_loops(plant, controller, tuple(ranges))
    origin = origin_of(gains, plant, controller, LAST_STAGE, len(places))
    path = certificate.write_certificate(folder / "certificate.json", places, ranges, over, margin, origin)
    assert path.stat().st_size < 1_000_000
    content = json.loads(path.read_text())
    assert isinstance(content, dict)
    return path, content


def first(content: dict[str, Any]) -> dict[str, Any]:
    """The first part of the first group."""
    part = content["loops"][0]["groups"][0]["parts"][0]
    assert isinstance(part, dict)
    return part


# loops that are known


def spring() -> Any:
    def matrices(m: Any, k: Any) -> Any:
        return [[0, 1], [-k / m, -0.2 / m]], [[0], [1 / m]], [[1, 0]]

    return malta.uncertain(matrices, {"m": 1.0, "k": 4.0})


def gain(*values: float) -> Compensator:
    """Each input from its own output."""
    n = len(values)
    return Compensator(np.zeros((0, 0)), np.zeros((0, n)), np.zeros((n, 0)), np.diag(values))


def test_a_continuous_loop(tmp_path: Path) -> None:
    # m s^2 + 0.2 s + k - 1: stable until k = 1, t = 3 / 0.4; the mass stays above zero until t = 5
    system, law = spring(), gain(1.0)
    margin = malta.robust_margin(system, law, {"m": 0.1, "k": 0.1})
    assert margin.upper == pytest.approx(7.5, rel=1e-6)
    path = certificate.write_certificate(
        tmp_path / "c.json", [(system, law)], {"m": 0.1, "k": 0.1}, None, margin
    )
    found = check(path)
    assert found.ok
    assert found.claim == pytest.approx(0.999 * 7.5, rel=2e-3)
    assert len(found.groups) == 1


@pytest.mark.slow
def test_less_is_claimed_where_the_whole_margin_is_not_proven(tmp_path: Path) -> None:
    system, law, box = spring(), gain(1.0), {"m": 0.1, "k": 0.1}
    margin = replace(malta.robust_margin(system, law, box), lower=8.0)  # more than there is: 7.5
    found = check(certificate.write_certificate(tmp_path / "c.json", [(system, law)], box, None, margin))
    assert found.ok
    assert found.claim == pytest.approx(0.9 * 8.0)
    margin = replace(margin, lower=400.0)
    with pytest.raises(CheckError, match="no certificate: a parameter that divides reaches zero"):
        certificate.write_certificate(tmp_path / "c.json", [(system, law)], box, None, margin)


@pytest.mark.slow
@pytest.mark.parametrize(("delay", "lag"), [(0, None), (2, None), (1, 50.0)])
def test_a_sampled_loop_with_delay_and_lag(tmp_path: Path, delay: int, lag: float | None) -> None:
    own = Compensator(
        np.array([[0.5]]), np.array([[1.0]]), np.array([[0.3]]), np.array([[-0.4]]),
        sample_time=0.05, delay=delay, lag=lag,
    )  # fmt: skip
    margin = malta.robust_margin(spring(), own, {"m": 0.3, "k": 0.3})
    path = certificate.write_certificate(
        tmp_path / "c.json", [(spring(), own)], {"m": 0.3, "k": 0.3}, None, margin
    )
    found = check(path)
    assert found.ok, found.failures
    assert margin.lower is not None
    assert found.claim == pytest.approx(margin.lower, rel=2e-3)


def test_groups_and_several_loops(tmp_path: Path) -> None:
    system = malta.uncertain(
        lambda a: ([[-1 + a, 0], [1, -2]], [[1, 0], [0, 1]], [[1, 0], [0, 1]]), {"a": 0.1}
    )
    loops = [(system, gain(-1.0, -g)) for g in (1.0, 2.0)]
    margins = [malta.robust_margin(*loop, {"a": (0.0, 0.2)}) for loop in loops]
    path = certificate.write_certificate(tmp_path / "c.json", loops, {"a": (0.0, 0.2)}, None, margins[0])
    found = check(path)
    assert found.ok, found.failures
    assert len(found.groups) == 4


def test_an_expression_without_a_rule_is_refused(tmp_path: Path) -> None:
    import casadi as ca

    system = malta.uncertain(lambda a: ([[-1 - ca.sin(a)]], [[1]], [[1]]), {"a": 0.1})
    margin = malta.robust_margin(system, gain(-1.0), {"a": (0.0, 0.2)})
    with pytest.raises(InputError, match="found sin"):
        certificate.write_certificate(
            tmp_path / "c.json", [(system, gain(-1.0))], {"a": (0.0, 0.2)}, None, margin
        )


def masses() -> Any:
    """m x'' = -k x - 0.2 x' + u as it stands, with the mass on the left."""

    def matrices(m: Any, k: Any) -> Any:
        return [[0, 1], [-k, -0.2]], [[0], [1]], [[1, 0]], [[0]], [[1, 0], [0, m]]

    return malta.uncertain(matrices, {"m": 1.0, "k": 4.0})


def test_a_diagonal_descriptor(tmp_path: Path) -> None:
    system, law, box = masses(), gain(1.0), {"m": 0.1, "k": 0.1}
    margin = malta.robust_margin(system, law, box)
    assert margin.upper == pytest.approx(7.5, rel=1e-6)
    path = certificate.write_certificate(tmp_path / "c.json", [(system, law)], box, None, margin)
    found = check(path)
    assert found.ok, found.failures
    assert found.claim == pytest.approx(0.999 * 7.5, rel=2e-3)
    content = json.loads(path.read_text())
    content["loops"][0]["E"] = content["loops"][0]["E"][:1]
    with pytest.raises(InputError, match="a diagonal"):
        check(written(content, tmp_path))


@pytest.mark.slow
def test_a_mass_that_may_vanish_is_refused(tmp_path: Path) -> None:
    # (p s + p) x: stable, but at p = 0 it is no equation at all; E and A cancel in E^-1 A
    system = malta.uncertain(lambda p: ([[-p]], [[p]], [[1]], [[0]], [[p]]), {"p": 1.0})
    margin = malta.robust_margin(system, gain(-1.0), {"p": 0.1}, budget=malta.proof.Budget(1))
    path = certificate.write_certificate(
        tmp_path / "c.json", [(system, gain(-1.0))], {"p": 0.1}, None, margin
    )
    assert check(path).ok
    content = json.loads(path.read_text())
    claiming(content, 20.0)
    first(content)["box"][0] = [-1.001, 3.001]
    found = check(written(content, tmp_path))
    assert found.failures == ("loop, group 1: E is not shown to be invertible",)


@pytest.mark.parametrize(
    ("system", "law", "why"),
    [
        (
            lambda a: ([[-1 - a]], [[1]], [[1]], [[0.1]]),
            -1.0,
            "found a matrix D, expected outputs y = C x alone",
        ),
        (
            lambda a: ([[-1 - a, 0], [0, -1]], [[1], [0]], [[1, 0]], [[0]], [[2, 1], [1, 2]]),
            -1.0,
            "found a matrix E that couples states, expected a diagonal E, or none",
        ),
    ],
)
def test_what_certificates_do_not_cover(tmp_path: Path, system: Any, law: float, why: str) -> None:
    loop = malta.uncertain(system, {"a": 0.1}), gain(law)
    margin = malta.robust_margin(*loop, {"a": (0.0, 0.2)})
    assert margin.lower is not None
    with pytest.raises(InputError, match=re.escape(why)):
        certificate.write_certificate(tmp_path / "c.json", [loop], {"a": (0.0, 0.2)}, None, margin)


def test_many_parameters_are_said_to_be_too_many(tmp_path: Path) -> None:
    names = [f"p{k}" for k in range(14)]
    system = malta.uncertain(
        (np.array([[-1.0]]), np.array([[1.0]]), np.array([[1.0]])),
        dict.fromkeys(names, 1.0),
        terms={name: ([[-0.1]], None, None) for name in names},
    )
    box = dict.fromkeys(names, 0.1)
    margin = replace(malta.robust_margin(system, gain(-1.0), box, budget=malta.proof.Budget(0.1)), lower=1.0)
    with pytest.raises(InputError, match="found 14 that act on one group, expected at most 13"):
        certificate.write_certificate(tmp_path / "c.json", [(system, gain(-1.0))], box, None, margin)


# couplings that are rounding


def springs(coupling: float, **options: Any) -> Any:
    """Two springs that pull at one another."""

    def matrices(k: Any) -> Any:
        A = [[0, 1, 0, 0], [-k, -0.2, coupling, 0], [0, 0, 0, 1], [coupling, 0, -2 * k, -0.2]]
        return A, [[0, 0], [1, 0], [0, 0], [0, 1]], [[1, 0, 0, 0], [0, 0, 1, 0]]

    return malta.uncertain(matrices, {"k": 4.0}, **options)


def cross(coupling: float, **options: Any) -> Compensator:
    """Gains of two loops, each with a little of the other's reading."""
    none = np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((2, 0))
    return Compensator(*none, np.array([[1.0, coupling], [coupling, 1.0]]), **options)


@pytest.mark.slow_for("system2-law2", "system3-law3", "system4-law4")
@pytest.mark.parametrize(
    ("system", "law"),
    [
        (springs(1e-15), gain(1.0, 1.0)),
        (springs(0.0), cross(1e-15)),
        (springs(0.0), cross(1e-15, lag=50.0)),
        (springs(0.0), cross(1e-15, sample_time=0.05)),
        (springs(0.0), cross(1e-15, sample_time=0.05, delay=1, lag=50.0)),
    ],
)
def test_rounding_between_groups_is_bounded(tmp_path: Path, system: Any, law: Compensator) -> None:
    margin = malta.robust_margin(system, law, {"k": 0.1})
    assert margin.lower is not None
    path = certificate.write_certificate(tmp_path / "c.json", [(system, law)], {"k": 0.1}, None, margin)
    found = check(path)
    assert found.ok, found.failures
    assert found.claim == pytest.approx(0.999 * margin.lower)
    assert [line.split(":")[0] for line in found.groups] == ["loop, group 1", "loop, group 2"]


@pytest.mark.parametrize("coupling", [0.1, 3.0])
def test_a_coupling_that_is_more_than_rounding_is_refused(tmp_path: Path, coupling: float) -> None:
    # (k - 1) (2 k - 1) > coupling^2 is what the loop needs; the claim without coupling reaches down to k = 1.003
    law, box = cross(1e-15), {"k": 0.1}
    margin = malta.robust_margin(springs(0.0), law, box)
    path = certificate.write_certificate(tmp_path / "c.json", [(springs(0.0), law)], box, None, margin)
    content = json.loads(path.read_text())
    gains = content["loops"][0]["compensator"]["D"]
    gains[0][1] = gains[1][0] = coupling
    assert "zero is not excluded" in check(written(content, tmp_path)).failures[0]
    for units in ([0] * 4, [300, 300, 0, 0], [-300, 300, 7, 0]):  # sizes that would hide it
        content["loops"][0]["units"] = units
        assert not check(written(content, tmp_path)).ok


def test_couplings_within_a_hold_are_refused(tmp_path: Path) -> None:
    system, law = springs(0.0), cross(1e-15, sample_time=0.05)
    margin = malta.robust_margin(system, law, {"k": 0.1})
    path = certificate.write_certificate(tmp_path / "c.json", [(system, law)], {"k": 0.1}, None, margin)
    content = json.loads(path.read_text())
    content["loops"][0]["A"].append([1, 2, content["loops"][0]["A"][0][2]])
    found = check(written(content, tmp_path))
    assert found.failures == ("loop: groups that act on one another between samples",)


def test_bounds_of_what_rounding_moves_are_bounds() -> None:
    rng = np.random.default_rng(2)
    for _ in range(20):
        m = rng.normal(size=(5, 5)) * 10.0 ** rng.uniform(-3, 3, (5, 5))
        e, units = 10.0 ** rng.uniform(-3, 3, 5), rng.integers(-4, 5, 5).tolist()
        sizes = [[arb(x) for x in row] for row in np.abs(m).tolist()]
        b = determinant_bounds(sizes, [True] * 5, [arb(x) for x in e.tolist()], dict(enumerate(units)))
        for g in 10.0 ** rng.uniform(-3, 3, 5):
            for angle in rng.uniform(0, 2 * np.pi, 3):
                pencil = g * np.exp(1j * angle) * np.eye(5) + m
                cofactors = np.linalg.det(pencil) * np.linalg.inv(pencil)  # adjugate: row j, column l
                largest = (np.abs(cofactors) @ e / 2.0 ** np.array(units)).max()
                assert sum(float(x) * g**k for k, x in enumerate(b)) >= 0.999999 * largest


# tampering


def shrunk(content: dict[str, Any]) -> None:
    cell = first(content)["cells"][3]
    cell[2] = cell[1] + 0.99 * (cell[2] - cell[1])


def removed(content: dict[str, Any]) -> None:
    del first(content)["cells"][-1]


def raised(content: dict[str, Any]) -> None:
    claiming(content, 1.01 * content["claim"]["lower"])


def raised_with_its_box(content: dict[str, Any]) -> None:
    """1 % more, and the cells stretched with it: beyond the margin they cannot hold."""
    raised(content)
    for side, p in zip(first(content)["box"], content["claim"]["parameters"], strict=True):
        low, high = p["interval"]
        side[:] = [math.nextafter(low, -math.inf).hex(), math.nextafter(high, math.inf).hex()]


def turned(content: dict[str, Any]) -> None:
    for cell in first(content)["cells"]:
        cell[4], cell[5] = -cell[5], cell[4]


def narrow(content: dict[str, Any]) -> None:
    side = first(content)["box"][0]
    side[0] = (float.fromhex(side[0]) * 1.001).hex()


def kept_less(content: dict[str, Any]) -> None:
    """The enclosure's polynomials cut to their first terms."""
    for axis in first(content)["axes"]:
        axis[2] = 0


def interpolated_less(content: dict[str, Any]) -> None:
    for axis in first(content)["axes"]:
        axis[0] = axis[2] = min(axis[0], 1)


def gain_changed(content: dict[str, Any]) -> None:
    row = content["loops"][0]["compensator"]["D"][0]
    row[0] = (-float.fromhex(row[0])).hex()


def stripped(content: dict[str, Any]) -> None:
    content["loops"][0]["groups"][0]["states"] = [0]


@pytest.mark.slow_for(
    "raised_with_its_box-zero is not excluded",
    "turned-zero is not excluded",
    "kept_less-zero is not excluded",
)
@pytest.mark.parametrize(
    ("change", "why"),
    [
        (shrunk, "leave a gap"),
        (removed, "leave a gap"),
        (raised, "parts of the box leave a gap"),
        (raised_with_its_box, "zero is not excluded"),
        (turned, "zero is not excluded"),
        (narrow, "parts of the box leave a gap"),
        (kept_less, "zero is not excluded"),
        (interpolated_less, "zero is not excluded"),
        (gain_changed, "not shown to be stable|zero is not excluded"),
        (stripped, "do not hold each state once"),
    ],
)
def test_whatever_is_changed_is_refused(
    document: dict[str, Any], tmp_path: Path, change: Change, why: str
) -> None:
    content = copy.deepcopy(document)
    change(content)
    plain = check(written(content, tmp_path, signed=False))
    assert not plain.ok
    assert "changed after it was written" in plain.failures[0]
    found = check(written(content, tmp_path))
    assert not found.ok
    assert re.search(why, found.failures[0])


# files that are none


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("no json", "no JSON"),
        ("[" * 100_000, "no JSON"),
        ("[]", "a table"),
        ("{}", "format: found nothing"),
        ('{"format": "malta margin certificate", "version": 1}', "version: found 1"),
    ],
)
def test_files_that_are_no_certificates(tmp_path: Path, text: str, why: str) -> None:
    (tmp_path / "c.json").write_text(text)
    with pytest.raises(InputError, match=why):
        check(tmp_path / "c.json")


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("claim", "lower"), float("nan")), (("claim", "lower"), "0x1p2000"), (("claim", "lower"), -1.0),
        (("claim", "lower"), None), (("claim", "current_loops"), "ideal"), (("claim", "current_loops"), None),
        (("claim", "machine"), None), (("claim", "law", "sha256"), "f" * 63 + "g"), (("claim", "law"), []),
        (("claim", "machine", "name"), "a\nb"), (("claim", "sample_time"), 0.0), (("claim", "places"), [0.0]),
        (("claim", "parameters", 0, "unit"), None), (("claim", "parameters", 1, "name"), "m"),
        (("claim", "parameters", 0, "interval"), [2.0, 1.0]), (("claim", "parameters", 0, "over"), [1.0, 2.0]),
        (("claim", "parameters"), []),
        (("loops",), {}), (("loops", 0, "shape"), [10**9, 1, 1]), (("loops", 0, "delay"), 10**6),
        (("loops", 0, "sample_time"), "inf"), (("loops", 0, "compensator", "A", 0), []),
        (("loops", 0, "steps", 0), ["call", 0, [], 0.0]), (("loops", 0, "A", 0), [0, 0, 10**6]),
        (("loops", 0, "groups", 0, "parts", 0, "cells", 0), [2, 0, 1, [], 1, 0]),
        (("loops", 0, "groups", 0, "parts", 0, "box", 0), [2.0, 1.0]),
        (("claim", "parameters", 0, "nominal"), 1e300), (("claim",), None), (("loops", 0, "units"), [1]),
        (("loops", 0, "groups", 0, "parts", 0, "axes", 0), [2, 0.5, 2]),
        (("loops", 0, "groups", 0, "parts", 0, "axes", 0), [2, 4.0, 3]),
    ],
)  # fmt: skip
def test_fields_that_are_wrong(
    document: dict[str, Any], tmp_path: Path, place: tuple[Any, ...], value: Any
) -> None:
    content = copy.deepcopy(document)
    table: Any = content
    for key in place[:-1]:
        table = table[key]
    table[place[-1]] = value
    with pytest.raises(InputError):
        check(written(content, tmp_path))
    if isinstance(table, dict):
        del table[place[-1]]
        with pytest.raises(InputError):
            check(written(content, tmp_path))


# the parts of the proof


def test_the_checker_is_a_folder_that_imports_flint_alone() -> None:
    """Beside the standard library and its own three files."""
    outside = set()
    for path in sorted((ROOT / "malta" / "checker").glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.level:
                assert node.module in ("check", "file", "loop")
            elif isinstance(node, ast.ImportFrom):
                outside.add(str(node.module).partition(".")[0])
            elif isinstance(node, ast.Import):
                outside.update(alias.name.partition(".")[0] for alias in node.names)
    assert outside - set(sys.stdlib_module_names) == {"flint"}


# Site packages without malta: the folder and flint are all that can be imported.
ALONE = """
import importlib.util, runpy, sys
from pathlib import Path
sys.path += [{folder!r}]
flint = importlib.util.spec_from_file_location("flint", {flint!r}, submodule_search_locations=[{home!r}])
sys.modules["flint"] = importlib.util.module_from_spec(flint)
flint.loader.exec_module(sys.modules["flint"])
assert importlib.util.find_spec("malta") is None and importlib.util.find_spec("numpy") is None
sys.argv = ["checker", *sys.argv[1:]]
runpy.run_module("checker", run_name="__main__", alter_sys=True)
"""


def elsewhere(folder: Path, *arguments: str) -> tuple[int, str, str]:
    """The exit code and the texts of the checker, copied to a folder and run without malta."""
    shutil.copytree(ROOT / "malta" / "checker", folder / "checker", dirs_exist_ok=True)
    program = ALONE.format(folder=str(folder), flint=flint.__file__, home=str(Path(flint.__file__).parent))
    command = [sys.executable, "-I", "-S", "-c", program, *arguments]
    ended = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)
    return ended.returncode, ended.stdout, ended.stderr


def test_the_folder_checks_a_shipped_certificate_elsewhere(document: dict[str, Any], tmp_path: Path) -> None:
    whole = written(document, tmp_path)
    code, out, err = elsewhere(tmp_path, str(whole))
    assert (code, err) == (0, "")
    first_line, *_, last = out.splitlines()
    assert first_line.startswith("halbach, law halbach, sampled every ")
    assert last == f"stable in {document['claim']['lower']!r} of the box: holds"

    changed = copy.deepcopy(document)
    raised(changed)
    code, out, err = elsewhere(tmp_path, str(written(changed, tmp_path)))
    assert (code, out.splitlines()[-1].endswith("does not hold")) == (1, True)
    assert err.count("\n") == 1

    changed = copy.deepcopy(document)  # with a seal of its own
    first(changed)["cells"][0][4] = -first(changed)["cells"][0][4]
    first(changed)["cells"][0][5] = -first(changed)["cells"][0][5]
    code, out, err = elsewhere(tmp_path, str(written(changed, tmp_path)))
    assert (code, "zero is not excluded from cell 1\n" in err) == (1, True)

    cut = tmp_path / "cut.json"
    cut.write_text(json.dumps(document)[:-100])
    code, out, err = elsewhere(tmp_path, str(cut))
    assert (code, out) == (2, "")
    assert err.startswith(f"{cut}: found no JSON (")
    code, out, err = elsewhere(tmp_path, str(tmp_path / "none.json"))
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert elsewhere(tmp_path)[0] == 2


def test_a_check_ends_in_time(document: dict[str, Any], tmp_path: Path) -> None:
    found = check(written(document, tmp_path), seconds=1e-9)
    assert (found.ok, found.failures) == (False, ("loop: time is up",))


def test_tiles_without_a_gap() -> None:
    half, whole = fmpq(1, 2), [(fmpq(0), fmpq(1))] * 2
    left, low, high = ((0, half), (0, 1)), ((half, 1), (0, half)), ((half, 1), (half, 1))
    assert tiles_box([left, low, high], whole)
    assert not tiles_box([left, low], whole)
    assert not tiles_box([left, low, ((half, 1), (half + fmpq(1, 10**30), 1))], whole)
    assert not tiles_box([], whole)


def test_determinant_bounds_are_bounds() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        m = rng.normal(size=(5, 5)) * 10.0 ** rng.uniform(-6, 6, (5, 5))
        found = determinant_bounds([[arb(abs(x)) for x in row] for row in m.tolist()])
        exact = np.abs(np.poly(-m)[::-1])
        assert all(float(b) >= 0.999999 * a for a, b in zip(exact, found, strict=True))


# the command line


@pytest.mark.slow
def test_verify_writes_and_check_confirms(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    code, out, _ = run(
        "verify", str(HALBACH), "--uncertain", "b=20%", "--time", "60", "--certificate", str(path)
    )
    assert (code, f"wrote {path}" in out) == (0, True)
    code, out, err = run("check", str(path), "--gains", str(HALBACH), "--uncertain", "b=20%")
    assert (code, err) == (0, "")
    assert out.splitlines()[-1].endswith("% of the uncertainty: holds")
    code, out, err = run("check", str(path), "--gains", str(HALBACH))
    assert (code, "m is not among its parameters" in err) == (1, True)
    code, out, err = run("check", str(path), "--gains", str(ROOT / "design/gains/table2.json"))
    assert code == 1
    assert "the machine is halbach, that of " in err
    content = json.loads(path.read_text())
    raised(content)
    code, out, err = run("check", str(written(content, tmp_path)), "--json")
    assert (code, json.loads(out)["holds"]) == (1, False)
    assert run("check", "pyproject.toml")[0] == 2


@pytest.mark.slow
def test_a_first_look_without_the_proof(run: Run) -> None:
    code, out, err = run("verify", str(HALBACH), "--uncertain", "b=20%", "--no-proof")
    assert (code, err) == (0, "")
    assert "not proven" in out
    assert run("verify", str(HALBACH), "--no-proof", "--certificate", "c.json")[0] == 2


def test_an_old_certificate_is_renewed_in_its_place(run: Run, tmp_path: Path) -> None:
    """It says what it does not cover; `--renew` proves it anew, and takes nothing but certificates."""
    old = tmp_path / "old.json"
    old.write_text('{"format": "malta margin certificate", "version": 2}')
    code, _, err = run("check", str(old))
    assert (code, "of a machine without its loads" in err, "--renew old.json" in err) == (2, True, True)
    assert run("verify", str(HALBACH), "--uncertain", "b=20%", "--renew", str(old))[0] == 0
    assert run("check", str(old))[0] == 0
    code, _, err = run("verify", str(HALBACH), "--renew", str(HALBACH))
    assert (code, "format: found nothing" in err) == (2, True)
    assert run("verify", str(HALBACH), "--renew", str(old), "--certificate", "c.json")[0] == 2
    assert run("verify", str(HALBACH), "--time", "0")[0] == 2


def test_ctrl_c_prints_what_stands(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: Any, bounds: Callable[[float, float], None], **__: Any) -> None:
        bounds(1.5, math.inf)
        bounds(1.5, 1.75)
        raise KeyboardInterrupt

    monkeypatch.setattr("malta.tuning.verify.staged_report", interrupted)
    code, out, err = run("verify", str(HALBACH))
    assert (code, out) == (130, "")
    assert err == "malta: interrupted; proven 150.00 %, lost at 175.00 %\n"


@pytest.mark.slow
def test_a_long_proof_says_where_it_is(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("malta.cli.output.PATIENCE", 0.0)
    monkeypatch.setattr("malta.cli.output.INTERVAL", 0.0)
    _, _, err = run("verify", str(HALBACH), "--uncertain", "b=20%")
    assert re.search(r"^malta: margins: proven \d+\.\d\d %, lost at ", err, re.MULTILINE)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["robust", "halbach_late", "halbach_pid"])
def test_shipped_designs(tmp_path: Path, name: str) -> None:
    path, content = shipped(name, tmp_path)
    own = {p["name"]: 0.2 for p in content["claim"]["parameters"] if p["down"]}
    found = check(path, ROOT / "design" / "gains" / f"{name}.json", uncertain=own)
    assert found.ok, found.failures
    assert len(found.groups) == len(content["loops"][0]["groups"])


@pytest.mark.slow
def test_a_design_whose_rounding_couples_all_states(tmp_path: Path) -> None:
    gains = ROOT / "design" / "gains" / "planar_pid.json"
    controller = malta.gains.read(gains)
    plant = malta.plant_of(controller.parameters)
    ranges = malta.read_design(ROOT / "design" / "planar_pid.toml").uncertainty
    margin = malta.proof.Margin(3.2, math.inf, None, None, {}, {}, (), 0.0)  # below what `verify` proves, 3.9
    places, over = travel_loops(plant, controller, tuple(ranges))
    origin = origin_of(gains, plant, controller, "lag", len(places))
    found = check(
        certificate.write_certificate(tmp_path / "c.json", places, ranges, over, margin, origin), gains
    )
    assert found.ok, found.failures
    assert found.claim == pytest.approx(0.999 * 3.2)
    assert (
        len(found.groups) == 6
    )  # four axes in the middle of the travel, of which pairs are coupled at its end


@pytest.mark.slow
def test_verify_asks_for_the_worst_case(run: Run) -> None:
    code, out, err = run("verify", str(HALBACH), "--no-proof", "--worst-case")
    assert (code, err) == (0, "")
    found = re.search(r"^ x +(\d\.\d+) +6\.6\d+ \(1\.06\) +(\d\.\d+) +A", out, re.M)
    assert found is not None
    assert 1.91 < float(found[1]) < float(found[2]) < 1.93
