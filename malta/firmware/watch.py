"""Which monitor watches in which state of the supervisor, and why others do not: no cell of the table is empty."""

from __future__ import annotations

from typing import TYPE_CHECKING

from malta.firmware.supervisor import AWAKE, STATES, State, monitors_of

if TYPE_CHECKING:
    from malta.firmware.signals import Target

GROUND: tuple[State, ...] = ("OFFSETS", "SENSORS")
OTHERS = {key: tuple(state for state in AWAKE if state != key) for key in AWAKE}

# (monitors, states, why they cannot hurt or do not count there); OFF and FAULT have their gates off
UNWATCHED: tuple[tuple[tuple[str, ...], tuple[State, ...], str], ...] = (
    (("TOUCH",), GROUND, "the machine rests on its bearing"),
    (("TOUCH",), ("LIFT", "LANDING"), "the machine leaves its bearing, or goes to it"),
    (("RANGE", "STUCK", "STALE", "NAN"), ("OFFSETS",), "positions are not used yet"),
    (("RATE",), GROUND, "the first readings come from anywhere, and nothing moves"),
    (("INNOVATION", "UNBELIEVED", "BLIND", "ASTRAY"), GROUND, "the filter does not run"),
    (("INNOVATION",), ("LIFT", "SETTLE", "LANDING"), "a bearing pushes; ASTRAY and UNSETTLED watch"),
    (("HELPLESS", "SATURATION"), GROUND, "no force acts"),
    (("SATURATION",), ("LIFT",), "lift-off ends after its time, and SETTLE watches"),
    (("SATURATION", "LINK"), ("LANDING",), "it lands already; HELPLESS watches"),
    (("MISSED", "OVERRUN"), GROUND, "nothing moves"),
    (("OFFSET",), OTHERS["OFFSETS"], "offsets are known, and subtracted"),
    (("CURRENT_SUM", "CURRENT_EXCESS"), ("OFFSETS",), "offsets are not known; OFFSET and CURRENT watch"),
    (("CURRENT_ERROR",), GROUND, "nothing is commanded; OFFSET, CURRENT and CURRENT_EXCESS watch"),
    (("CURRENT_FROZEN",), GROUND, "nothing is commanded"),
    (("REFERENCE",), (*GROUND, "LIFT", "LANDING"), "requests are not followed"),
    (("REFERENCE",), ("SETTLE",), "it waits until the request is within its limits"),
    (("UNSETTLED",), OTHERS["SETTLE"], "nothing is waited for"),
    (("UNREADY",), OTHERS["SENSORS"], "nothing is waited for"),
)


def watch_table(t: Target) -> dict[str, dict[State, str]]:
    """The reactions of each monitor in each state, as "hold, land", or in brackets why it does not count there.

    watch_table(Target(malta.gains.read("design/gains/robust.json")))["LINK"]["LIFT"]
    """
    table: dict[str, dict[State, str]] = {}
    for row in monitors_of(t):
        cells = table.setdefault(row.key, dict.fromkeys(STATES, ""))
        for state in row.states:
            cells[state] = ", ".join(filter(None, [cells[state], row.reaction.lower()]))
    for key, cells in table.items():
        for state in STATES:
            if state not in AWAKE:
                cells[state] = "(gates are off)"
        for keys, states, reason in UNWATCHED:
            for state in states if key in keys else ():
                cells[state] = cells[state] or f"({reason})"
    return table


def watch_lines(t: Target) -> list[str]:
    """The table in Markdown: monitors down, the states that are not off across; reasons are numbered below it."""
    reasons: list[str] = []
    lines = [
        "| monitor | " + " | ".join(state.lower() for state in AWAKE) + " |",
        "|---" * (1 + len(AWAKE)) + "|",
    ]
    for key, cells in watch_table(t).items():
        shown = []
        for state in AWAKE:
            text = cells[state]
            if text.startswith("("):
                if text not in reasons:
                    reasons.append(text)
                text = f"({reasons.index(text) + 1})"
            shown.append(text)
        lines.append(f"| `{key.lower()}` | " + " | ".join(shown) + " |")
    return [*lines, "", *(f"{k}. {reason.strip('()')}" for k, reason in enumerate(reasons, 1))]
