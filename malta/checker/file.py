"""A certificate file as `check` reads it: every field checked, every number an exact rational.

Numbers are hex floats or JSON numbers that are doubles; their sizes and counts are limited, so that no file takes
unbounded time or memory.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flint import fmpq

FORMAT, VERSION = "malta margin certificate", 3
OLD_VERSIONS = (1, 2)  # 1 named no machine and no travel, 2 left out what loads the machine
MAX_BYTES = 4_000_000  # bytes of a certificate
STAGES = ("lag", "pi")  # of current loops: first-order lags, or the sampled PI controllers of the gain file
MAX_NAME_LENGTH = 100  # characters of a name
ARITY = {
    "assign": 1, "neg": 1, "sq": 1, "twice": 1, "inv": 1, "constpow": 1,
    "add": 2, "sub": 2, "mul": 2, "div": 2, "input": 0, "const": 0,
}  # fmt: skip


class Unreadable(ValueError):
    """A file that is no certificate: where, which field, what was found there, what was expected."""

    def __init__(self, where: str | Path, field: str, found: str, expected: str) -> None:
        self.where, self.field, self.found, self.expected = str(where), field, found, expected
        subject = ": ".join(filter(None, (self.where, field)))
        super().__init__(f"{subject}: found {found}, expected {expected}")


@dataclass(frozen=True)
class StatedParameter:
    """p in [nominal - t down + over[0], nominal + t up + over[1]], SI; `over` does not grow with the margin t."""

    name: str
    unit: str | None  # None: matrices of no machine
    nominal: Any
    down: Any
    up: Any
    over: tuple[Any, Any]
    interval: tuple[Any, Any]  # at the claim, as the file has it

    def sides(self, t: Any) -> tuple[Any, Any]:
        """The ends of the interval at t."""
        return self.nominal - t * self.down + self.over[0], self.nominal + t * self.up + self.over[1]


@dataclass(frozen=True)
class StatedOrigin:
    """The machine and the law that the loops are said to be of."""

    machine: str
    preset: str
    law: str  # name of the design
    sha256: str  # of the gain file, without what was verified and where it was made
    current_loops: str  # one of STAGES


@dataclass(frozen=True)
class StatedPlaces:
    """Where each loop stands along the travel, which is no parameter then."""

    name: str
    unit: str
    at: tuple[Any, ...]


@dataclass(frozen=True)
class StabilityClaim:
    """Every loop is stable for all p in the sides at `lower`."""

    lower: Any
    origin: StatedOrigin | None  # None: of matrices alone
    sample_time: Any  # s; None: continuous
    places: StatedPlaces | None  # None: all loops are of the whole travel, or of no travel
    parameters: tuple[StatedParameter, ...]


@dataclass(frozen=True)
class StatedCell:
    """Where Re(conj(re + j im) a) > 0 is claimed: x in [low, high], v in its shares of the part's box.

    Branch 0: s = j x 2^scale; branch 1: s = j 2^scale / x.
    """

    branch: int
    low: Any
    high: Any
    box: tuple[tuple[Any, Any], ...]
    re: Any
    im: Any


@dataclass(frozen=True)
class AxisEnclosure:
    """How a part is enclosed along one parameter: degree of interpolation, ellipse it is bounded in, degree kept."""

    degree: int
    rho: Any
    kept: int


@dataclass(frozen=True)
class StatedPart:
    """A part of the box of p, and its cells."""

    axes: tuple[AxisEnclosure, ...]
    box: tuple[tuple[Any, Any], ...]
    scale: int
    cells: tuple[StatedCell, ...]


@dataclass(frozen=True)
class StatedGroup:
    """States of the system and of the compensator; parameters whose v is 1 / p."""

    states: tuple[int, ...]
    own: tuple[int, ...]
    inverted: tuple[bool, ...]
    parts: tuple[StatedPart, ...]

    def members(self, n: int) -> tuple[int, ...]:
        """Numbers of the states, those of the compensator after the system's n."""
        return (*self.states, *(n + i for i in self.own))


Steps = tuple[tuple[str, int, tuple[int, ...], Any], ...]


@dataclass(frozen=True)
class StatedConditions:
    """Steps of p, and those of them that are above zero where the matrices are those of the machine."""

    steps: Steps
    above: tuple[int, ...]


@dataclass(frozen=True)
class StatedLoop:
    """E x' = A x + B u (x+ where discrete), y = C x, u = F y after hold, delay (samples) and lag (rad/s)."""

    states: int
    steps: Steps
    entries: tuple[tuple[tuple[int, int, int], ...], ...]  # of A, B, C, E: row, column, step; E diagonal or I
    law: tuple[list[list[Any]], ...]  # A, B, C, D
    sample_time: Any
    discrete: bool
    delay: Any
    lag: Any
    conditions: StatedConditions
    units: tuple[int, ...]  # log2 of sizes of the states, in which small couplings are bounded
    groups: tuple[StatedGroup, ...]

    @property
    def split(self) -> tuple[int, Any]:
        """Whole samples of the delay, and the fraction of one beyond."""
        whole = int(self.delay.floor())
        return whole, self.delay - whole

    @property
    def held(self) -> bool:
        """Whether the inputs of a continuous system are held between samples."""
        return self.sample_time is not None and not self.discrete


@dataclass(frozen=True)
class Document:
    """What is claimed, and of which loops; sha256: what the file says and what it is."""

    claim: StabilityClaim
    loops: tuple[StatedLoop, ...]
    sealed: bool


@dataclass(frozen=True)
class DocumentValue:
    """A value of the file and its place, which every complaint names."""

    file: Path
    name: str
    value: Any

    def wrong(self, expected: str) -> Unreadable:
        return Unreadable(self.file, self.name, repr(self.value)[:60], expected)

    def __getitem__(self, key: str) -> DocumentValue:
        if not isinstance(self.value, dict):
            raise self.wrong(f"a table with {key}")
        if key not in self.value:
            raise Unreadable(self.file, f"{self.name}.{key}".lstrip("."), "nothing", "a value")
        return DocumentValue(self.file, f"{self.name}.{key}".lstrip("."), self.value[key])

    def items(self, least: int, most: int | None = None) -> list[DocumentValue]:
        most = least if most is None else most
        if not isinstance(self.value, list) or not least <= len(self.value) <= most:
            raise self.wrong(f"a list of {least} to {most} items")
        return [DocumentValue(self.file, f"{self.name}[{k}]", x) for k, x in enumerate(self.value)]

    def whole(self, low: int, high: int) -> int:
        if type(self.value) is not int or not low <= self.value <= high:
            raise self.wrong(f"a whole number from {low} to {high}")
        return self.value

    def text(self, longest: int = MAX_NAME_LENGTH) -> str:
        """A name that a terminal can print."""
        found = self.value
        if not (isinstance(found, str) and len(found) <= longest and found.isprintable()):
            raise self.wrong(f"printable text of at most {longest} characters")
        return found

    def truth(self) -> bool:
        if type(self.value) is not bool:
            raise self.wrong("true or false")
        return self.value

    def number(self, low: float = -1e90, high: float = 1e90) -> Any:
        """A double as a rational."""
        found = self.value
        if isinstance(found, str) and len(found) <= 40:
            try:
                found = float.fromhex(found)
            except (ValueError, OverflowError):
                found = None
        if type(found) is int and abs(found) <= 2**53:
            found = float(found)
        if type(found) is not float or not (found == 0 or abs(found) > 1e-90) or not low <= found <= high:
            raise self.wrong(f"a number from {low:g} to {high:g}, zero or of at least 1e-90")
        return fmpq(*found.as_integer_ratio())

    def pair(self, low: float = -1e90, high: float = 1e90) -> tuple[Any, Any]:
        one, two = (x.number(low, high) for x in self.items(2))
        if not one <= two:
            raise self.wrong("low, high")
        return one, two

    def matrix(self, rows: int, columns: int) -> list[list[Any]]:
        return [[x.number() for x in row.items(columns)] for row in self.items(rows)]

    def indices(self, count: int) -> tuple[int, ...]:
        return tuple(x.whole(0, count - 1) for x in self.items(0, max(count, 1)))


def parameter(f: DocumentValue, known: bool) -> StatedParameter:
    """A parameter of the box; `known`: of a machine, which gives it a unit."""
    over = f["over"].pair()
    if not over[0] <= 0 <= over[1]:
        raise f["over"].wrong("an interval about zero")
    if not known and f["unit"].value is not None:
        raise f["unit"].wrong("null without a machine")
    unit = f["unit"].text() if known else None
    grows = (f["down"].number(0), f["up"].number(0))
    return StatedParameter(f["name"].text(), unit, f["nominal"].number(), *grows, over, f["interval"].pair())


def claim(f: DocumentValue, loops: int) -> StabilityClaim:
    """What the certificate claims of so many loops."""
    machine, law, stage = f["machine"], f["law"], f["current_loops"]
    origin = None
    if not machine.value is law.value is stage.value is None:
        if stage.value not in STAGES:
            raise stage.wrong(" or ".join(STAGES))
        seal = law["sha256"].text(64)
        if len(seal) != 64 or set(seal) - set("0123456789abcdef"):
            raise law["sha256"].wrong("64 hexadecimal digits")
        origin = StatedOrigin(
            machine["name"].text(), machine["preset"].text(), law["name"].text(), seal, stage.value
        )
    T, where, places = f["sample_time"], f["places"], None
    if where.value is not None:
        at = tuple(x.number() for x in where["at"].items(loops))
        places = StatedPlaces(where["name"].text(), where["unit"].text(), at)
    elif origin is not None and loops > 1:
        raise where.wrong(f"the places of {loops} loops along the travel")
    parameters = tuple(parameter(x, origin is not None) for x in f["parameters"].items(1, 20))
    if len({p.name for p in parameters}) < len(parameters):
        raise f["parameters"].wrong("each parameter once")
    time = None if T.value is None else T.number(1e-90)
    return StabilityClaim(f["lower"].number(1e-9, 10_000), origin, time, places, parameters)


def double(x: Any) -> float:
    """The double nearest to a rational."""
    return int(x.p) / int(x.q)


def inside(low: Any, high: Any) -> tuple[float, float]:
    """The doubles next to the ends of an interval of rationals, within it; it holds a double."""
    first, last = double(low), double(high)
    if fmpq(*first.as_integer_ratio()) < low:
        first = math.nextafter(first, math.inf)
    if fmpq(*last.as_integer_ratio()) > high:
        last = math.nextafter(last, -math.inf)
    return first, last


def step(f: DocumentValue, k: int, inputs: int) -> tuple[str, int, tuple[int, ...], Any]:
    """The k-th step: what is done, which input, on which steps before it, with which number."""
    name, target, on, number = f.items(4)
    operands, value = on.indices(k), number.number()
    if not isinstance(name.value, str) or ARITY.get(name.value) != len(operands):
        raise f.wrong("one of " + " ".join(ARITY) + ", with its operands")
    if name.value == "constpow" and (value.q != 1 or abs(value) > 32):
        raise f.wrong("a whole power up to 32")
    return name.value, target.whole(0, inputs - 1 if name.value == "input" else 0), operands, value


def program(f: DocumentValue, inputs: int) -> Steps:
    return tuple(step(x, k, inputs) for k, x in enumerate(f.items(0, 20_000)))


def entries(f: DocumentValue, rows: int, columns: int, steps: int) -> tuple[tuple[int, int, int], ...]:
    found = {}
    for row in f.items(0, rows * columns):
        i, j, which = row.items(3)
        found[i.whole(0, rows - 1), j.whole(0, columns - 1)] = which.whole(0, steps - 1)
    return tuple((*at, which) for at, which in found.items())


def loop(f: DocumentValue, inputs: int) -> StatedLoop:
    n, m, p = (x.whole(1, 60) for x in f["shape"].items(3))
    steps = program(f["steps"], inputs)
    made = program(f["conditions"]["steps"], inputs)
    above = tuple(x.whole(0, len(made) - 1) for x in f["conditions"]["above"].items(0, 1000))
    shapes = {"A": (n, n), "B": (n, m), "C": (p, n)} | ({"E": (n, n)} if "E" in f.value else {})
    matrices = [entries(f[key], *shape, len(steps)) for key, shape in shapes.items()]
    matrices += [()] * (4 - len(matrices))
    if matrices[3] and sorted(at for *at, _ in matrices[3]) != [[i, i] for i in range(n)]:
        raise f["E"].wrong("a diagonal of entries")
    law = f["compensator"]
    k = len(law["A"].items(0, 60))
    T, lag = (None if f[key].value is None else f[key].number(1e-90) for key in ("sample_time", "lag"))
    discrete = f["discrete"].truth()
    if discrete and (T is None or lag is not None):
        raise f["discrete"].wrong("false, or a sample time and no lag")
    delay = f["delay"].number(0, 20 if T is not None else 0)
    if discrete and delay.q != 1:
        raise f["delay"].wrong("whole samples of a system in discrete time")
    groups = tuple(group(g, n, k, inputs) for g in f["groups"].items(0, n + k))
    units = tuple(x.whole(-300, 300) for x in f["units"].items(n + k))
    return StatedLoop(
        n, steps, tuple(matrices),
        tuple(law[key].matrix(*at) for key, at in (("A", (k, k)), ("B", (k, p)), ("C", (m, k)), ("D", (m, p)))),
        T, discrete, delay, lag, StatedConditions(made, above), units, groups,
    )  # fmt: skip


def group(f: DocumentValue, n: int, k: int, inputs: int) -> StatedGroup:
    inverted = tuple(x.truth() for x in f["inverted"].items(inputs))
    parts = tuple(part(x, inputs) for x in f["parts"].items(0, 256))
    return StatedGroup(f["states"].indices(n), f["own"].indices(k), inverted, parts)


def part(f: DocumentValue, inputs: int) -> StatedPart:
    cells = []
    for row in f["cells"].items(1, 20_000):
        branch, low, high, shares, re, im = row.items(6)
        ends = DocumentValue(f.file, row.name, [low.value, high.value]).pair(0)
        box = tuple(x.pair(0, 1) for x in shares.items(inputs))
        cells.append(StatedCell(branch.whole(0, 1), *ends, box, re.number(), im.number()))
    axes = []
    for x in f["axes"].items(inputs):
        degree, rho, kept = x.items(3)
        axes.append(
            AxisEnclosure(degree.whole(0, 24), rho.number(1.001, 1e30), kept.whole(0, degree.whole(0, 24)))
        )
    return StatedPart(
        tuple(axes),
        tuple(x.pair() for x in f["box"].items(inputs)),
        f["scale"].whole(-300, 300),
        tuple(cells),
    )


def digest(content: dict[str, object]) -> str:
    """sha256 of everything in a certificate but that."""
    rest = {key: value for key, value in content.items() if key != "sha256"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def json_of(path: Path) -> DocumentValue:
    """The JSON of a certificate of any version. Raises Unreadable for what is none, and for pipes and devices."""
    try:
        if not (path.is_file() or path.is_dir()) and path.exists():
            raise Unreadable(path, "", "a pipe or a device", "a certificate")
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise Unreadable(path, "", f"{size} bytes", f"a certificate of at most {MAX_BYTES}")
        content = json.loads(path.read_bytes().decode())
    except Unreadable:
        raise
    except OSError as error:
        raise Unreadable(path, "", error.strerror or "an unreadable file", "a certificate") from error
    except (ValueError, RecursionError) as error:
        raise Unreadable(path, "", f"no JSON ({str(error)[:80]})", "a certificate") from error
    f = DocumentValue(path, "", content)
    if f["format"].value != FORMAT:
        raise f["version"].wrong(f"{FORMAT}, version {VERSION}")
    return f


def content_of(path: Path) -> dict[str, Any]:
    """The JSON of a certificate. Raises Unreadable as `json_of`, and for other versions."""
    f = json_of(path)
    if f["version"].value in OLD_VERSIONS:
        found = f"{f['version'].value}, of a machine without its loads"
        raise Unreadable(
            path, "version", found, f"{VERSION}: `malta verify GAINS --renew {path.name}` proves it anew"
        )
    if f["version"].value != VERSION:
        raise f["version"].wrong(f"{FORMAT}, version {VERSION}")
    content: dict[str, Any] = f.value
    return content


def read(path: Path) -> Document:
    """A certificate. Raises Unreadable for files that cannot be read, and fields that are missing or wrong."""
    content = content_of(path)
    f = DocumentValue(path, "", content)
    several = f["loops"].items(1, 20)
    made = claim(f["claim"], len(several))
    loops = tuple(loop(x, len(made.parameters)) for x in several)
    return Document(made, loops, f["sha256"].value == digest(content))
