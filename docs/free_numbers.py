"""The page on the numbers of the designs: python docs/free_numbers.py writes docs/claims/numbers.md anew.

Of each number of a design that stands beside a paper's figures: whether it is printed, solved from or fitted on what is
printed, or free, and what moves when it is twice or half as large. A number of a design file without a line here is an
error.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, NamedTuple

import malta
from malta.loops.time_domain import recovery
from malta.synthesis.design_file import resolve_published
from malta.synthesis.spec import Spec
from malta.tables import load_toml

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "claims" / "numbers.md"
HEAD = """# Where the numbers of the designs come from

A design that stands beside a paper's figures has numbers that the paper prints, numbers that are solved from or fitted
on what it prints, and free ones, which are ours. The tables name them all, and what moves when a number is twice or
half as large, the others as shipped. `python docs/free_numbers.py` computes the page.

The figures are the peak of |S| at the worst sensor, the last crossover of the loop (rad/s), and how far 1 N along x
or y moves an output (µm). For MALTA there are also K1/k, the stiffness of the LQR over that of the attraction, and the
deviation of sensor plane 2 in Fig. 16 without noise (SP2, µm; the paper has less than 4). An entry such as "2.4 / 2.2"
is of twice and of half the number, or of the other choices in their order. "–" is a figure that keeps its three digits.
"""


class Line(NamedTuple):
    """Some numbers of a design that are changed together."""

    name: str
    keys: tuple[str, ...]  # of the design file; * stands for any part
    origin: str
    others: tuple[Any, ...] = ()  # in place of twice and half the number


XY, TILT = ("weights.state.x", "weights.state.y"), ("weights.state.alpha", "weights.state.beta")
STATES = "printed: Table II(b)"
LQG = (
    Line("weights of x, y", XY, STATES),
    Line("weights of alpha, beta", TILT, STATES),
    Line("weight of z", ("weights.state.z",), STATES),
    Line("weights of their rates", ("weights.state.*_dot",), STATES),
    Line("weights of bearing forces", ("weights.input.f*_B*",), STATES),
    Line("weight of the thrust", ("weights.input.f_D",), STATES),
    Line("weights of the planes' integrals", ("weights.integral.[xy]*",), "printed: Table II(c)"),
    Line("weight of the integral of z", ("weights.integral.z",), "printed: Table II(c)"),
    Line("process noise, bearings", ("noise.process.f*_B*",), "printed: Table II(a)"),
    Line("process noise, thrust", ("noise.process.f_D",), "printed: Table II(a)"),
    Line("sample time", ("sample_time",), "printed: Sec. V-A, 20 kHz"),
    Line("operating point, z", ("operating_point.z",), "printed: Table I, z_ss = 0", (10.0,)),
    Line("uncertainty", ("uncertainty.*",), "printed: Sec. IV-A; shapes no gains", ()),
)
SI = Line("bases", ("bases.*",), "free: the printed weights read as plain SI numbers", ())
HALBACH_PID = (
    Line("Kp", ("pid.Kp.*",), "free: see the design file"),
    Line("Ki", ("pid.Ki.*",), "free: see the design file"),
    Line("Kd", ("pid.Kd.*",), "free: see the design file"),
    Line("filter of the difference", ("pid.filter*",), "free: a plain difference", ()),
    Line("sample time", ("sample_time",), "printed: of the laser, Sec. 5.1"),
    Line("operating point, x", ("operating_point.x",), "printed: the middle", (10.0,)),
    Line(
        "dead time in the current loops' design",
        ("current_loop_delay",),
        "free: usual in the field",
        (False,),
    ),
    Line("uncertainty", ("uncertainty.*",), "free; shapes no gains", ()),
)
OF_DESIGN: dict[str, tuple[Line, ...]] = {
    "table2": (
        *LQG,
        SI,
        Line("sensor noise, planes", ("noise.sensor.[xy]*",), "printed: Table II(a)"),
        Line("sensor noise, z", ("noise.sensor.z",), "printed: Table II(a)"),
        Line("discretization", ("discretization",), "printed: Sec. V-A", ("zoh", "sampled-data")),
        Line("dead time in the current loops' design", ("current_loop_delay",), "printed: eq. (20) has none", (True,)),
        Line("samples of delay in the design", ("delay",), "free: none, as in eq. (19)"),
    ),
    "calibrated": (
        *LQG,
        Line("bases of x, y", ("bases.state.[xy]",), "solved: K1/k = 4, from 300 % of Sec. IV-A"),
        Line("bases of alpha, beta", ("bases.state.alpha", "bases.state.beta"), "solved: K1/k = 4, likewise"),
        Line("base of z", ("bases.state.z",), "free: as fast as x, about 400 rad/s of Sec. IV-A"),
        Line("bases of the rates", ("bases.state.*_dot",), "free: w_n of the LQR times the position's base"),
        Line("base of forces", ("bases.input",), "free: 1 N; a common factor of all bases changes no gain", ()),
        Line("bases of the planes' integrals", ("bases.integral.[xy]*",), "fitted: Fig. 16, SP2 below 4 µm"),
        Line("base of the integral of z", ("bases.integral.z",), "free: 1 s of the base of z"),
        Line("sensor noise, planes", ("noise.sensor.[xy]*",), "printed: Table III"),
        Line("sensor noise, z", ("noise.sensor.z",), "printed: Table III"),
        Line("discretization", ("discretization",), "free: the paper's is backward Euler", ("zoh", "backward-euler")),
        Line("dead time in the current loops' design", ("current_loop_delay",), "free: usual in the field", (False,)),
        Line("samples of delay in the design", ("delay",), "free: none, as in eq. (19)", (1,)),
    ),
    "calibrated_slow": (
        Line("bases of the planes' integrals", ("bases.integral.[xy]*",), "free: 1 s of the base of x"),
    ),
    "halbach_pid": HALBACH_PID,
    "halbach_calm": HALBACH_PID,
    "planar_pid": (
        Line("Kp of forces", ("pid.Kp.F_*",), "free: `malta tune`, peak |S| of 1.8"),
        Line("Kp of torques", ("pid.Kp.T_*",), "free: likewise"),
        Line("Ki of forces", ("pid.Ki.F_*",), "free: likewise"),
        Line("Ki of torques", ("pid.Ki.T_*",), "free: likewise"),
        Line("Kd of forces", ("pid.Kd.F_*",), "free: likewise"),
        Line("Kd of torques", ("pid.Kd.T_*",), "free: likewise"),
        Line("filter of the difference", ("pid.filter*",), "free: a plain difference", ()),
        Line("sample time", ("sample_time",), "printed: the mean time of a loop"),
        Line("braking of references", ("braking.*",), "free: of 50 m/s² at the force limit; shapes no loop", ()),
        Line("operating point, y", ("operating_point.y",), "printed: the middle", (10.0,)),
        Line("dead time in the current loops' design", ("current_loop_delay",), "there are no current loops", ()),
        Line("uncertainty", ("uncertainty.*",), "free; shapes no gains", ()),
    ),
}  # fmt: skip
LIKE = {"calibrated_slow": "calibrated"}  # designs that share all other numbers
WORDS = ("name", "summary", "machine", "preset", "pid.axes")
LATER = ("cost", "specification", "search")  # what a search is for; no number of the law
Figures = tuple[float, ...]


def entries_of(path: Path) -> dict[str, Any]:
    """The entries of a design file that shape its law, by dotted key; quantities are tables of value and unit."""

    def walk(table: Mapping[str, Any], above: str) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for key, entry in table.items():
            whole = isinstance(entry, Mapping) and "unit" not in entry
            found |= walk(entry, f"{above}{key}.") if whole else {above + key: entry}
        return found

    content = walk(resolve_published(load_toml(path), path), "")
    return {key: e for key, e in content.items() if key not in WORDS and key.partition(".")[0] not in LATER}


def lines_of(name: str) -> list[tuple[Line, dict[str, Any]]]:
    """The lines of a design with their entries. Raises LookupError unless every entry has exactly one line."""
    entries = entries_of(ROOT / "design" / f"{name}.toml")
    if name in LIKE:
        like = entries_of(ROOT / "design" / f"{LIKE[name]}.toml")
        entries = {key: entry for key, entry in entries.items() if like.get(key) != entry}
    found = [
        (one, {key: e for key, e in entries.items() if any(fnmatch(key, k) for k in one.keys)})
        for one in OF_DESIGN[name]
    ]
    for key in entries:
        if sum(key in chosen for _, chosen in found) != 1:
            raise LookupError(f"design/{name}.toml: {key} has not exactly one line in docs/free_numbers.py")
    if empty := [one.name for one, chosen in found if not chosen]:
        raise LookupError(f"design/{name}.toml has no number for {empty}")
    return found


def with_value(entry: Any, value: Any) -> Any:
    """An entry with another value, in its unit."""
    return {**entry, "value": value} if isinstance(entry, Mapping) else value


def value_of(entry: Any) -> Any:
    """The value of an entry."""
    return entry["value"] if isinstance(entry, Mapping) else entry


def variants(line: Line, entries: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What is changed: twice and half of each number, or the other choices; nothing where neither makes sense."""
    values = [value_of(entry) for entry in entries.values()]
    if line.others:
        return [{key: with_value(e, other) for key, e in entries.items()} for other in line.others]
    if not all(type(v) in (int, float) and v > 0 for v in values) or not varied(line):
        return []
    return [{key: with_value(e, f * value_of(e)) for key, e in entries.items()} for f in (2.0, 0.5)]


def varied(line: Line) -> bool:
    """Whether a change of the line's numbers reaches the law: not those of an uncertainty, or of what is at rest."""
    return not any(key.startswith(("uncertainty", "braking")) for key in line.keys)


def figures_of(spec: Spec) -> Figures | None:
    """Peak of |S|, crossover and deviation under 1 N; of MALTA K1/k and SP2 of Fig. 16 too. None: unstable."""
    plant = spec.plant
    model = malta.linearize(plant, plant.at(**spec.operating_point))
    try:
        law = malta.synthesize(spec, model)
        report = malta.verify(model, law)
    except malta.CheckError:
        return None
    if not report.stable:
        return None
    peak = max(value for name, value in report.peak_sensitivity.items() if name != "sigma_max")
    sideways = {s.name for s in plant.disturbances} & {"F_x", "F_y"}
    pushed = recovery(plant, law, {name: {name: 1.0} for name in sorted(sideways)})
    moved = 1e6 * max(
        d.largest for one in pushed for d, s in zip(one.outputs, plant.outputs, strict=True) if s.unit == "m"
    )
    common = (peak, report.bandwidth["crossover_max"], moved)
    if plant.name != "tubular":
        return common
    tilt = malta.experiment("tilt", plant, law, feedforward="axial", noise=0.0, quantize=False).cases[0]
    K1 = (model.force_map @ malta.synthesis.lqr(model, spec.weights))[0, 0]
    deviation = 1e6 * tilt.merits[0].value if tilt.run.verdict.completed else math.inf
    return (*common, K1 / model.stiffness[0, 0], deviation)


def shown(value: float) -> str:
    """Three digits, without an exponent."""
    if not math.isfinite(value):
        return "touchdown"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def cells(nominal: Figures, changed: Sequence[Figures | None]) -> list[str]:
    """What a line shows of each figure: those of the changed designs, or a dash where none moves."""
    found = []
    for k, before in enumerate(nominal):
        after = ["unstable" if one is None else shown(one[k]) for one in changed]
        found.append("–" if set(after) <= {shown(before)} else " / ".join(after))
    return found


def quantity(entries: Mapping[str, Any]) -> str:
    """The numbers of a line, each once, with their unit."""
    texts = []
    for entry in entries.values():
        unit = f" {entry['unit']}" if isinstance(entry, Mapping) and entry["unit"] != "1" else ""
        value = value_of(entry)
        texts.append((f"{value:g}" if type(value) in (int, float) else str(value).lower()) + unit)
    return ", ".join(dict.fromkeys(texts)).replace(" um", " µm").replace(" us", " µs")


def table_of(name: str, chosen: Sequence[str] = ()) -> str:
    """The table of a design, of all its lines or of those of these names."""
    path = ROOT / "design" / f"{name}.toml"
    nominal = figures_of(malta.read_design(path))
    assert nominal is not None
    heads = ["peak of |S|", "crossover", "1 N moves", "K1/k", "SP2"][: len(nominal)]
    rows = [["number", "as shipped", "comes from", "changed to", *heads]]
    rows.append(["as shipped", "", "", "", *map(shown, nominal)])
    for line, entries in lines_of(name):
        if chosen and line.name not in chosen:
            continue
        changed = variants(line, entries)
        found = [figures_of(malta.read_design(path, None, one)) for one in changed]
        unit = "".join(f" {e['unit']}" for e in list(entries.values())[:1] if isinstance(e, Mapping))
        other = " / ".join(f"{o:g}{unit}" if type(o) is float else str(o).lower() for o in line.others)
        to = other or ("× 2 / × 1/2" if changed else "")
        moved = cells(nominal, found) if changed else ["–"] * len(nominal)
        rows.append([line.name, quantity(entries), line.origin, to, *moved])
    text = ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    return "\n".join([text[0], "|---" * len(rows[0]) + "|", *text[1:]])


def page(names: Sequence[str] = tuple(OF_DESIGN)) -> str:
    """The page, or its tables of some designs."""
    parts = [HEAD]
    for name in names:
        like = f", all other numbers as `{LIKE[name]}`" if name in LIKE else ""
        parts.append(f"## {name}\n\n{malta.read_design(ROOT / 'design' / f'{name}.toml').summary}{like}.\n")
        parts.append(table_of(name) + "\n")
    return "\n".join(parts)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(PAGE, file=sys.stderr)
