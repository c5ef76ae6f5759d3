"""Certificates beside gain files: what claims less than box and travel, or something else, is refused."""

from __future__ import annotations

import copy
import json
import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from conftest import Run
from flint import fmpq
from tampering import claiming, written

import malta
from malta.checker import file as checked_file
from malta.checker.check import CertificateVerdict
from malta.errors import InputError
from malta.gains.certified import check, origin_of
from malta.loops.windings import CurrentLoops
from malta.margins import travel
from malta.margins.travel import travel_loops
from malta.proof import certificate
from malta.report.tables.certificate import claim_share

pytestmark = pytest.mark.usefixtures("proven_once")

ROOT = Path(__file__).parents[2]
HALBACH = ROOT / "design" / "gains" / "halbach.json"
BOX = {"m": 0.1, "A": 0.1, "b": 0.2, "R": 0.2}  # of its gain file
LOST = 4.29  # a loop of the Halbach stage is unstable there
Content = dict[str, Any]
Change = Callable[[Content], Any]


def certified(
    gains: Path, ranges: Mapping[str, Any], lower: float, path: Path, stage: CurrentLoops = "lag"
) -> Path:
    """The certificate of 0.999 of a margin that is known to be proven."""
    controller = malta.gains.read(gains)
    plant = malta.plant_of(controller.parameters)
    places, over = travel_loops(plant, controller, tuple(ranges), stage)
    margin = malta.proof.Margin(lower, math.inf, None, None, {}, {}, (), 0.0)
    origin = origin_of(gains, plant, controller, stage, len(places))
    return certificate.write_certificate(path, places, ranges, over, margin, origin)


@pytest.fixture(scope="module")
def document(tmp_path_factory: pytest.TempPathFactory) -> Content:
    """The Halbach stage's certificate: 400 % of its uncertainty, along its travel."""
    path = certified(HALBACH, BOX, 4.0, tmp_path_factory.mktemp("certified") / "c.json")
    content = json.loads(path.read_text())
    assert isinstance(content, dict)
    return content


def row(content: Content, name: str) -> dict[str, Any]:
    """A parameter of the claim."""
    found = next(p for p in content["claim"]["parameters"] if p["name"] == name)
    assert isinstance(found, dict)
    return found


def renewed(content: Content) -> None:
    """The intervals that follow from the box."""
    claiming(content, content["claim"]["lower"])


# what is refused


def a_box_a_quarter_as_wide(content: Content) -> None:
    for p in content["claim"]["parameters"]:
        p["down"], p["up"], p["over"] = p["down"] / 4, p["up"] / 4, [0.0, 0.0]
    claiming(content, 3.9 * content["claim"]["lower"])


def of(name: str, key: str, change: Callable[[Any], Any]) -> Change:
    """One field of one parameter, and the interval that follows."""

    def changed(content: Content) -> None:
        row(content, name)[key] = change(row(content, name)[key])
        renewed(content)

    return changed


def claim(*path: Any, value: Any) -> Change:
    def changed(content: Content) -> None:
        table = content["claim"]
        for key in path[:-1]:
            table = table[key]
        table[path[-1]] = value

    return changed


def every(key: str, value: Any) -> Change:
    """A field of each loop."""

    def changed(content: Content) -> None:
        for loop in content["loops"]:
            loop[key] = value

    return changed


def another_time(content: Content) -> None:
    content["claim"]["sample_time"] = 0.05
    every("sample_time", (0.05).hex())(content)


def no_time(content: Content) -> None:
    content["claim"]["sample_time"] = None
    every("sample_time", None)(content)


def two_loops(content: Content) -> None:
    content["loops"] *= 2
    content["claim"]["places"] = {"name": "x", "unit": "m", "at": [0.0, 0.05]}


def last_digit(content: Content) -> None:
    gains = content["loops"][0]["compensator"]["B"][0]
    gains[0] = math.nextafter(float.fromhex(gains[0]), math.inf).hex()


def another_constant(content: Content) -> None:
    """Of the machine, as one that is not uncertain."""
    step = next(s for s in content["loops"][0]["steps"] if s[0] == "const" and float.fromhex(s[3]) != 0)
    step[3] = math.nextafter(float.fromhex(step[3]), math.inf).hex()


def two_names(content: Content) -> None:
    one, two = row(content, "m"), row(content, "b")
    one["name"], two["name"] = two["name"], one["name"]


def no_machine(content: Content) -> None:
    content["claim"] |= dict.fromkeys(("machine", "law", "current_loops"))
    for p in content["claim"]["parameters"]:
        p["unit"] = None


TAMPERED: dict[str, tuple[Change, str]] = {
    "a quarter": (a_box_a_quarter_as_wide, r"box is too small: m from 2\.2.* to 5\.2.* kg at 1558\.44 % .* from -2"),
    "down": (of("m", "down", lambda x: math.nextafter(x * (1 - 1e-15), 0)), "its box is too small: m from"),
    "up": (of("b", "up", lambda x: x / 2), "its box is too small: b from"),
    "no width": (of("R", "down", lambda _: 0.0), "its box is too small: R from"),
    "travel": (of("x", "over", lambda _: [0.0, 0.0]), "its travel is too small: x from 0 to 0 m"),
    "half a travel": (of("x", "over", lambda _: [-0.05, 0.049]), r"travel is too small: x from -0\.05 to 0\.049 m"),
    "nominal": (of("A", "nominal", lambda x: math.nextafter(x, 2)), r"nominal A is 1\.606700\d+ N/A, .* is 1\.6067$"),
    "interval": (claim("parameters", 0, "interval", value=[2.0, 6.0]), "m: the interval is not the one"),
    "lower": (claim("lower", value=4.2), "m: the interval is not the one that is claimed"),
    "more": (lambda c: claiming(c, 4.2), "the parts of the box leave a gap"),
    "unit": (claim("parameters", 0, "unit", value="g"), "the unit of m is g, that of .* is kg$"),
    "a name": (claim("parameters", 3, "name", value="R2"), "R2 is no parameter of the loop of"),
    "another name": (claim("parameters", 3, "name", value="L"), "the unit of L is ohm, that of .* is H$"),
    "names": (two_names, "the unit of b is kg, that of"),
    "machine": (claim("machine", "name", value="tubular"), "the machine is tubular, that of .* is halbach"),
    "preset": (claim("machine", "preset", value="new"), "the preset of the machine is new, that of"),
    "law": (claim("law", "name", value="halbach_pid"), "the law is halbach_pid, that of .* is halbach$"),
    "sha256": (claim("law", "sha256", value="0" * 64), "the sha256 of the law is 0{64}, that of"),
    "stage": (claim("current_loops", value="pi"), "stage of current loops|no such loop can be made of"),
    "time": (claim("sample_time", value=0.05), "the sample time is not that of the loops"),
    "all times": (another_time, r"the sample time is 0\.05 s, that of .* is 0\.055 s"),
    "no time": (no_time, r"the sample time is none, that of .* is 0\.055 s"),
    "places": (claim("places", value={"name": "x", "unit": "m", "at": [0.0]}), "the place of each loop is x = 0.0 m"),
    "gains": (last_digit, "the loops are not those of"),
    "constant": (another_constant, "the loops are not those of"),
    "delay": (every("delay", 1), "the loops are not those of"),
    "two loops": (two_loops, "x is no parameter of the loop of"),
    "no machine": (no_machine, "is of matrices alone and names no machine"),
    "order": (lambda c: c["claim"]["parameters"].reverse(), "its parameters are not R b A m x x_1 x_2, as in"),
}  # fmt: skip


@pytest.mark.parametrize(("change", "why"), TAMPERED.values(), ids=TAMPERED)
def test_what_claims_less_or_something_else_is_refused(
    document: Content, tmp_path: Path, change: Change, why: str
) -> None:
    content = copy.deepcopy(document)
    change(content)
    found = check(written(content, tmp_path), HALBACH)
    assert (found.ok, found.compared) == (False, "gap" in why)
    (line,) = found.failures
    assert re.search(why, line)
    assert "changed after it was written" in check(written(content, tmp_path, signed=False)).failures[0]


@pytest.mark.slow
def test_the_box_alone_is_believed_without_a_gain_file(document: Content, tmp_path: Path) -> None:
    content = copy.deepcopy(document)
    a_box_a_quarter_as_wide(content)
    found = check(written(content, tmp_path))
    assert (found.ok, found.compared) == (True, False)
    assert found.claim == 3.9 * document["claim"]["lower"]
    low, high = (checked_file.double(x) for x in found.stated.parameters[0].interval)
    assert 3.75 - 1.5 < low < 3.75 < high < 3.75 + 1.5


NUMBERS = (0.0, 0.25, 0.5, 3.9, -1.0, 1e3, math.nextafter(1, 2), math.nextafter(1, 0))  # factors


def leaves(value: Any, *path: Any) -> list[tuple[Any, ...]]:
    """The ways to all that is not a table or a list."""
    if not isinstance(value, dict | list):
        return [path]
    items = value.items() if isinstance(value, dict) else enumerate(value)
    return [way for key, inner in items for way in leaves(inner, *path, key)]


def other(value: Any, rng: np.random.Generator) -> Any:
    """Another value of a field, mostly of its kind."""
    if rng.random() < 0.1:
        return [None, "m", 0, [], True][rng.integers(5)]
    if isinstance(value, bool) or value is None:
        return not value
    if isinstance(value, str) and not value.startswith(("0x", "-0x")):
        return [value[::-1], value[:-1], "m", "x", "pi"][rng.integers(5)]
    number = float.fromhex(value) if isinstance(value, str) else value
    factor = NUMBERS[rng.integers(len(NUMBERS))]
    if isinstance(value, int):
        return value + int(rng.integers(-2, 3))
    return number * factor if number else factor - 1


def require_implied(found: CertificateVerdict, document: Content) -> None:
    """What holds implies the claim in the gain file's box: of the same loop, no narrower box, no longer travel."""
    assert found.claim < LOST
    t, originals = found.stated.lower, {p["name"]: p for p in document["claim"]["parameters"]}
    sides = {p.name: p.sides(t) for p in found.stated.parameters}
    for name, share in BOX.items():
        middle = fmpq(*float(originals[name]["nominal"]).as_integer_ratio())
        width = t * middle * fmpq(*share.as_integer_ratio())
        assert sides[name][0] <= middle - width
        assert sides[name][1] >= middle + width
    assert sides["x"][0] <= fmpq(*(-0.05).as_integer_ratio())
    assert sides["x"][1] >= fmpq(*(0.05).as_integer_ratio())


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_no_random_change_makes_a_claim_stronger(document: Content, tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    loop = [way for way in leaves(document["loops"][0]) if way[0] != "groups"]
    ways = [("claim", *way) for way in leaves(document["claim"])] + [("loops", 0, *way) for way in loop]
    refused, messages = 0, []
    for _ in range(40):
        content = copy.deepcopy(document)
        for _ in range(rng.integers(1, 4)):
            *path, last = ways[rng.integers(len(ways))]
            table: Any = content
            for key in path:
                table = table[key]
            table[last] = other(table[last], rng)
        try:
            if rng.random() < 0.7:
                renewed(content)
        except (TypeError, ValueError, AttributeError, OverflowError, ZeroDivisionError):
            pass  # fields that no longer are numbers
        try:
            found = check(written(content, tmp_path), HALBACH)
        except InputError as error:
            refused += 1
            messages.append(str(error))
            continue
        if found.ok:
            require_implied(found, document)
        else:
            refused += 1
            messages += found.failures
    assert refused == len(messages) >= 30
    assert not any("\n" in message for message in messages)


def exactly(x: float) -> Any:
    return fmpq(*x.as_integer_ratio())


def test_stated_intervals_lie_in_those_that_are_proven() -> None:
    rng = np.random.default_rng(5)
    for _ in range(200):
        nominal, width, t = (exactly(float(x)) for x in rng.uniform(0.1, 3, 3))
        low, high = nominal - t * width, nominal + t * width
        first, last = checked_file.inside(low, high)
        assert low <= exactly(first) <= nominal <= exactly(last) <= high
        assert exactly(math.nextafter(first, -math.inf)) < low
        assert exactly(math.nextafter(last, math.inf)) > high


@pytest.mark.slow
def test_boxes_hold_their_shares_exactly() -> None:
    """Widths in doubles would miss shares and ends by half a digit."""
    rng, missed = np.random.default_rng(6), 0
    for _ in range(20):
        m, share, k, end = rng.uniform(0.1, 3, 4).tolist()

        def matrices(m: Any, k: Any) -> Any:
            return [[0, 1], [-9 - k, -4 - m]], [[0], [1]], [[1, 0]]

        system = malta.uncertain(matrices, {"m": m, "k": k})
        law = malta.proof.Compensator(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.zeros((1, 1)))
        margin = malta.proof.Margin(0.1, math.inf, None, None, {}, {}, (), 0.0)
        content = certificate.certificate_of([(system, law)], {"m": share}, {"k": (k - end, k + 1)}, margin)
        one, two = content["claim"]["parameters"]
        assert exactly(one["down"]) == exactly(one["up"]) >= exactly(m) * exactly(share)
        missed += one["down"] != m * share
        assert exactly(k) + exactly(two["over"][0]) <= exactly(k - end)
        assert exactly(k) + exactly(two["over"][1]) >= exactly(k + 1)
    assert missed


# places


@pytest.fixture
def two_places(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Every model along a travel is too long for one proof, so that two places stand for it."""
    travel._loops_along.cache_clear()
    monkeypatch.setattr(travel, "MAX_ENCLOSED_OPERATIONS", 0)
    yield
    travel._loops_along.cache_clear()


@pytest.mark.slow
@pytest.mark.usefixtures("two_places")
def test_places_are_those_of_the_machine(tmp_path: Path, run: Run) -> None:
    path = certified(HALBACH, BOX, 2.0, tmp_path / "c.json")
    assert check(path, HALBACH).ok
    document = json.loads(path.read_text())
    assert document["claim"]["places"] == {"name": "x", "unit": "m", "at": [0.0, 0.05]}
    out = run("check", str(path), "--gains", str(HALBACH)).out
    assert "at x = 0, 0.05 m, not between them" in out
    assert out.splitlines()[-1].endswith("of the uncertainty at each of 2 places, not between them: holds")
    content = copy.deepcopy(document)
    content["claim"]["places"]["at"] = [0.0, 0.06]
    (line,) = check(written(content, tmp_path), HALBACH).failures
    assert line.startswith("the place of each loop is x = 0.0, 0.06 m, that of ")
    content = copy.deepcopy(document)
    del content["loops"][1]
    content["claim"]["places"] = None
    (line,) = check(written(content, tmp_path), HALBACH).failures
    assert line.startswith("x is not among its parameters")
    content = copy.deepcopy(document)
    content["loops"][1:] = content["loops"][1:] * 2
    with pytest.raises(InputError):
        check(written(content, tmp_path), HALBACH)
    content["claim"]["places"] = None
    with pytest.raises(InputError, match="expected the places of 3 loops"):
        check(written(content, tmp_path))
    content["claim"]["places"] = {"name": "x", "unit": "m", "at": [0.0, 0.05, 0.05]}
    (line,) = check(written(content, tmp_path), HALBACH).failures
    assert line.startswith("the place of each loop is")


# what is more than the claim


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ranges", "lower"),
    [
        (BOX | {"m": 0.11}, 3.5),
        (BOX | {"b": (6.0, 12.0)}, 3.0),
        ({"R": 0.2, "L": 0.05, "m": 0.1, "b": 0.2, "A": 0.1}, 3.5),
    ],
)
def test_a_larger_box_implies_the_claim(tmp_path: Path, ranges: dict[str, Any], lower: float) -> None:
    found = check(certified(HALBACH, ranges, lower, tmp_path / "c.json"), HALBACH)
    assert (found.ok, found.failures, found.compared) == (True, (), True)
    assert found.claim == pytest.approx(0.999 * lower)


@pytest.mark.slow
def test_the_box_may_be_named(document: Content, tmp_path: Path) -> None:
    path = written(document, tmp_path)
    for uncertain in ({"b": 0.05, "R": 0.2}, {"m": (3.5, 4.0)}):
        assert check(path, HALBACH, uncertain=uncertain).ok
    for uncertain in ({"m": 0.11}, {"m": (3.3, 4.0)}):
        (line,) = check(path, HALBACH, uncertain=uncertain).failures
        assert line.startswith("its box is too small: m from ")
    (line,) = check(path, HALBACH, uncertain={"L": 0.1}).failures
    assert line.startswith("L is not among its parameters")
    for bad in ({}, {"nothing": 0.1}, {"m": -0.1}, {"m": math.inf}, {"x": 0.1}):
        with pytest.raises(InputError):
            check(path, HALBACH, uncertain=bad)
    with pytest.raises(InputError, match="found no gain file"):
        check(path, uncertain={"m": 0.1})


@pytest.mark.slow
def test_the_encoding_of_the_gain_file_does_not_matter(document: Content, tmp_path: Path) -> None:
    path = written(document, tmp_path)
    for suffix in (".npz", ".mat"):
        assert check(path, HALBACH.with_suffix(suffix)).ok


@pytest.mark.slow
def test_a_law_verified_again_is_the_same_law(document: Content, tmp_path: Path) -> None:
    content = json.loads(HALBACH.read_text())
    content["verification"]["robust"]["lower"] = 1.0
    content["verification"]["robust"]["uncertainty"]["m"] = 0.05
    content["provenance"]["malta"] = "0.1"
    gains = written(content, tmp_path)
    found = check_of(document, tmp_path, gains)
    assert found.ok
    content["verification"]["robust"]["uncertainty"]["m"] = 0.15
    assert "its box is too small: m" in check_of(document, tmp_path, written(content, tmp_path)).failures[0]


def check_of(document: Content, folder: Path, gains: Path) -> CertificateVerdict:
    """The check of a certificate in a folder of its own."""
    (folder / "own").mkdir(exist_ok=True)
    return check(written(document, folder / "own"), gains)


def test_a_gain_file_that_is_none(document: Content, tmp_path: Path) -> None:
    path = written(document, tmp_path)
    for gains in (tmp_path / "none.json", ROOT / "pyproject.toml", path):
        with pytest.raises(InputError):
            check(path, gains)


# machines of one's own


WARM = {'name = "ball"': 'name = "warm"', 'name="ball",': 'name="warm", over={"C": (1.9e-5, 2.1e-5)},'}


@pytest.mark.slow
def test_intervals_of_a_machine_are_part_of_the_claim(tmp_path: Path) -> None:
    """A sphere whose magnets may have any constant in an interval, and whose gain file names no uncertainty."""
    folder = ROOT / "examples" / "ball"
    for source, name in ((folder / "ball.py", "warm.py"), (folder / "ball.toml", "warm.toml")):
        text = source.read_text().replace("ball.py", "warm.py")
        for old, new in WARM.items():
            text = text.replace(old, new)
        (tmp_path / name).write_text(text)
    (tmp_path / "d").mkdir()
    design = (folder / "design" / "ball.toml").read_text()
    (tmp_path / "d" / "warm.toml").write_text(design.replace("ball", "warm").replace("C = 0.2\n", ""))
    spec = malta.read_design(tmp_path / "d" / "warm.toml")
    model = malta.linearize(spec.plant, spec.plant.at())
    controller, gains = malta.synthesize(spec, model), tmp_path / "gains.json"
    malta.gains.write(controller, malta.verify(model, controller), gains)
    path = certified(gains, {"m": 0.2}, 1.5, tmp_path / "c.json")
    assert check(path, gains, uncertain={"m": 0.2}).ok
    with pytest.raises(InputError, match="no uncertain parameters"):
        check(path, gains)
    content = json.loads(path.read_text())
    of("C", "over", lambda ends: [0.5 * x for x in ends])(content)
    (line,) = check(written(content, tmp_path), gains, uncertain={"m": 0.2}).failures
    assert re.search(
        r"its box is too small: C from 1\.95e-05 to 2\.05e-05 .* from 1\.9e-05 to 2\.1e-05", line
    )
    wide = certified(gains, {"m": 0.2, "C": 0.06}, 1.0, tmp_path / "wide.json")
    assert check(wide, gains, uncertain={"m": 0.2}).ok
    narrow = certified(gains, {"m": 0.2, "C": 0.04}, 1.0, tmp_path / "narrow.json")
    assert "its box is too small: C" in check(narrow, gains, uncertain={"m": 0.2}).failures[0]


def test_stages_are_those_of_the_loops(document: Content) -> None:
    assert set(checked_file.STAGES) == set(get_args(CurrentLoops))
    assert document["claim"]["current_loops"] == "lag"


@pytest.mark.slow
def test_the_stage_of_a_claim_is_the_one_that_is_rebuilt(tmp_path: Path) -> None:
    gains = ROOT / "design" / "gains" / "robust.json"
    box = {"m": 0.2}
    path = certified(gains, box, 1.0, tmp_path / "c.json", "pi")
    assert check(path, gains, uncertain=box).ok
    content = json.loads(path.read_text())
    content["claim"]["current_loops"] = "lag"
    assert check(written(content, tmp_path), gains, uncertain=box).failures == (
        f"the stage of current loops is lag, that of {gains} is pi",
    )
    content["claim"]["current_loops"] = "pi"
    of("z", "over", lambda _: [-0.0149, 0.015])(content)
    (line,) = check(written(content, tmp_path), gains, uncertain=box).failures
    assert line.startswith("its travel is too small: z from -0.0149 to 0.015 m")


# the command line


@pytest.mark.slow
def test_check_prints_the_box_and_whose_it_is(run: Run, document: Content, tmp_path: Path) -> None:
    path = written(document, tmp_path)
    code, out, err = run("check", str(path))
    assert (code, err) == (0, "")
    assert out.startswith("Claim: halbach, preset identified; law halbach, sha256 ")
    assert "current loops, if any, as first-order lags" in " ".join(out.split())
    assert re.search(r"^ m +3\.75 +2\.2515 +5\.2485 +kg *$", out, re.M)
    assert re.search(r"^ x +0 +-0\.05 +0\.05 +m *$", out, re.M)
    own = "in the certificate's own box above, compared with no gain file"
    assert out.splitlines()[-1] == f"{path}: stable in 399.60 % of the uncertainty, {own}: holds"
    code, out, err = run("check", str(path), "--gains", str(HALBACH))
    assert (code, err) == (0, "")
    assert out.splitlines()[-1] == f"{path}: stable in 399.60 % of the uncertainty: holds"
    code, out, err = run("check", str(path), "--gains", str(HALBACH), "--uncertain", "12%")
    assert (code, "its box is too small: m from 2.2515 to 5.2485 kg at 399.60 %" in err) == (1, True)
    found = json.loads(run("check", str(path), "--gains", str(HALBACH), "--json").out)
    assert (found["compared"], found["holds"], found["claim"]["law"]) == (True, True, "halbach")
    assert found["claim"]["parameters"][0]["unit"] == "kg"
    code, out, err = run("check", str(path), "--uncertain", "m=10%")
    assert (code, err.count("\n")) == (2, 1)


@pytest.mark.slow
def test_digits_are_cut_towards_less(document: Content, tmp_path: Path, run: Run) -> None:
    content = copy.deepcopy(document)
    claiming(content, 3.9399999)
    path = written(content, tmp_path)
    assert claim_share(check(path).stated) == "393.99 %"
    found = re.search(r"^ A +1\.6067 +(\S+) +(\S+) +N/A", run("check", str(path)).out, re.M)
    assert found is not None
    low, high = row(content, "A")["interval"]
    assert low <= float(found[1]) <= low * (1 + 1e-6)
    assert high * (1 - 1e-6) <= float(found[2]) <= high
