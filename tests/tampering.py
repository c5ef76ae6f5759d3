"""Certificates that were changed and sealed again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from flint import fmpq

from malta.checker import file as checked_file


def written(content: dict[str, Any], folder: Path, *, signed: bool = True) -> Path:
    """A changed certificate, with the digest of what it holds now."""
    if signed:
        content = content | {"sha256": checked_file.digest(content)}
    path = folder / "changed.json"
    path.write_text(json.dumps(content))
    return path


def claiming(content: dict[str, Any], lower: float) -> None:
    """Claim another margin, with the intervals that follow."""
    t, content["claim"]["lower"] = fmpq(*lower.as_integer_ratio()), lower
    for p in content["claim"]["parameters"]:
        middle, down, up, first, last = (
            fmpq(*float(x).as_integer_ratio()) for x in (p["nominal"], p["down"], p["up"], *p["over"])
        )
        p["interval"] = list(checked_file.inside(middle - t * down + first, middle + t * up + last))
