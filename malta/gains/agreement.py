"""Comparison of gain files with a design: a file whose numbers agree need not be written again.

Another processor or another patch version of a library changes last digits. A file that differs only in them, or in its
provenance, is left as it is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.errors import InputError
from malta.gains.file import content_of, document

if TYPE_CHECKING:
    from malta.margins.loop_report import LoopReport
    from malta.synthesis.controller import Controller

CLOSE = 1e-9  # of the largest number in the same array
CLOSE_VERIFIED = 1e-6  # of poles and bandwidths, which magnify what moves a matrix
NARROWER = 1.01  # largest ratio by which the new bounds of a margin may be tighter
APART = {"provenance", "sha256", "verification"}  # tables that are not compared with CLOSE


def agrees(controller: Controller, margins: LoopReport, *paths: str | Path) -> bool:
    """Compare gain files with a controller and its margins: files whose numbers agree need not be written again.

    Each array has to agree to 1e-9 of its largest entry, poles and bandwidths to 1e-6. The bounds of the margin must
    not contradict those in the file, nor be narrower by more than 1 %: a slower computer proves less in the same time.

    controller : the controller
    margins : its margins, from `malta.verify`
    paths : the gain files

    Returns True where all files exist, are sound, and hold this controller.

    Raises CheckError when the loop is not stable, as `malta.gains.document` does.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> model = malta.linearize(spec.plant, spec.plant.at())
    >>> controller = malta.synthesize(spec, model)
    >>> margins = malta.verify(model, controller, spec.uncertainty)
    >>> malta.gains.write(controller, margins, "build/ball.json")
    >>> malta.gains.agrees(controller, margins, "build/ball.json")
    True
    """
    wanted = document(controller, margins)
    with suppress(InputError):
        return all(_agree(wanted, content_of(Path(path))[1]) for path in paths)
    return False


def _agree(wanted: Mapping[str, Any], found: dict[str, Any]) -> bool:
    """Whether two documents hold the same controller and margins that do not contradict each other."""
    if set(wanted) != set(found) or not all(
        _close(wanted[key], found[key], CLOSE) for key in set(wanted) - APART
    ):
        return False
    verified, before = (dict(content["verification"]) for content in (wanted, found))
    robust, earlier = verified.pop("robust"), before.pop("robust")
    poles, others = verified.pop("poles"), before.pop("poles")
    return (
        _close(verified, before, CLOSE_VERIFIED)
        and all(_same_poles(poles[name], others[name]) for name in poles)
        and _hardly_narrower(robust, earlier)
    )


def _same_poles(one: Any, two: Any) -> bool:
    """Whether two lists of poles agree in any order: rounding orders neighbours, and signs of +-j pi / Ts, anew."""
    if not one or not two or len(one) != len(two):
        return bool(one == two)
    first, second = (np.array(rows)[:, 0] + 1j * np.abs(np.array(rows)[:, 1]) for rows in (one, two))
    room, left = CLOSE_VERIFIED * np.abs(first).max(), second.tolist()
    for pole in first.tolist():  # each takes the nearest that is left
        nearest = min(left, key=lambda other: abs(other - pole))
        if abs(nearest - pole) > room:
            return False
        left.remove(nearest)
    return True


def _hardly_narrower(now: Mapping[str, Any] | None, before: Mapping[str, Any] | None) -> bool:
    """Whether the bounds of a margin agree with earlier ones and are at most NARROWER times as tight."""
    if now is None or before is None or now["uncertainty"] != before["uncertainty"]:
        return now == before
    lower, upper = _bounds(now)
    lowest, highest = _bounds(before)
    room = 1 + CLOSE_VERIFIED
    agree = lower <= highest * room and lowest <= upper * room
    return agree and lower <= lowest * NARROWER and upper >= highest / NARROWER


def _bounds(robust: Mapping[str, Any]) -> tuple[float, float]:
    """Lower and upper bound; 0 and infinity where the file has null."""
    lower, upper = robust["lower"], robust["upper"]
    return 0.0 if lower is None else lower, math.inf if upper is None else upper


def _close(a: Any, b: Any, share: float) -> bool:
    """Whether two plain values agree: tables by their keys, arrays within a share of their largest entry."""
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return set(a) == set(b) and all(_close(a[key], b[key], share) for key in a)
    try:
        first, second = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    except (TypeError, ValueError):  # words, signals, nothing
        if isinstance(a, list) and isinstance(b, list):
            return len(a) == len(b) and all(_close(x, y, share) for x, y in zip(a, b, strict=True))
        return bool(a == b)
    if first.shape != second.shape or isinstance(a, str) or isinstance(b, str) or (a is None) != (b is None):
        return bool(a == b)
    if not first.size or a is None:
        return True
    return bool(np.abs(first - second).max() <= share * np.abs(first).max())
