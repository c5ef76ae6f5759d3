"""Command lines: the commands that end quickly, with values that nobody expects."""

from __future__ import annotations

import contextlib
from pathlib import Path

from hypothesis import strategies as st

from fuzz.oracle import Ended, line, observe
from malta.cli.options import SCENARIO_FIELDS

GAINS = tuple(f"design/gains/{name}.json" for name in ("table2", "halbach", "tubular_pid"))
PLACES = (
    *GAINS,
    "design/table2.toml",
    "README.md",
    "nowhere.json",
    "",
    ".",
    "/dev/null",
    "a\x00b",
    "w" * 300,
    "γ.npz",
)
NUMBERS = (
    "0", "-0", "1", "-1", "0.5", "3", "1e-9", "1e-300", "5e-324", "1e9", "1e300", "1e400", "-1e400", "nan", "inf",
    "-inf", "1_0", "٣", "0x10", "1e", "", " ", "x", "--", "-", "1 2", "1,2", "9" * 400, "9" * 5000, "two\nlines", "γ",
    "\x1b[2J", "w" * 2000, "100000", "1000000000",
)  # fmt: skip
NAMES = (
    "m",
    "K_A",
    "w_cc",
    "l_B",
    "T_d",
    "x",
    "",
    "a b",
    "γ",
    "__class__",
    "preset",
    "w" * 400,
    "gain_x1",
    "hall_phase",
)
UNITS = (
    "", "kg", "g", "%", "mm", "mm mm", "kg^9", "kg^99", "m**-9/s", "((((m))))", "1/0", "(", "m^", "deg", "Hz",
    "m m" * 80, "1/s", "9" * 300, "µm", "μm", "x", "rad/s", "1", "kg * (m / s)", "\x00",
)  # fmt: skip
WORDS = (
    "stroke", "hold", "tilt", "payload", "disturbance", "drive-limits", "help", "lift", "jump", "logistic", "quintic",
    "force", "dq", "phase", "compiled", "virtual-machine", "kalman", "axial", "attraction", "fixed", "pi", "lag",
    "sobol", "", "x", "two\nlines", "γ", "w" * 500, "../../x", "nan",
)  # fmt: skip
OWN = (
    "radius",
    "masses",
    "during",
    "distance",
    "duration",
    "frequency",
    "height",
    "points",
    "log",
    "way",
    "x",
    "",
    *SCENARIO_FIELDS,
)

_numbers = st.sampled_from(NUMBERS) | st.floats().map(repr) | st.integers(-5, 500).map(str)
_units = st.sampled_from(UNITS) | st.text(st.sampled_from("kgms/^*() 123%.-"), max_size=14)
_values = st.builds(lambda number, unit: number + unit, _numbers, _units)
_assignments = st.builds(lambda name, value: f"{name}={value}", st.sampled_from(NAMES), _values) | _values
_own = st.builds(
    lambda name, value: f"{name}={value}", st.sampled_from(OWN), _values | st.sampled_from(WORDS)
)
_words = st.sampled_from(WORDS)
_runs = st.builds(lambda place, run: f"{place}:{run}", st.sampled_from(PLACES), _numbers)


def _options(**given: st.SearchStrategy[str]) -> st.SearchStrategy[tuple[str, ...]]:
    """Up to three of some options with values of theirs."""
    pairs = [st.tuples(st.just(f"--{name.replace('_', '-')}"), value) for name, value in given.items()]
    return st.lists(st.one_of(pairs), max_size=3).map(lambda found: tuple(x for pair in found for x in pair))


_of_runs = {
    "scenario": _words, "set": _assignments, "option": _own, "sensor": _assignments, "seed": _numbers,
}  # fmt: skip
_gains = st.sampled_from(GAINS) | st.sampled_from(PLACES)
_places = st.sampled_from(PLACES)
_usage = st.lists(
    st.sampled_from((*PLACES, *WORDS, "--json", "--out", "--nothing", "-x", "--seed=")), max_size=4
)

LINES: st.SearchStrategy[tuple[str, ...]] = st.one_of(
    st.tuples(st.just("simulate"), _gains).flatmap(lambda head: _options(
        **_of_runs, engine=_words, replay=_runs,
    ).map(lambda rest: (*head, "--json", *rest))),
    st.tuples(st.just("campaign"), _gains).flatmap(lambda head: _options(
        **_of_runs, spread=_assignments, case=_words, sampler=_words, workers=_numbers, worst=_numbers, design=_places,
    ).map(lambda rest: (*head, "--json", "--samples", "8", "--out", "OUT", *rest))),
    st.tuples(st.just("verify"), _gains).flatmap(lambda head: _options(
        set=_assignments, uncertain=_assignments, current_loops=_words, time=_numbers, certificate=_places,
    ).map(lambda rest: (*head, "--json", "--no-proof", *rest))),
    st.tuples(st.sampled_from(("check", "new")), st.sampled_from((*GAINS, *PLACES[4:], "--json", "--gains"))),
    st.tuples(st.sampled_from(("identify", "learn", "replay", "measure")), _gains, _places),
    st.tuples(st.just("log"), _places),
    st.tuples(st.just("claims"), st.sampled_from((*GAINS, *PLACES[4:]))),
    st.tuples(st.just("claims"), st.just("--update"), st.sampled_from((*GAINS, *PLACES[5:]))),
    st.tuples(st.just("tune"), st.sampled_from(PLACES), st.just("--check")).filter(lambda x: "table2.toml" not in x[1]),
    st.tuples(st.sampled_from(("simulate", "verify", "check", "new", "nothing", "")), _usage).map(
        lambda x: (x[0], *x[1])
    ),
)  # fmt: skip


def run_line(arguments: tuple[str, ...], folder: Path) -> Ended:
    """Run a command line; OUT stands for a folder of its own."""
    placed = [str(folder / "out") if text == "OUT" else text for text in arguments]
    with contextlib.chdir(folder):
        return observe(line(*placed), folder, writes=True)
