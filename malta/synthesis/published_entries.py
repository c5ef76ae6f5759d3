"""References of a design file to published figures: `{ published = "table_II.state" }` -> the numbers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from malta.errors import InputError


def with_published(
    node: Any, printed: Callable[[], dict[str, Any]], machine_file: Path, where: Path, field: str = ""
) -> Any:
    """Put the published numbers in the place of every `{ published = "..." }`.

    node : a table of the file, or what is in it
    printed : gives the published figures
    machine_file : the machine's data file, beside which they stand
    where, field : the file and the key that an error names

    Raises InputError for an unknown name, and for an entry that is no number, no quantity and no table of them.
    """
    if isinstance(node, dict):
        if set(node) == {"published"}:
            found: Any = printed()
            for key in str(node["published"]).split("."):
                if not isinstance(found, dict) or key not in found:
                    source = machine_file.parent / "published" / machine_file.name
                    raise InputError(where, field, repr(node["published"]), f"a table of {source}")
                found = found[key]
            if not _is_numeric(found):
                expected = "the name of a number, a quantity or a table of them"
                raise InputError(where, field, repr(node["published"]), expected)
            return found
        return {
            k: with_published(v, printed, machine_file, where, f"{field}.{k}".lstrip("."))
            for k, v in node.items()
        }
    return node


def _is_numeric(found: Any) -> bool:
    """Whether a published entry is a number, a quantity, or a table of them."""

    def is_number(value: Any) -> bool:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        return number or (isinstance(value, dict) and "value" in value)

    return is_number(found) or (isinstance(found, dict) and all(map(is_number, found.values())))
