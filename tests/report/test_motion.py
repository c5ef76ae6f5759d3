"""A machine in motion: bodies where the states say, small motion magnified, one file without a network."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from browsing import browser as browser, open_page
from conftest import ROOT, Run
from PIL import Image

import malta
from malta.machines.tubular.plant import measure_outputs
from malta.model.rigid_body import Body
from malta.report.page.bodies import VIEW, camera, machine_svg, mesh_of, place_points
from malta.report.page.motion import arrow_size, magnify, motion_gif, motion_page, read_motion
from malta.simulation.trajectory_file import save

if TYPE_CHECKING:
    from malta.report.page.motion import Animation

GAINS = ROOT / "design" / "gains" / "calibrated.json"
MACHINES = ("tubular", pytest.param("planar", marks=pytest.mark.slow), "halbach")


@pytest.fixture(scope="module")
def run_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of a stroke of 10 mm."""
    controller = malta.gains.read(GAINS)
    run = malta.simulate(malta.plant_of(controller.parameters), controller, malta.Scenario.stroke(10e-3))
    return save(run, tmp_path_factory.mktemp("run") / "stroke.npz")


@pytest.fixture(scope="module")
def stroke(run_file: Path) -> Animation:
    return read_motion(run_file, malta.plant_of(malta.gains.read(GAINS).parameters))


def runs_of(html: str) -> Any:
    """The runs in a page."""
    return json.loads(re.findall(r"id=\"motion-data\">(.*?)</script>", html, re.DOTALL)[0])["runs"]


@pytest.mark.parametrize("form", ["box", "cylinder", "sphere"])
def test_a_body_is_closed_and_its_faces_look_outwards(form: Any) -> None:
    """Every edge belongs to two faces, which go through it in opposite directions; the volume is that of the body."""
    mesh = mesh_of(Body("one", form, (0.2, 0.3, 0.5)))
    edges = [(face[k], face[(k + 1) % len(face)]) for face in mesh.faces for k in range(len(face))]
    assert len({*edges}) == len(edges)
    assert {(b, a) for a, b in edges} == {*edges}
    fans = [
        (mesh.points[f[0]], mesh.points[f[k]], mesh.points[f[k + 1]])
        for f in mesh.faces
        for k in range(1, len(f) - 1)
    ]
    volume = sum(np.dot(a, np.cross(b, c)) for a, b, c in fans) / 6
    whole = 0.2 * 0.3 * 0.5
    shares = {"box": 1.0, "cylinder": np.pi / 4, "sphere": np.pi / 6}
    assert volume == pytest.approx(shares[form] * whole, rel=0.05 if form == "sphere" else 0.01)


def test_points_of_the_mover_are_where_the_sensors_see_them(stroke: Animation) -> None:
    """The axis at a sensor plane, by the picture's rotation and by the machine's own h(x)."""
    par: Any = malta.gains.read(GAINS).parameters
    pose = np.array([2e-4, -1e-4, 0.0, 1e-3, -2e-3, 0.3])
    ends = mesh_of(stroke.bodies[-1])._replace(points=np.array([[0, 0, -par.l_S], [0, 0, par.l_S]]))
    seen = np.array(measure_outputs(par, np.append(pose, np.zeros(6)))).ravel()
    found = place_points(ends, pose)
    assert found[:, :2].ravel().tolist() == pytest.approx(seen[:4].tolist(), abs=2e-8)


@pytest.mark.parametrize("up", [0, 1, 2])
def test_a_camera_keeps_lengths_and_what_is_up(up: int) -> None:
    view = camera(up, *VIEW)
    assert view @ view.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(view) == pytest.approx(1)
    assert view[0] @ np.eye(3)[up] == pytest.approx(0, abs=1e-12)
    assert view[1] @ np.eye(3)[up] > 0.5


def test_small_motion_is_magnified_and_the_stroke_is_not(stroke: Animation) -> None:
    mover = len(stroke.bodies) - 1
    assert stroke.up == 1
    assert stroke.small[mover].tolist() == [True, True, False, True, True, True]
    assert not stroke.small[:mover].any()
    mesh, frames = mesh_of(stroke.bodies[mover]), range(0, len(stroke.t), 4)
    seen = np.array([place_points(mesh, magnify(stroke, k, mover, stroke.factor))[:, :2] for k in frames])
    narrow = min(stroke.bodies[mover].size)
    assert 0.02 * narrow < np.abs(seen - seen.mean(axis=0)).max() <= 0.25 * narrow
    axial = [magnify(stroke, k, mover, stroke.factor)[2] for k in (0, -1)]
    assert np.diff(axial) == pytest.approx(10e-3, rel=0.01)


def test_the_page_has_the_run_and_runs_no_other_script(stroke: Animation) -> None:
    html = motion_page(stroke, "<b>about</b>").html
    assert "<b>about" not in html
    assert not re.search(r"(src|href)=\"(?!data:)", html)
    assert re.search(r"script-src 'sha256-[\w+/]{43}='", html)
    (only,) = runs_of(html)
    assert only["bodies"][-1]["poses"][-1][2] == pytest.approx(5e-3, rel=0.02)
    z = next(one for one in only["signals"] if one["name"] == "z")
    assert (z["unit"], z["values"][0]) == ("mm", pytest.approx(-5, rel=1e-3))


def test_arrows_are_the_forces_that_acted_where_the_modules_are(stroke: Animation, run_file: Path) -> None:
    """At rest the modules carry the weight of the mover, upwards; the drives push along the stroke."""
    par: Any = malta.gains.read(GAINS).parameters
    one, two, drives = stroke.arrows
    assert [arrow.name for arrow in stroke.arrows] == ["module 1", "module 2", "drives"]
    assert [float(stroke.poses[arrow.body, 0, 2]) for arrow in (one, two)] == pytest.approx(
        [-par.l_B, par.l_B]
    )
    assert one.values[0, 1] + two.values[0, 1] == pytest.approx(par.m * par.g, rel=1e-3)
    with np.load(run_file) as saved:
        assert drives.values[:, 2].max() == pytest.approx(saved["force"][:, 4].max(), rel=0.01)
    assert np.abs(drives.values[:, :2]).max() == 0
    size, largest = arrow_size(stroke, "N"), np.abs(drives.values).max()
    assert size == 20
    assert size <= largest < 2.5 * size
    assert arrow_size(stroke, "N m") == 0
    (only,) = runs_of(motion_page(stroke).html)
    assert [arrow["scale"] for arrow in only["arrows"]] == [20] * 3
    assert only["arrows"][0]["values"][0][1] == pytest.approx(one.values[0, 1], rel=1e-5)


def test_many_runs_stay_in_a_small_page_with_fewer_frames_each(
    stroke: Animation, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each run is there from its beginning to its end."""
    alone = len(motion_page(stroke).html)
    monkeypatch.setattr("malta.report.page.motion.MAX_PAGE_BYTES", alone)
    html = motion_page([stroke] * 5).html
    assert len(html) < 1.5 * alone
    for run in runs_of(html):
        assert len(run["t"]) < len(stroke.t)
        assert (run["t"][0], run["t"][-1]) == pytest.approx((stroke.t[0], stroke.t[-1]))
        assert len(run["bodies"][-1]["poses"]) == len(run["t"]) == len(run["signals"][0]["values"])


@pytest.mark.slow
def test_a_machine_inside_its_margin_comes_to_rest_and_beyond_it_touches_down(
    tmp_path: Path, run: Run
) -> None:
    """At 95 and 105 % of the proven margin of the gain file, whose witness is at an end of the travel."""
    gains = ROOT / "design" / "gains" / "robust.json"
    run("motion", gains, "--witness", "--out", tmp_path / "m.html")
    inside, beyond = runs_of((tmp_path / "m.html").read_text(encoding="utf-8"))
    assert inside["ended"].startswith("completed")
    assert beyond["ended"].startswith("touchdown")
    x = [np.array([pose[0] for pose in one["bodies"][-1]["poses"]]) for one in (inside, beyond)]
    assert np.abs(x[0][-20:]).max() < 0.1 * np.abs(x[0][0]) < 10 * np.abs(x[1][-1])


def test_the_picture_moves_and_is_small(stroke: Animation) -> None:
    content = motion_gif(stroke, frames=6)
    with (
        Image.open(io.BytesIO(motion_gif(stroke, frames=2, dark=True))) as night,
        Image.open(io.BytesIO(content)) as day,
    ):
        corner: Any = night.convert("RGB").getpixel((2, 2)), day.convert("RGB").getpixel((2, 2))
        assert corner == ((26, 26, 26), (255, 255, 255))  # the grounds of dark and light pages
    assert len(content) < 600_000
    with Image.open(io.BytesIO(content)) as picture:
        assert getattr(picture, "n_frames", 1) == 6
        first = np.asarray(picture.convert("RGB")).astype(int)
        picture.seek(5)
        assert np.abs(np.asarray(picture.convert("RGB")).astype(int) - first).max() > 100


@pytest.mark.parametrize("name", MACHINES)
def test_every_machine_shows_a_body_that_its_states_move(name: str) -> None:
    plant = malta.plant_of(malta.read(f"data/{name}.toml"))
    assert plant.bodies is not None
    moves = [state for body in plant.bodies() for state in body.moves if state]
    assert moves
    assert {*moves} <= {s.name for s in plant.states}
    pushed = [name for body in plant.bodies() for one in body.resultants for name in one.inputs if name]
    assert sorted(pushed) == sorted(s.name for s in plant.inputs)
    assert all(min(body.size) > 0 for body in plant.bodies())


def test_a_new_machine_moves_as_well() -> None:
    """`malta new` writes bodies, of which the sphere moves up by q and the magnets pull it by f."""
    plant = malta.read_design(ROOT / "examples" / "ball" / "design" / "ball.toml").plant
    assert plant.bodies is not None
    upper, lower, sphere = plant.bodies()
    assert (upper.moves, lower.moves, sphere.moves) == ((), (), ("", "", "q"))
    gap = upper.place[2] - (upper.size[2] + sphere.size[2]) / 2
    par: Any = plant.parameters
    assert gap == pytest.approx(par.s)
    assert gap > par.q_max
    assert np.pi / 6 * sphere.size[0] ** 3 * 7850 == pytest.approx(par.m)


def test_the_machine_at_rest_is_drawn_small_as_in_motion() -> None:
    """The mover of MALTA is a cylinder: its seen sides and one end are filled, as long as the view shows them."""
    plant = malta.plant_of(malta.read("data/tubular.toml"))
    drawn = machine_svg(plant)
    filled = re.findall(r'd="([^"]*)" fill="#', drawn)
    assert len(filled) == 14 + 1  # of 28 sides and two ends
    x, y = np.array(
        [[float(n) for n in pair.split()] for d in filled for pair in re.split("[MLZ]", d) if pair]
    ).T
    mover = next(body for body in plant.bodies() if body.moves) if plant.bodies else None
    assert mover is not None
    view = camera(1, *VIEW)
    edges = mesh_of(mover).points @ view.T
    assert np.ptp(x) / np.ptp(y) == pytest.approx(np.ptp(edges[:, 0]) / np.ptp(edges[:, 1]), rel=0.01)
    assert 'aria-label="the machine tubular: mover in module 1, module 2"' in drawn
    assert machine_svg(malta.linear_machine([[0.0]], [[1.0]], [[1.0]], name="bare")) == ""


def test_the_command_writes_and_refuses(run_file: Path, tmp_path: Path, run: Run) -> None:
    out = tmp_path / "m.html"
    assert run("motion", GAINS, run_file, "--out", out).out.startswith("wrote ")
    assert out.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    cut = tmp_path / "cut.npz"
    cut.write_bytes(run_file.read_bytes()[:-300])
    for arguments, words in (
        ((GAINS, cut), "expected a run"),
        ((GAINS, run_file, "--out", tmp_path / "m.pdf"), ".html or .gif"),
        ((GAINS,), "--scenario NAME, or --witness"),
        ((GAINS, "--scenario", "fault"), "did you mean 'faults'"),
        ((ROOT / "design" / "gains" / "halbach.json", run_file), "expected those of halbach"),
    ):
        said = run("motion", *arguments)
        assert said.code == 2
        assert words in said.err


@pytest.mark.slow
def test_the_page_runs_in_a_browser(stroke: Animation, tmp_path: Path, browser: Any) -> None:
    """Without an error, no wider than a telephone; the scrubber moves the mover."""
    page = motion_page(stroke).save(tmp_path / "m.html")
    open_page(browser, page, width=390, scheme="dark")
    assert browser.execute_script("return document.documentElement.scrollWidth") <= 390
    picture = "return document.getElementById('view').toDataURL()"
    first = browser.execute_script(picture)
    move = "const t = document.getElementById('time'); t.value = t.max; t.dispatchEvent(new Event('input'));"
    browser.execute_script(move)
    moved = browser.execute_script(picture)
    assert moved != first
    assert browser.find_element("id", "forces").get_attribute("aria-pressed") == "true"
    browser.find_element("id", "forces").click()
    assert browser.execute_script(picture) != moved
    browser.find_element("id", "forces").click()
    assert browser.execute_script(picture) == moved
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []
