"""Results of the benchmarks as a page of the documentation: a section for each workload, with machine and date."""

from __future__ import annotations

import datetime
import math
import os
import platform
import re
from collections.abc import Iterable, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from timing import Result

HEAD = "| malta | | what else a user would pick | | ratio | wanted |\n|---|--:|---|--:|--:|---|"
PEERS = ("casadi", "control", "numpy", "numba", "jax")


def update_page(
    page: Path, found: Mapping[str, tuple[str, list[Result]]], order: Iterable[str], runs: int
) -> None:
    """Replace the sections of some workloads in a page; what else stands in it stays.

    found : for each workload its description and its rows
    order : of all workloads, in which the sections stand
    """
    preface, *rest = re.split(r"^## ", page.read_text(encoding="utf-8"), flags=re.M)
    sections = {text.split("\n")[0].strip(): text for text in rest}
    for name, (description, rows) in found.items():
        sections[name] = _section(name, description, rows, runs)
    known = [name for name in order if name in sections]
    text = preface.rstrip() + "".join(f"\n\n## {sections[name].strip()}" for name in known)
    page.write_text(text + "\n", encoding="utf-8")


def _section(name: str, description: str, rows: Iterable[Result], runs: int) -> str:
    lines = [name, "", description, "", HEAD]
    for row in rows:
        sizes = [_size(value, row.unit) for value in (row.ours, row.theirs)]
        ratio = _digits(row.theirs / row.ours)
        cells = [row.workload, sizes[0], row.peer, sizes[1], ratio, row.wanted]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join([*lines, "", f"{_computer()}; medians of {runs} runs in turn."])


def _size(value: float, unit: str) -> str:
    """A time in a unit in which its digits are before the point, or a count; nothing for NaN."""
    if unit != "s" or math.isnan(value):
        return _digits(value)
    for name, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if value >= size:
            return f"{_digits(value / size)} {name}"
    return f"{_digits(value / 1e-9)} ns"


def _digits(value: float) -> str:
    """Three digits, without an exponent; nothing for NaN."""
    if math.isnan(value):
        return ""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def _computer() -> str:
    """When and on what the figures were measured."""
    cores = os.cpu_count()
    peers = [f"{name} {_version(name)}" for name in PEERS if _version(name)]
    where = f"{_processor()}, {cores} cores, {platform.system()}, Python {platform.python_version()}"
    return f"Measured on {datetime.date.today().isoformat()}: {where}, {', '.join(peers)}"


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return ""


def _processor() -> str:
    """The name of the processor, from Linux' list where there is one."""
    listed = Path("/proc/cpuinfo")
    names = re.findall(r"^model name\s*:\s*(.+)$", listed.read_text(), re.M) if listed.exists() else []
    return names[0] if names else platform.processor() or platform.machine()
