"""All kinds of input: their cases, how they are read, and how many cases each one gets."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from hypothesis import strategies as st

from fuzz.cases import Case, cases
from fuzz.designs import EXAMPLES, read_data_file, read_design_file
from fuzz.gain_files import (
    NAMED,
    draw_figures,
    export_as_c,
    read_gain_file,
    read_shares_of,
    show_scenarios,
    use_names,
)
from fuzz.lines import LINES, run_line
from fuzz.oracle import Ended
from fuzz.records import (
    check_certificate,
    read_campaign,
    read_day,
    read_dump_file,
    read_log_file,
    read_rare_event,
    read_response_file,
    read_run_file,
    read_trials,
)

GAINS = ("table2", "robust", "tubular_pid", "halbach", "planar", "linear")
DESIGNS = (
    "table2",
    "robust",
    "robust_observer",
    "tubular_pid",
    "structured",
    "halbach",
    "halbach_pid",
    "planar",
)
DATA = ("tubular", "halbach", "planar")


Read = Callable[[Case, Path], Ended | None]


class Kind(NamedTuple):
    """A kind of input: its cases, how it is read, and how many of 2000 cases it gets."""

    cases: st.SearchStrategy[Any]
    read: Callable[[Any, Path], Ended | None]
    share: int


def _of_form(suffix: str) -> Read:
    def read(case: Case, folder: Path) -> Ended | None:
        return read_gain_file(case, folder, suffix)

    return read


KINDS: dict[str, Kind] = {
    "gains.json": Kind(cases(GAINS), _of_form(".json"), 200),
    "gains.npz": Kind(cases(GAINS), _of_form(".npz"), 200),
    "gains.mat": Kind(cases(GAINS), _of_form(".mat"), 200),
    "design": Kind(cases((*DESIGNS, *EXAMPLES)), read_design_file, 200),
    "data": Kind(cases((*DATA, *EXAMPLES)), read_data_file, 200),
    "campaign": Kind(cases(("manifest", "block")), read_campaign, 150),
    "certificate": Kind(cases(("continuous", "sampled")), check_certificate, 180),
    "log": Kind(cases(("csv", "npz")), read_log_file, 100),
    "response": Kind(cases(("y", "S x1")), read_response_file, 40),
    "dump": Kind(cases(("dump",)), read_dump_file, 60),
    "run": Kind(cases(("run",)), read_run_file, 40),
    "rare": Kind(cases(("record", "repetition")), read_rare_event, 40),
    "export": Kind(cases(("linear",)), export_as_c, 20),
    "plot": Kind(cases(("linear",)), draw_figures, 20),
    "trials": Kind(cases(("trials",)), read_trials, 60),
    "shares": Kind(cases(("table2", "linear")), read_shares_of, 40),
    "lines": Kind(LINES, run_line, 90),
    "commands": Kind(cases(("table2", "halbach", "linear")), show_scenarios, 20),
    "names": Kind(NAMED, use_names, 25),
    "journal": Kind(cases(("day",)), read_day, 115),
}
