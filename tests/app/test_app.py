"""The live page: the session's numbers, what the server refuses, what saving writes, and the page in a browser."""

from __future__ import annotations

import http.client
import json
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import malta
from malta.app import followers
from malta.app.files import Edit, TakenError, fingerprint, inside, open_design, save_design
from malta.app.picture import View, map_document, picture, solve
from malta.app.server import MAX_DOCUMENT_BYTES, PAGES, Server
from malta.app.session import Session
from malta.app.worker import work
from malta.errors import InputError
from malta.files import shipped_path
from malta.margins.travel import travel_loops, travel_margin
from malta.processes import environment, python_module
from malta.proof.loss import ray_bound
from malta.tuning.judging import judge
from malta.tuning.search import model_and_controller

pytestmark = pytest.mark.usefixtures("proven_once")

HALBACH = shipped_path("design", "halbach_pid.toml")
ROBUST = shipped_path("design", "robust.toml")
BALL = shipped_path("examples", "ball", "design", "ball.toml")
ROTOR = shipped_path("examples", "rotor", "design", "rotor.toml")
SLOW = [pytest.param(design, marks=pytest.mark.slow) for design in (HALBACH, ROBUST)]


def copied(folder: Path, name: str = "halbach_pid") -> Path:
    """A design with its machine's data in a folder of its own."""
    machine = {"halbach_pid": "halbach", "robust": "tubular"}[name]
    for part in ("design", "data/published"):
        (folder / part).mkdir(parents=True)
    for file in (f"design/{name}.toml", f"data/{machine}.toml", f"data/published/{machine}.toml"):
        shutil.copy(shipped_path(*file.split("/")), folder / file)
    return folder / "design" / f"{name}.toml"


class Client:
    """A session that asks no workers."""

    def __init__(self, design: Path, root: Path) -> None:
        self.session = Session(design, root)
        for worker in self.session._workers.values():
            worker.close()

    def ask(self, ask: str, **body: Any) -> dict[str, Any]:
        return self.session.answer({"ask": ask, **body})


# --- numbers ---


@pytest.mark.parametrize("design", [BALL, *SLOW])
def test_picture_has_the_figures_of_verify_and_recovery(design: Path) -> None:
    spec = malta.read_design(design)
    problem = solve(open_design(design).apply(Edit()))
    found = picture(problem, View())
    margins = malta.verify(problem.model, problem.controller)
    figures = {m["label"]: m["value"] for m in found["figures"]}
    peaks = [v for k, v in margins.peak_sensitivity.items() if k != "sigma_max"]
    assert figures["peak |S|"] == max(peaks)
    assert figures["bandwidth, T"] == margins.bandwidth["sigma_max_T"]
    assert found["stable"]
    closed = np.array(found["poles"]["closed loop"])
    assert np.allclose(closed[:, 0] + 1j * closed[:, 1], margins.poles.closed_loop, rtol=1e-12)
    drawn = [max(row) for row in found["frequency"]["S"]]
    assert drawn == pytest.approx(peaks, rel=2e-3)
    if found["load"]:
        of_load = malta.loops.recovery(problem.plant, problem.controller)[0]
        assert found["load"]["largest"] == pytest.approx([d.largest for d in of_load.outputs], rel=1e-5)
        assert found["load"]["any"] == pytest.approx([d.any_waveform for d in of_load.outputs], rel=1e-5)
    assert np.array_equal(problem.controller.K, malta.synthesize(spec, problem.model).K)


def test_linear_run_is_what_the_simulation_does() -> None:
    from malta.app.picture import planned_run

    problem = solve(open_design(ROTOR).apply(Edit()))
    name, planned = planned_run(problem.plant, problem.controller, "step s_Ax")
    linear = picture(problem, View(run=name), margin=False)["run"]
    run = malta.simulate(problem.plant, problem.controller, planned.scenario)
    step = len(run.t) // len(linear["t"])
    # a step of 19 um, of which the linear loop leaves out the saturation and the curve of the magnets
    assert np.abs(np.array(linear["p"]).T - run.p[::step]).max() < 0.1e-6


def test_the_worst_load_of_the_page_is_the_one_that_is_flown() -> None:
    """Of the load that is chosen under Load: linear as the l1 norm of its contact says, and so the simulation."""
    from malta.app.picture import planned_run, run_names

    problem = solve(open_design(BALL).apply(Edit()))
    plant, controller = problem.plant, problem.controller
    assert "worst load" in run_names(plant, controller)
    name, planned = planned_run(plant, controller, "worst load", "w")
    assert name == "worst load w"
    linear = picture(problem, View("worst load", "w"), margin=False)["run"]
    run = malta.simulate(plant, controller, planned.scenario)
    worst = malta.worst_waveform(malta.loop(plant, controller), "w", "y", 1.0)
    most = np.abs(np.array(linear["p"][0])).max()
    assert most == pytest.approx(worst.value, rel=0.02)  # the page draws some of the samples
    assert np.abs(run.p[:, 0]).max() == pytest.approx(worst.value, rel=0.05)
    assert picture(problem, View("worst load", "F_q"), margin=False)["run"] is None


@pytest.mark.parametrize("design", [BALL, *SLOW])
def test_eigenvalue_margin_lies_just_above_the_proven_one(design: Path) -> None:
    spec = malta.read_design(design)
    _, controller = model_and_controller(spec)
    loops, over = travel_loops(spec.plant, controller, tuple(spec.uncertainty))
    bound = ray_bound(loops, spec.uncertainty, over)
    proven = travel_margin(spec.plant, controller, spec.uncertainty)
    assert proven.lower is not None
    assert proven.lower <= bound.upper <= 1.001 * proven.lower + 1e-3
    assert bound.ray is not None
    again = ray_bound(loops, spec.uncertainty, over, (bound.ray, bound.upper))
    assert again.upper == pytest.approx(bound.upper, rel=2e-3)


@pytest.mark.slow
def test_the_margin_map_and_the_poles_at_its_points_agree(tmp_path: Path) -> None:
    """Eigenvalues of the sampled loop on a grid, and the machine's own loop at a point: two routes to the boundary."""
    page = Client(copied(tmp_path), tmp_path)
    page.ask("evaluate", number=1, values={})
    names = list(page.ask("open")["parameters"])[:2]
    x, y = names
    assert page.ask("map", x=x, y=y) == {"version": 1}
    problem = solve(page.session.files.apply(page.session.edit))
    found = map_document(problem, (x, y), 3.0)
    assert found["half"][0] == pytest.approx(found["nominal"][0] * problem.spec.uncertainty[x])
    for row, worst in ((found["nominal"], -1.0), (np.array(found["boundary"][0])[:, 10], 0.0)):
        there = page.ask("map", x=x, y=y, at=[float(value) for value in row])
        assert there["at"] == pytest.approx(dict(zip(names, row, strict=True)))
        if worst < 0:
            assert there["stable"]
            assert there["poles"] == pytest.approx(
                np.array(picture(problem, View())["poles"]["closed loop"]), rel=1e-6
            )
        else:
            scale = abs(complex(*there["worst"]))
            assert abs(there["worst"][0]) < 0.02 * scale
    far = np.array(found["unstable"][0][0])  # a ring whose points are unstable, or on the boundary
    furthest = far[:, np.argmax(np.abs(far / np.array(found["nominal"])[:, None] - 1).sum(axis=0))]
    assert not page.ask("map", x=x, y=y, at=furthest.tolist())["stable"]


@pytest.mark.parametrize(
    ("body", "says"),
    [
        ({"x": "m", "y": "m"}, "two of m"),
        ({"x": [], "y": 1}, "two of m"),
        ({"x": "m", "y": "A", "at": [1]}, "two numbers"),
        ({"x": "m", "y": "A", "at": [1, float("nan")]}, "two numbers"),
        ({"x": "m", "y": "A", "at": [-1, 1]}, "m: found -1"),
    ],
)
def test_a_map_of_other_things_is_refused(tmp_path: Path, body: dict[str, Any], says: str) -> None:
    page = Client(copied(tmp_path), tmp_path)
    assert says in page.ask("map", **body)["error"]


def test_a_machine_that_differs_keeps_its_controller(tmp_path: Path) -> None:
    files = open_design(copied(tmp_path))
    own = solve(files.apply(Edit()))
    heavier = {"machine.m": 4.5}
    other = solve(files.apply(files.edit(heavier, redesign=False)))
    redesigned = solve(files.apply(files.edit(heavier)))
    assert np.array_equal(own.controller.K, other.controller.K)
    assert other.plant.parameters.m == redesigned.plant.parameters.m == 4.5  # type: ignore[attr-defined]
    assert other.controller.parameters.m == 3.75  # type: ignore[attr-defined]
    assert redesigned.controller.parameters.m == 4.5  # type: ignore[attr-defined]


def test_fields_keep_units_and_ranges_of_the_file() -> None:
    fields = open_design(HALBACH).fields
    kp = fields["pid.Kp.F_x"]
    assert (kp.value, kp.unit, kp.tuning, kp.low, kp.high) == (647.02, "N/m", "stiffness", 30.0, 3000.0)
    assert fields["sample_time"].unit == "ms"
    assert fields["machine.m"].note.startswith("printed")
    printed = open_design(shipped_path("design", "table2.toml")).fields
    assert printed["bases.state.x"].value == 1.0  # "SI" in the file
    assert printed["weights.integral.x1"].value == 80  # of data/published


# --- what is wrong is one sentence ---


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"machine.m": -1.0}, "finite number above 0"),
        ({"machine.m": float("nan")}, "a finite number"),
        ({"pid.Kp.F_x": "x"}, "a finite number"),
        ({"pid.Kp.F_x": 10**400}, "a finite number"),
        ({"sample_time": 0.0}, "more than 0 s"),
        ({"machine": "../other.toml"}, "a field of the page"),
        ({"name": "x"}, "a field of the page"),
        ({"commutation": "elsewhere"}, "'measured' or 'predicted'"),
        ([], "values by key"),
    ],
)
def test_bad_values_are_one_sentence(tmp_path: Path, values: Any, says: str) -> None:
    client = Client(copied(tmp_path), tmp_path)
    answer = client.ask("evaluate", number=1, values=values)
    assert says in answer["error"]
    assert len(answer["error"]) <= 300
    assert "poles" not in answer
    assert client.ask("evaluate", number=2, values={})["stable"]


def test_an_unstable_design_has_poles_and_no_sensitivity(tmp_path: Path) -> None:
    client = Client(copied(tmp_path), tmp_path)
    found = client.ask("evaluate", number=1, values={"pid.Kd.F_x": 300.0})
    assert not found["stable"]
    assert found["frequency"]["S"] == []
    assert found["load"] is None
    assert found["margin"]["upper"] == 0.0
    json.dumps(found, allow_nan=False)


def test_the_newest_move_wins(tmp_path: Path) -> None:
    client = Client(copied(tmp_path), tmp_path)
    assert client.ask("evaluate", number=5, values={})["stable"]
    assert client.ask("evaluate", number=4, values={"pid.Kp.F_x": 700.0}) == {"number": 4, "stale": True}
    assert client.session.unsaved_changes() == []


@pytest.mark.slow
@pytest.mark.parametrize("design", [HALBACH, ROBUST, BALL, ROTOR], ids=lambda path: path.stem)
def test_every_field_moves_the_design_or_says_why_not(design: Path, tmp_path: Path) -> None:
    client, number = Client(design, tmp_path), 0
    for key, field in client.session.files.fields.items():
        if isinstance(field.value, str):
            values: list[Any] = list(field.choices)
        elif isinstance(field.value, bool):
            values = [not field.value]
        else:
            values = [3] if field.kind == "integer" else [1.1 * field.value or 1e-6]
        for value in values:
            # A machine that changes under the same controller: fields of the small ones say what all others would.
            small = design in (BALL, ROTOR)
            for redesign in (True, False) if small and key.startswith("machine.") else (True,):
                number += 1
                found = client.ask("evaluate", number=number, values={key: value}, redesign=redesign)
                assert "poles" in found or "defect" not in found["error"], (key, value, redesign, found)
                json.dumps(found, allow_nan=False)


def test_a_run_of_an_unstable_loop_ends_where_it_leaves(tmp_path: Path) -> None:
    """It is drawn until an output is off by all that it was asked to move: the axis shows the departure."""
    client = Client(copied(tmp_path), tmp_path)
    found = client.ask("evaluate", number=1, values={"pid.Kp.F_x": -3000.0})
    assert not found["stable"]
    run = found["run"]
    off = np.abs(np.array(run["p"]) - np.array(run["reference"]))
    assert 0 < off.max() <= np.ptp(np.array(run["reference"]))
    assert len(run["t"]) > 2


def test_unknown_questions_are_refused(tmp_path: Path) -> None:
    client = Client(copied(tmp_path), tmp_path)
    bodies: list[Any] = [None, [], {}, {"ask": "close"}, {"ask": "evaluate"}, {"ask": "news", "after": "x"}]
    bodies += [{"ask": []}, {"ask": {}}, {"ask": "save", "file": "\ud800.toml"}, {"ask": "save", "file": [1]}]
    for body in bodies:
        assert "expected" in client.session.answer(body)["error"]


# --- saving ---


def test_a_saved_design_makes_the_gains_of_the_page(tmp_path: Path) -> None:
    design = copied(tmp_path)
    files, before = open_design(design), design.read_text()
    edit = files.edit({"pid.Kp.F_x": 1000 / 3, "sample_time": 55.0, "uncertainty.m": 0.15})
    page = solve(files.apply(edit)).controller
    target = tmp_path / "design" / "mine.toml"
    saved, written = save_design(files, edit, target, tmp_path, replace=False)
    assert written == ["design/mine.toml"]
    spec = malta.read_design(target)
    _, controller = model_and_controller(spec)
    for name in ("K", "Ki", "L", "Ad"):
        assert np.array_equal(getattr(page, name), getattr(controller, name))
    assert spec.sha256 == saved.spec.sha256
    text = target.read_text()
    changed = {(a, b) for a, b in zip(before.splitlines(), text.splitlines(), strict=True) if a != b}
    assert len(changed) == 3  # the name, the gain, the uncertainty; comments and order stay
    assert all("#" not in a or a.partition("#")[2] == b.partition("#")[2] for a, b in changed)
    with pytest.raises(TakenError, match=r"design/mine\.toml"):
        save_design(saved, Edit(), target, tmp_path, replace=False)


def test_a_machine_of_the_page_is_saved_beside_its_data(tmp_path: Path) -> None:
    files = open_design(copied(tmp_path))
    edit = files.edit({"machine.m": 4.0, "pid.Kp.F_x": 700.0})
    target = tmp_path / "design" / "heavy.toml"
    _, written = save_design(files, edit, target, tmp_path, replace=False)
    assert written == ["design/heavy.toml", "data/heavy_machine.toml"]
    _, controller = model_and_controller(malta.read_design(target))
    assert np.array_equal(controller.K, solve(files.apply(edit)).controller.K)
    assert controller.parameters.m == 4.0  # type: ignore[attr-defined]


def test_published_numbers_and_si_bases_are_written_out_where_they_change(tmp_path: Path) -> None:
    folder = tmp_path / "design"
    folder.mkdir()
    files = open_design(shipped_path("design", "table2.toml"))
    edit = files.edit({"bases.state.x": 2.0, "weights.integral.x1": 81.0})
    save_design(files, edit, folder / "other.toml", tmp_path, replace=False)
    text = (folder / "other.toml").read_text()
    assert 'input = "SI"' in text
    assert 'published = "table_II.state"' in text
    saved, page = malta.read_design(folder / "other.toml"), files.apply(edit).spec
    assert np.array_equal(saved.weights.Q, page.weights.Q)
    assert np.array_equal(saved.weights.Q_i, page.weights.Q_i)


@pytest.mark.parametrize(
    "file",
    ["../x.toml", "/tmp/x.toml", "a/../../x.toml", "x.txt", "x y.toml", "", "link/x.toml", "\ud800.toml"],
)
def test_nothing_is_saved_outside_of_the_folder(tmp_path: Path, file: str) -> None:
    root, other = tmp_path / "root", tmp_path / "other"
    design = copied(root)
    other.mkdir()
    (root / "link").symlink_to(other)
    client = Client(design, root)
    answer = client.ask("save", file=file, values={}, replace=True)
    assert "expected" in answer["error"]
    assert list(other.iterdir()) == []
    assert list(tmp_path.glob("*.toml")) == []


def test_a_link_in_place_of_a_design_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "real.toml").write_text("x")
    (tmp_path / "link.toml").symlink_to(tmp_path / "real.toml")
    with pytest.raises(InputError, match="no link"):
        inside(tmp_path, "link.toml")
    assert inside(tmp_path, "design/new.toml") == tmp_path / "design" / "new.toml"


def test_saving_asks_before_it_replaces(tmp_path: Path) -> None:
    client = Client(copied(tmp_path), tmp_path)
    values = {"pid.Kp.F_x": 650.0}
    asked = client.ask("save", file="design/halbach_pid.toml", values=values)
    assert asked == {"exists": ["design/halbach_pid.toml"]}
    saved = client.ask("save", file="design/halbach_pid.toml", values=values, replace=True)
    assert saved["written"] == ["design/halbach_pid.toml"]
    assert client.session.unsaved_changes() == []
    fields = {f["key"]: f["value"] for f in saved["open"]["fields"]}
    assert fields["pid.Kp.F_x"] == 650.0


def test_gain_files_follow_no_link(tmp_path: Path) -> None:
    root, other = tmp_path / "root", tmp_path / "other"
    client = Client(copied(root), root)
    other.mkdir()
    (root / "build").symlink_to(other)
    assert "no link" in client.ask("gains")["error"]
    (root / "build").unlink()
    (root / "design" / "gains").symlink_to(other)
    assert "no link" in client.ask("gains")["error"]
    assert list(other.iterdir()) == []


def test_gain_files_are_those_of_a_saved_design(tmp_path: Path) -> None:
    client = Client(copied(tmp_path), tmp_path)
    client.ask("evaluate", number=1, values={"pid.Kp.F_x": 700.0})
    assert "changes that are not saved" in client.ask("gains")["error"]


@pytest.mark.slow
def test_gain_files_go_through_the_checks_of_malta_design(tmp_path: Path) -> None:
    client = Client(copied(tmp_path), tmp_path)
    written = client.ask("gains")["written"]
    assert written == [f"design/gains/halbach_pid{suffix}" for suffix in (".json", ".npz", ".mat")]
    assert client.ask("gains") == {"exists": written}
    controller = malta.gains.read(tmp_path / written[0])
    assert np.array_equal(controller.K, solve(client.session.files.apply(Edit())).controller.K)
    unstable = {"pid.Kd.F_x": 300.0}
    client.ask("save", file="design/wild.toml", values=unstable)
    assert "unstable" in client.ask("gains")["error"]
    assert not (tmp_path / "design/gains/wild.json").exists()


def test_an_eigenvalue_margin_that_would_make_an_answer_late_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = Client(BALL, tmp_path)
    mass = client.session.files.fields["machine.m"].value
    assert isinstance(mass, float | int)
    for number, (room, given) in enumerate([(0.0, False), (float("inf"), True), (0.0, False)]):
        monkeypatch.setattr("malta.app.answers.LONGEST_ANSWER_TIME", room)
        found = client.ask("evaluate", number=number, values={"machine.m": mass * (1 + 1e-3 * number)})
        assert found["stable"]
        assert (found["margin"] is not None) == given


@pytest.mark.slow
def test_the_rest_of_an_answer_makes_it_the_whole_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = Client(BALL, tmp_path)
    values = {"machine.m": 1.1 * float(client.session.files.fields["machine.m"].value)}
    whole = picture(solve(client.session.files.apply(client.session.files.edit(values))), View())
    monkeypatch.setattr("malta.app.answers.LONGEST_ANSWER_TIME", 0.0)
    first = client.ask("evaluate", number=1, values=values)
    assert first["missing"] == ["frequency", "run", "load", "figures", "margin"]
    early = {one["label"]: one["value"] for one in first["figures"]}
    assert {"peak |S|", "bandwidth, T", "crossover, L", "slowest pole"} <= early.keys()
    monkeypatch.setattr(
        "malta.app.answers.LONGEST_ANSWER_TIME", 1e9
    )  # of the margin, which is left to the background otherwise
    rest = client.ask("rest", number=1)
    given = {**first, **rest}
    assert {key: given[key] for key in whole if key != "margin"} == {
        key: found for key, found in whole.items() if key != "margin"
    }
    assert given["margin"]["upper"] == pytest.approx(whole["margin"]["upper"], rel=1e-3)
    assert client.ask("rest", number=1) == {"number": 1}
    client.ask("evaluate", number=2, values={})
    assert client.ask("rest", number=1) == {"number": 1, "stale": True}


def test_figures_of_the_first_answer_are_those_of_verify(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("malta.app.answers.LONGEST_ANSWER_TIME", 0.0)
    client = Client(HALBACH, tmp_path)
    spec = client.session.files.apply(Edit()).spec
    model = malta.linearize(spec.plant, spec.plant.at(**spec.operating_point))
    report = malta.verify(model, malta.synthesize(spec, model))
    found = {one["label"]: one["value"] for one in client.ask("evaluate", number=1, values={})["figures"]}
    wanted = {one.key: one.value for one in report.figures}
    for label, key in (
        ("peak |S|", "peak_sensitivity"),
        ("bandwidth, T", "bandwidth_sigma_max_T"),
        ("crossover, L", "bandwidth_crossover_max"),
        ("slowest pole", "slowest_pole"),
        ("least damping", "smallest_damping"),
    ):
        assert found[label] == pytest.approx(wanted[key], rel=1e-12)


@pytest.mark.slow
def test_a_session_keeps_nothing_of_the_machines_that_it_leaves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "malta.app.answers.LONGEST_ANSWER_TIME", float("inf")
    )  # margins are traced here, whatever else the computer does
    client = Client(BALL, tmp_path)
    field = client.session.files.fields["machine.m"]

    def kept(number: int) -> dict[str, int]:
        move = {"machine.m": float(field.value) * (1 + 1e-3 * number)}
        assert "error" not in client.ask("evaluate", number=number, values=move)
        return {
            name: len(own) for name, own in vars(client.session).items() if isinstance(own, list | set | dict)
        }

    kept(1)
    assert kept(2) == kept(3) == kept(4)


# --- the server ---


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    session = Client(copied(tmp_path), tmp_path).session
    with Server(session) as running:
        thread = threading.Thread(target=running.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        yield running
        running.shutdown()
        thread.join()


def send(
    server: Server, method: str, path: str, body: bytes | None = None, **headers: str
) -> tuple[int, str, dict[str, str]]:
    """A request as this page sends it, but for some headers; "" leaves one out."""
    own = {
        "Host": f"127.0.0.1:{server.server_port}",
        "Origin": server.origin,
        "X-Malta-Token": server.token,
        "Content-Type": "application/json",
    } | {name.replace("_", "-"): value for name, value in headers.items()}
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)
    connection.putrequest(method, path, skip_host=True)
    for name, value in own.items():
        if value:
            connection.putheader(name, value)
    if body is not None and "Content-Length" not in own:
        connection.putheader("Content-Length", str(len(body)))
    connection.endheaders(body)
    answer = connection.getresponse()
    found = answer.status, answer.read().decode(), dict(answer.getheaders())
    connection.close()
    return found


def test_the_page_is_served_to_whoever_has_its_address(server: Server) -> None:
    status, text, headers = send(server, "GET", f"/?token={server.token}", Origin="")
    assert status == 200
    assert "app.js" not in text
    assert "page.js" in text
    assert "script-src 'self'" in headers["Content-Security-Policy"]
    assert "unsafe" not in headers["Content-Security-Policy"]
    for path, (_, kind) in PAGES.items():
        status, text, headers = send(server, "GET", f"{path}?token={server.token}")
        assert status == 200
        assert headers["Content-Type"].startswith(kind)
        assert "http" not in text.replace(
            "http://www.w3.org/2000/svg", ""
        )  # nothing is loaded from elsewhere
    status, text, _ = send(server, "POST", "/ask", json.dumps({"ask": "open"}).encode())
    assert status == 200
    assert json.loads(text)["name"] == "halbach_pid"


@pytest.mark.parametrize(
    ("method", "path", "headers", "status"),
    [
        ("GET", "/", {}, 403),
        ("GET", "/?token=wrong", {}, 403),
        ("GET", "/?token=%C3%A9", {}, 403),
        ("GET", "/../files.py", {}, 404),
        ("GET", "/static/app.js", {}, 404),
        ("GET", "/%2e%2e/session.py", {}, 404),
        ("GET", "/app.js", {"Host": "evil.example"}, 421),
        ("GET", "/app.js", {"Host": ""}, 421),
        ("GET", "/app.js", {"Origin": "http://evil.example"}, 403),
        ("GET", "/app.js", {"Sec_Fetch_Site": "cross-site"}, 403),
        ("POST", "/ask", {"X_Malta_Token": ""}, 403),
        ("POST", "/ask", {"X_Malta_Token": "wrong"}, 403),
        ("POST", "/ask", {"Host": "evil.example"}, 421),
        ("POST", "/ask", {"Origin": "null"}, 403),
        ("POST", "/ask", {"Origin": "http://127.0.0.1:1"}, 403),
        ("POST", "/ask", {"Content_Type": "text/plain"}, 415),
        ("POST", "/ask", {"Content_Length": str(MAX_DOCUMENT_BYTES + 1)}, 413),
        ("POST", "/ask", {"Content_Length": "-1"}, 411),
        ("POST", "/ask", {"Content_Length": "9" * 5000}, 413),  # more digits than Python reads
        ("GET", "//[x", {}, 404),
        ("POST", "/save", {}, 404),
        ("PUT", "/ask", {}, 405),
        ("DELETE", "/ask", {}, 405),
        ("OPTIONS", "/ask", {}, 405),
    ],
)
def test_the_server_refuses(
    server: Server, method: str, path: str, headers: dict[str, str], status: int
) -> None:
    found, text, answered = send(server, method, path, b"{}" if method == "POST" else None, **headers)
    assert found == status, text
    assert server.token not in text
    assert "Access-Control-Allow-Origin" not in answered


def test_a_body_that_is_no_json_is_refused(server: Server) -> None:
    assert send(server, "POST", "/ask", b"{" * 10)[0] == 400
    assert send(server, "POST", "/ask", b"[" * 100_000)[0] == 400
    assert send(server, "POST", "/ask", b'"ask"')[0] == 200


def test_many_connections_at_once_wait_their_turn(server: Server) -> None:
    address = ("127.0.0.1", server.server_port)
    waiting = [socket.create_connection(address, timeout=10) for _ in range(40)]
    try:
        for connection in waiting:
            connection.sendall(f"GET /app.css HTTP/1.1\r\nHost: {address[0]}:{address[1]}\r\n\r\n".encode())
        assert [connection.recv(15) for connection in waiting] == [b"HTTP/1.1 200 OK"] * 40
    finally:
        for connection in waiting:
            connection.close()
    assert server.request_queue_size > 40


def test_a_port_that_is_taken_is_one_sentence(server: Server) -> None:
    with pytest.raises(InputError, match="--port"):
        Server(server.session, server.server_port)


# --- processes, and the page in a browser ---


def test_the_version_of_one_page_is_no_proof_of_the_design_of_another(tmp_path: Path) -> None:
    client = Client(copied(tmp_path), tmp_path)
    mine, other = {"pid.Kp.F_x": 700.0}, {"pid.Kp.F_x": 900.0}
    versions = [
        client.ask("evaluate", number=k, values=values)["version"] for k, values in enumerate((mine, other))
    ]
    assert client.ask("save", file="design/mine.toml", values=mine)["written"] == ["design/mine.toml"]
    versions += [client.ask("evaluate", number=3, values=mine)["version"]]
    assert client.ask("save", file="design/mine.toml", values=mine, replace=True)["written"]
    assert client.ask("evaluate", number=4, values=mine)["version"] == versions[-1]  # saved: the same design
    versions += [client.ask("evaluate", number=5, values={"pid.Kp.F_x": 1e301})["version"]]
    versions += [client.ask("evaluate", number=6, values=mine)["version"]]
    assert versions == sorted(set(versions))


@pytest.mark.parametrize(("task", "kind"), [("prove", "proof"), ("check", "failed")])
def test_nothing_follows_of_files_that_changed_since_the_page_read_them(
    tmp_path: Path, task: str, kind: str
) -> None:
    design = copied(tmp_path)
    edited = open_design(design).apply(Edit())
    design.write_text(design.read_text(encoding="utf-8").replace("647.02", "647.03"), encoding="utf-8")
    message = {"task": task, "values": {}, "redesign": True, "design": fingerprint(*edited)}
    (reply,) = work(message, open_design(design), lambda: False)
    assert reply["kind"] == kind
    assert reply.get("lower") is None
    assert "changed since the page read them" in reply.get("reason", reply.get("error", ""))


def test_entries_that_move_together_keep_units_of_their_own(tmp_path: Path) -> None:
    design = copied(tmp_path, "robust")
    text = design.read_text(encoding="utf-8")
    design.write_text(
        re.sub(r'(?m)^y  .*11.552, unit = "um"', 'y = { value = 0.011552, unit = "mm"', text),
        encoding="utf-8",
    )
    fields = open_design(design).fields
    x, y = fields["bases.state.x"], fields["bases.state.y"]
    assert y.unit == "mm"
    assert x.linked == y.linked == (x.key, y.key)
    assert y.factor / x.factor == pytest.approx(1e-3, rel=1e-12)  # 12 um in x are 0.012 mm in y


def dying_worker(
    monkeypatch: pytest.MonkeyPatch, deaths: int, task: str = "prove", version: int | None = 1
) -> list[dict[str, Any]]:
    """What is heard of a process that exits with code 3 at the first documents, and answers the next one."""
    answer = "print(json.dumps({'kind': kind, 'serial': 7, 'version': 1}), flush=True)"
    code = f"import json, sys; sys.stdin.readline(); kind = 'begin'; {answer}; "
    started: list[int] = []

    def start() -> subprocess.Popen[str]:
        end = "sys.exit(3)" if len(started) < deaths else f"kind = 'done'; {answer}; sys.stdin.read()"
        started.append(1)
        command = [sys.executable, "-S", "-c", code + end]
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    monkeypatch.setattr(followers, "_start", start)
    heard: list[dict[str, Any]] = []
    full = threading.Event()

    def hear(document: dict[str, Any]) -> None:
        heard.append(document)
        if document["kind"] != "notice":
            full.set()

    worker = followers.Worker(hear)
    worker.ask({"version": version, "serial": 7, "task": task})
    assert full.wait(60)
    worker.close()
    assert len(started) == 2
    return heard


def test_a_worker_that_dies_is_started_again_and_asked_once_more(monkeypatch: pytest.MonkeyPatch) -> None:
    notice, done = dying_worker(monkeypatch, 1)
    assert notice["text"] == (
        "the process that proves the margin ended by itself (exit code 3): it was started again and asked once more"
    )
    assert done["kind"] == "done"


def test_a_worker_that_dies_twice_answers_that_nothing_is_proven(monkeypatch: pytest.MonkeyPatch) -> None:
    notice, proof = dying_worker(monkeypatch, 2)
    assert (notice["kind"], proof["kind"], proof["lower"]) == ("notice", "proof", None)
    assert "(exit code 3), and so did the one" in proof["reason"]


@pytest.mark.slow
def test_what_a_machine_prints_is_no_answer_and_the_current_folder_holds_no_modules(tmp_path: Path) -> None:
    (tmp_path / "json.py").write_text("raise SystemExit('of the current folder')", encoding="utf-8")
    code = "from malta.app.worker import take_channel; import os; c = take_channel(); "
    code += "print('P', flush=True); os.system('echo C'); print('A', file=c)"
    run = (sys.executable, "-P", "-c", code)
    done = subprocess.run(run, cwd=tmp_path, env=environment(), capture_output=True, text=True, check=True)
    assert done.stdout == "A\n"
    assert sorted(done.stderr.split()) == ["C", "P"]
    command = python_module("malta.app.worker")
    ended = subprocess.run(
        command, cwd=tmp_path, env=environment(), input="", capture_output=True, text=True, check=False
    )
    assert (ended.returncode, ended.stderr) == (0, "")


@pytest.mark.slow
def test_workers_follow_the_newest_design_and_prove_it(tmp_path: Path) -> None:
    session = Session(copied(tmp_path), tmp_path)
    try:
        for number, gain in enumerate((700.0, 710.0, 720.0)):
            version = session.answer({"ask": "evaluate", "number": number, "values": {"pid.Kp.F_x": gain}})[
                "version"
            ]
        found: dict[str, dict[str, Any]] = {}
        after, until = 0, time.monotonic() + 600
        while time.monotonic() < until and not {"proof", "safe", "run", "requirement"} <= set(found):
            answer = session.answer({"ask": "news", "after": after})
            after = answer["after"]
            for item in answer["news"]:
                assert item["version"] == version
                found[item["kind"]] = item
    finally:
        session.close()
    assert found["run"]["completed"]
    assert found["requirement"]["holds"] in (True, False)
    _, controller = model_and_controller(session.files.apply(session.edit).spec)
    spec = session.files.spec
    assert found["proof"]["lower"] == travel_margin(spec.plant, controller, spec.uncertainty).lower
    safe = malta.safe_load(malta.loop(spec.plant, controller), "F_x")
    assert found["safe"]["loads"] == {"F_x": f"{safe.proven.text(3)} N"}
    assert found["safe"]["ends"] == {"F_x": safe.ends}
    judged = [one.holds for one in judge(spec, controller) if one.name == "margin"]
    assert found["proof"]["holds"] == (judged[0] if judged else None)


@pytest.mark.slow
def test_the_command_prints_an_address_and_says_what_is_unsaved(tmp_path: Path) -> None:
    design = copied(tmp_path)
    command = [sys.executable, "-m", "malta", "app", str(design), "--no-browser"]
    with subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        url = process.stdout.readline()
        assert url.startswith("http://127.0.0.1:")
        assert "token=" in url
        host, token = url.split("/")[2], url.strip().rpartition("=")[2]
        connection = http.client.HTTPConnection(host, timeout=30)
        body = json.dumps({"ask": "evaluate", "number": 1, "values": {"pid.Kp.F_x": 700.0}})
        headers = {"X-Malta-Token": token, "Content-Type": "application/json"}
        connection.request("POST", "/ask", body, headers)
        assert json.loads(connection.getresponse().read())["stable"]
        connection.close()
        process.send_signal(2)
        said = process.stderr.read()
    assert said == "malta: ended; not saved to halbach_pid.toml: pid.Kp.F_x\n"
    assert process.returncode == 0


def test_news_of_an_older_version_are_dropped(tmp_path: Path) -> None:
    session = Session(copied(tmp_path), tmp_path)
    try:
        newest = session.answer({"ask": "evaluate", "number": 1, "values": {}})["version"]
        for version in (newest - 1, newest + 1, newest):
            session._tell({"version": version, "kind": "proof", "lower": 1.0})
        assert [item["version"] for item in session.answer({"ask": "news", "after": 0})["news"]] == [newest]
    finally:
        session.close()
