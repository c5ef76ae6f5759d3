"""What `--controller c` adds to `malta simulate`: the exported C flies, beside the simulation's law and in float."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from malta.errors import InputError

if TYPE_CHECKING:
    from malta.firmware.elementary import Precision
    from malta.firmware.flight import Difference
    from malta.simulation.experiments import Experiment

CONTROLLERS = ("own", "c")


def require_controller(name: str, engine: str) -> None:
    """InputError for an unknown controller, and for an engine beside the C, which has its own."""
    if name not in CONTROLLERS:
        raise InputError("--controller", "", repr(name), "own, or c")
    if name == "c" and engine != "auto":
        raise InputError("--engine", "", f"{engine} beside --controller c", "one of the two")


def compare_flights(
    fly: Callable[[Any], Experiment], flown: Experiment
) -> dict[str, dict[Precision, list[Difference]]]:
    """The differences of the C's flights to those of the simulation's law, by case and precision.

    fly : makes the experiment with an engine; flown : that of the C in double precision
    """
    from malta.firmware.flight import differences, engine_of_c

    own, single = fly("auto"), fly(engine_of_c("float"))
    found: dict[str, dict[Precision, list[Difference]]] = {}
    for case, c, f in zip(own.cases, flown.cases, single.cases, strict=True):
        found[case.label] = {"double": differences(case.run, c.run), "float": differences(case.run, f.run)}
    return found


def comparison_table(title: str, found: dict[Precision, list[Difference]]) -> Any:
    """A table of the largest difference of each signal, as a share of its range."""
    from malta.report.tables.parts import add_row, new_table

    table = new_table(title, "signal", "largest", "C, double", "C, float")
    for double, single in zip(found["double"], found["float"], strict=True):
        add_row(table, double.name, f"{double.range:.3g}", f"{double.share:.1e}", f"{single.share:.1e}")
    return table


def titles(labels: Sequence[str]) -> list[str]:
    """A title for the table of each case."""
    text = "The exported C against the simulation's law: largest difference / range"
    return [text if len(labels) == 1 else f"{text}: {label}" for label in labels]
