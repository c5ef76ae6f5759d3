"""Tables of logs, excitations, identified parameters and replays."""

from __future__ import annotations

from typing import TYPE_CHECKING

from malta.identification.response import units_of_model
from malta.report.tables.parts import add_row, new_table

if TYPE_CHECKING:
    from rich.table import Table

    from malta.identification.excite import ExcitationPlan
    from malta.identification.identify import Identified
    from malta.identification.log import Log
    from malta.identification.replay import LawReplay
    from malta.model.plant import Plant


def log_table(log: Log) -> Table:
    """Statistics of the columns of a log; a column that never changes has one number."""
    table = new_table("Signals", "signal", "least", "mean", "largest", "deviation")
    for heading, (least, mean, largest, deviation) in log.survey.statistics.items():
        if not heading.startswith("flag."):
            add_row(table, heading, *(f"{value:.4g}" for value in (least, mean, largest, deviation)))
    return table


def excitation_tables(plan: ExcitationPlan, plant: Plant) -> list[Table]:
    """What moves how far, what current flows, and what will be found how well."""
    moved = new_table("What it does, by the linear loop", "signal", "largest", "of its limit")
    for signal in plant.outputs:
        scale, unit = (1e6, f"u{signal.unit}") if signal.unit in ("m", "rad") else (1.0, signal.unit)
        add_row(moved, f"{signal.name} [{unit}]", f"{scale * plan.motion[signal.name]:.4g}", "")
    for signal, limit in zip(plant.inputs, plant.actuator.force_limit, strict=True):
        share = plan.command[signal.name]
        add_row(moved, f"{signal.name} [{signal.unit}]", f"{share * limit:.4g}", f"{100 * share:.3g} %")
    most = max(plan.current.values())
    for name, value in plan.current.items():
        if value > 1e-6 * most:
            share = value / plant.actuator.current_limit
            add_row(moved, f"{name} beside that at rest [A]", f"{value:.4g}", f"{100 * share:.3g} %")
    told = new_table("What its log will tell", "parameter", "half of the 95 % interval [%]")
    for name, share in plan.accuracy.items():
        add_row(told, name, f"{100 * share:.2g}")
    return [moved, told]


def identified_table(found: Identified) -> Table:
    """The identified parameters with their 95 % intervals."""
    table = new_table("Identified", "parameter", "value", "95 % interval", "half [%]", "gain file")
    units = units_of_model(found.plant)
    for name, value, half, start in zip(
        found.names, found.values.tolist(), found.half_widths.tolist(), found.start.tolist(), strict=True
    ):
        unit = "" if units[name] == "1" else f" [{units[name]}]"
        share = f"{100 * half / abs(value):.2g}" if value else "-"
        ends = f"{value - half:.6g} .. {value + half:.6g}"
        add_row(table, f"{name}{unit}", f"{value:.5g}", ends, share, f"{start:.5g}")
    return table


def quality_table(found: Identified) -> Table:
    """How well the model explains the log."""
    table = new_table("How well the model explains the log", "figure", "found", "if it is right")
    add_row(table, f"chi2 / dof, {found.dof} degrees", f"{found.chi2:.3g}", f"1, at most {found.limit:.3g}")
    for name, value in found.by_output.items():
        add_row(table, f"of {name}", f"{value:.3g}", "1")
    add_row(table, "correlation of neighbouring lines [sigma]", f"{found.whiteness:.2g}", "-2 .. 2")
    add_row(table, "power where nothing was excited", f"{found.distortion:.3g}", "1")
    return table


def replay_table(found: LawReplay, plant: Plant) -> Table:
    """Commands and innovations of a law on a log."""
    table = new_table("The law on the log", "signal", "from the start", "second half", "sensor", "whiteness")
    for signal in plant.inputs:
        off = f"{found.at_once[signal.name]:.2g}", f"{found.difference[signal.name]:.2g}"
        add_row(table, f"{signal.name} differs by [{signal.unit}]", *off, "", "")
    for signal in plant.outputs:
        name = signal.name
        cells = f"{found.rms[name]:.3g}", f"{found.expected[name]:.3g}", f"{found.whiteness[name]:.2g}"
        add_row(table, f"innovation of {name}, rms [{signal.unit}]", "", *cells)
    return table
