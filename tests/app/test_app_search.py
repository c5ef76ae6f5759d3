"""Designs from the one on the page: pulled curves, candidates of a search, the front, and other design files."""

from __future__ import annotations

import json
import math
import shutil
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
from test_app import BALL, Client, copied, dying_worker

from malta.app import worker
from malta.app.files import Edit, fingerprint, open_design
from malta.app.picture import View, crossovers, solve
from malta.app.pull import choose_numbers
from malta.app.worker import SupersededError, work
from malta.errors import InputError
from malta.files import shipped_path
from malta.margins.travel import travel_loops
from malta.proof.loss import ray_bound

pytestmark = pytest.mark.usefixtures("proven_once")


@pytest.fixture
def ball(tmp_path: Path) -> Client:
    return Client(BALL, tmp_path)


def pull(client: Client, kind: str, signal: str, asked: float, **body: Any) -> dict[str, Any]:
    return client.ask("pull", kind=kind, signal=signal, asked=asked, **body)


def seen(client: Client, values: dict[str, Any]) -> dict[str, Any]:
    """The picture of a design, as the page asks for it: also for what a loaded computer leaves out at first."""
    client.number = number = getattr(client, "number", 0) + 1  # type: ignore[attr-defined]
    found = client.ask("evaluate", number=number, values=values)
    return found | client.ask("rest", number=number) if found["missing"] else found


# --- curves that are pulled ---


def test_a_crossover_of_the_page_is_that_of_the_margins() -> None:
    """Two routes: between two points of the page's grid, and the crossings that margins are read at."""
    problem = solve(open_design(BALL).apply(Edit()))
    ((w, phase),) = crossovers(problem.curves)  # type: ignore[misc]
    (channel,) = problem.curves.margins
    assert phase == pytest.approx(channel.phase, rel=2e-3)
    assert w == pytest.approx(max(crossing.frequency for crossing in channel.gain_crossings), rel=2e-3)


@pytest.mark.slow
def test_a_pulled_crossover_is_where_it_was_asked_for(ball: Client) -> None:
    (w, _), *_ = seen(ball, {})["frequency"]["crossover"]
    for share in (1.15, 0.85):
        found = pull(ball, "crossover", "y", share * w)
        assert found["reached"]
        (there, _), *_ = seen(ball, found["values"])["frequency"]["crossover"]
        assert there == pytest.approx(share * w, rel=0.02)
        assert there == pytest.approx(found["found"], rel=1e-9)
        assert len(found["numbers"]) == 1
        assert set(found["values"]) == {"noise.process.f"}


@pytest.mark.slow
def test_a_pulled_phase_margin_keeps_the_crossover(ball: Client) -> None:
    (w, phase), *_ = seen(ball, {})["frequency"]["crossover"]
    found = pull(ball, "phase", "y", 1.1 * phase)
    assert found["reached"]
    assert len(found["numbers"]) == 2
    (there, wider), *_ = seen(ball, found["values"])["frequency"]["crossover"]
    assert wider == pytest.approx(1.1 * phase, rel=0.02)
    assert there == pytest.approx(w, rel=0.02)


@pytest.mark.slow
def test_a_pulled_load_and_peak_are_those_of_the_picture(ball: Client) -> None:
    first = seen(ball, {})
    largest, peak = first["load"]["largest"][0], max(first["frequency"]["S"][0])
    found = pull(ball, "load", "y", 0.8 * largest)
    assert found["reached"]
    assert seen(ball, found["values"])["load"]["largest"][0] == pytest.approx(0.8 * largest, rel=0.02)
    found = pull(ball, "peak", "y", 0.96 * peak)
    assert found["reached"]
    assert max(seen(ball, found["values"])["frequency"]["S"][0]) == pytest.approx(0.96 * peak, rel=0.02)


@pytest.mark.slow
def test_a_figure_that_cannot_be_had_says_so_with_the_nearest(ball: Client) -> None:
    (w, _), *_ = seen(ball, {})["frequency"]["crossover"]
    found = pull(ball, "crossover", "y", 5 * w)
    assert not found["reached"]
    assert found["at_end"] == found["numbers"] == ["force"]
    assert found["values"] == {"noise.process.f": 1.0}  # the slider's end
    assert w < found["found"] < 5 * w


@pytest.mark.parametrize(
    ("body", "says"),
    [
        ({"kind": "weight", "signal": "y", "asked": 1.0}, "one of a curve of the page"),
        ({"kind": "peak", "signal": "w", "asked": 1.0}, "one of a curve of the page"),
        ({"kind": "peak", "signal": "y", "asked": -1.0}, "a number above 0"),
        ({"kind": "peak", "signal": "y", "asked": math.inf}, "a number above 0"),
        ({"kind": "run", "signal": "y", "asked": 1e-5, "run": "flight"}, "one that can be pulled"),
    ],
)
def test_other_handles_are_refused(ball: Client, body: dict[str, Any], says: str) -> None:
    assert says in ball.ask("pull", **body)["error"]


def test_an_unstable_loop_is_not_pulled(tmp_path: Path) -> None:
    client = Client(copied(tmp_path), tmp_path)
    found = pull(client, "peak", "x", 1.5, values={"pid.Kd.F_x": 300.0})
    assert "a stable one" in found["error"]


def test_numbers_that_move_nothing_are_not_chosen() -> None:
    assert choose_numbers({"a": (1e-3,), "b": (-1e-2,)}) == ()
    assert choose_numbers({}) == ()
    assert choose_numbers({"a": (1.0, 2.0), "b": (2.0, 4.0)}) == ()  # two numbers that do the same


# --- sliders of a design that names none ---


def test_a_design_without_a_search_has_sliders_of_equal_numbers() -> None:
    planar = open_design(shipped_path("design", "planar.toml")).fields
    x = planar["bases.state.x"]
    assert x.linked == ("bases.state.x", "bases.state.y", "bases.state.z")
    assert x.tuning == "bases of the states: x y z"
    assert planar["bases.state.x_dot"].tuning == ""  # of no weight
    printed = open_design(shipped_path("design", "table2.toml")).fields
    assert printed["bases.state.x"].tuning == ""  # "SI": the weights are what moves
    assert printed["weights.state.x"].tuning.startswith("weights of the states")


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted(shipped_path("design").glob("*.toml")), ids=lambda path: path.stem)
def test_every_shipped_design_has_sliders(path: Path) -> None:
    files = open_design(path)
    named = {f.tuning for f in files.fields.values()} - {""}
    assert named
    assert not files.spec.search or named == {variable.name for variable in files.spec.search}


# --- searches ---


def searching(path: Path, **values: Any) -> worker.TuningRequest:
    files = open_design(path)
    return worker.TuningRequest(files, files.apply(files.edit(values)), View(), lambda _share: None)


@pytest.mark.slow
def test_candidates_come_nearer_to_what_is_asked_one_after_the_other() -> None:
    weak = {"bases.state.q": 400.0, "noise.process.f": 0.03}
    found = list(islice(worker.candidates(searching(BALL, **weak)), 2))
    ratios = [one["ratio"] for one in found]
    assert ratios == sorted(ratios, reverse=True)
    files = open_design(BALL)
    for one in found:
        assert set(one["values"]) == {"bases.state.q", "bases.integral.y", "noise.process.f", "delay"}
        problem = solve(files.apply(files.edit({**weak, **one["values"]})))
        peak = next(f["value"] for f in one["picture"]["figures"] if f["label"] == "peak |S|")
        assert peak == pytest.approx(max(m.peak_sensitivity for m in problem.curves.margins), rel=1e-3)
        json.dumps(one, allow_nan=False)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["halbach_pid", "ball"])
def test_the_margins_of_a_front_are_proven_and_below_those_of_eigenvalues(name: str) -> None:
    path = BALL if name == "ball" else shipped_path("design", f"{name}.toml")
    files, points = open_design(path), list(worker.front(searching(path)))
    assert len(points) >= 2
    own = {key: value for key, value in points[0]["values"].items() if files.fields[key].value != value}
    assert own == {}  # the first is the design of the page
    for one in points:
        problem = solve(files.apply(files.edit(one["values"])))
        loops, over = travel_loops(problem.plant, problem.controller, tuple(problem.spec.uncertainty))
        upper = ray_bound(loops, problem.spec.uncertainty, over).upper
        assert 0 < one["margin"] <= upper <= 1.01 * one["margin"]
        assert any(f["label"].startswith(one["price"]) for f in one["picture"]["figures"])


@pytest.mark.parametrize(
    ("path", "task", "says"),
    [
        (shipped_path("design", "planar.toml"), worker.candidates, "a table of what the design shall reach"),
        (shipped_path("design", "planar.toml"), worker.front, "specification.margin: found nothing"),
    ],
)
def test_a_search_without_a_goal_is_one_sentence(path: Path, task: Any, says: str) -> None:
    with pytest.raises(InputError, match=says):
        next(task(searching(path)))


def test_a_machine_that_differs_is_not_tuned_for() -> None:
    files = open_design(BALL)
    edited = files.apply(files.edit({"machine.m": 120.0}, redesign=False))
    search = worker.TuningRequest(files, edited, View(), lambda _share: None)
    with pytest.raises(InputError, match="a design for the machine's numbers"):
        next(worker.candidates(search))


def message(task: str, path: Path) -> dict[str, Any]:
    design = fingerprint(*open_design(path).apply(Edit()))
    return {"task": task, "values": {}, "redesign": True, "design": design, "run": "", "load": ""}


def test_a_search_ends_at_the_next_trial_where_something_newer_waits() -> None:
    with pytest.raises(SupersededError):
        list(work(message("tune", BALL), open_design(BALL), lambda: True))
    assert list(work(message("stop", BALL), open_design(BALL), lambda: False)) == []


def test_a_search_that_is_refused_ends_with_its_sentence() -> None:
    planar = shipped_path("design", "planar.toml")
    (found,) = work(message("tune", planar), open_design(planar), lambda: False)
    assert (found["kind"], found["of"]) == ("searched", "tune")
    assert found["error"].startswith("planar.toml: specification: found nothing")


def test_a_search_whose_process_dies_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    notice, ended = dying_worker(monkeypatch, 2, task="tune", version=None)
    assert (notice["kind"], notice["version"]) == ("notice", None)
    assert notice["text"].startswith("the process that tunes ended by itself (exit code 3)")
    assert (ended["kind"], ended["of"]) == ("searched", "tune")
    assert "and so did the one" in ended["error"]


def test_news_of_a_search_outlive_moves_and_not_the_next_search(ball: Client) -> None:
    """What was found stays while sliders move; what an older search still says is dropped."""
    seen(ball, {})
    serial = ball.ask("search", task="tune")["search"]
    candidate = {"version": None, "serial": serial, "kind": "candidate", "number": 1}
    ball.session._tell(candidate)
    seen(ball, {"bases.state.q": 90.0})
    found = ball.ask("news", after=0)
    assert found["news"] == [candidate]
    ball.session._tell({"version": 2, "kind": "run"})
    assert [item["kind"] for item in ball.ask("news", after=found["after"])["news"]] == ["run"]  # each once
    assert ball.ask("search", task="stop")["search"] > serial
    ball.session._tell(candidate)
    assert [item["kind"] for item in ball.ask("news", after=0)["news"]] == ["run"]
    assert "tune, front or stop" in ball.ask("search", task="everything")["error"]


# --- another design ---


def test_another_design_is_opened_and_unsaved_changes_are_asked_about(tmp_path: Path) -> None:
    for name in ("ball.py", "ball.toml", "design/ball.toml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(shipped_path("examples", "ball", *name.split("/")), tmp_path / name)
    own, design = tmp_path / "design" / "ball.toml", tmp_path / "design"
    text = own.read_text(encoding="utf-8")
    (design / "other.toml").write_text(text.replace("value = 100,", "value = 120,"), encoding="utf-8")
    (design / "wrong.toml").write_text(text.replace("value = 200,", "value = -200,"), encoding="utf-8")
    (tmp_path / "notes.toml").write_text("machine = 1\n", encoding="utf-8")
    (design / "broken.toml").write_text("machine = \n", encoding="utf-8")
    client = Client(own, tmp_path)
    listed = {one["name"]: one["id"] for one in client.ask("designs")["designs"]}
    assert list(listed) == ["ball", "other", "wrong"]
    version = seen(client, {"bases.state.q": 90.0})["version"]
    assert client.ask("switch", id=listed["other"]) == {"unsaved": ["bases.state.q"]}
    for refused, says in (("wrong", "sample_time"), ("ball", "")):  # the page stays with its design
        assert says in client.ask("switch", id=listed[refused], discard=refused == "wrong").get("error", "")
        assert client.session.unsaved_changes() == ["bases.state.q"]
    opened = client.ask("switch", id=listed["other"], discard=True)["open"]
    assert opened["file"] == "design/other.toml"
    assert {f["key"]: f["value"] for f in opened["fields"]}["bases.state.q"] == 120
    assert client.session.unsaved_changes() == []
    assert seen(client, {})["version"] > version  # nothing proven of the last one counts
    for bad in ("/etc/hosts.toml", None, str(tmp_path / "notes.toml")):
        assert "one of the designs that are listed" in client.ask("switch", id=bad)["error"]
