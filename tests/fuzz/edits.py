"""Edits of tables and of bytes, as plain data: hypothesis draws, prints and shrinks them."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from hypothesis import strategies as st

ODD: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 3, 2**53 + 1, 10**400, 0.0, -0.0, 0.5, -2.5, 1e-300, 5e-324, 1e200, 1e308, -1e308,
    math.nan, math.inf, -math.inf, "", "x", "nan", "m", "kg m^2", "1e400", "../x", "x.py", "two\nlines", "\x00",
    "\x1b[2J", "γ\u202e", "\ud800", "w" * 3000, [], {}, [[]], [{}], [0.0] * 3, [[1.0, 2.0], [3.0]],
    {"value": 1.0, "unit": "m"},
    "$x_{1}$", "$", "a\\b", "\\frac{", "50%", "%s", "{x}", "*/", "??/", '"', "\t", "\x7f", "\u2028",
    {"published": "table_II.state"}, {"published": 3}, list(range(200)),
)  # fmt: skip
NAMES = (
    "x", "", "a b", "a.b", "γ", "two\nlines", "__class__", "w" * 300, "$", "$x_{1}$", "a\\b", "\\frac{", "50%", "%s",
    "{", "{x}", "}", "*/", "??/", '"', "'", "\t", "\x00", "\x1b[2J", "\x7f", "[red]x[/]",
)  # fmt: skip


class Edit(NamedTuple):
    """One change of a tree: `what` is done to the entry that `at` leads to, a number for each table on the way."""

    what: str
    at: tuple[int, ...]
    value: Any = None


class Cut(NamedTuple):
    """One change of bytes, at a share of their length."""

    what: str
    at: float
    value: int = 0


_PLACES = st.lists(st.integers(0, 40), min_size=1, max_size=5).map(tuple)
_FACTORS = st.sampled_from((-1.0, 0.0, 0.5, 1.0 + 1e-9, 2.0, 1e-30, 1e6, 1e30, 1e160))
_VALUES = (
    st.sampled_from(ODD)
    | st.floats()
    | st.integers(-3, 300)
    | st.text(st.characters(codec="utf-8"), max_size=8)
)
EDITS = st.one_of(
    st.builds(Edit, st.just("set"), _PLACES, _VALUES),
    st.builds(Edit, st.just("scale"), _PLACES, _FACTORS),
    st.builds(Edit, st.sampled_from(("delete", "empty", "wrap", "reverse")), _PLACES, st.none()),
    st.builds(Edit, st.sampled_from(("rename", "copy")), _PLACES, st.sampled_from(NAMES)),
    st.builds(Edit, st.sampled_from(("repeat", "nest")), _PLACES, st.sampled_from((2, 3, 60, 1500))),
    st.builds(Edit, st.just("swap"), _PLACES, _PLACES),
)
CUTS = st.builds(
    Cut,
    st.sampled_from(("truncate", "flip", "insert", "delete", "repeat", "number", "digit")),
    st.floats(0, 1, exclude_max=True),
    st.integers(0, 255),
)


def edited(tree: Any, edits: Sequence[Edit]) -> Any:
    """A copy of a tree with these edits."""
    holder = {"": copy.deepcopy(tree)}
    for edit in edits:
        table, key = _place(holder, (0, *edit.at))
        if key is not None:
            _CHANGES[edit.what](table, key, edit.value, holder)
    return holder[""]


def _place(holder: Any, at: Sequence[int]) -> tuple[Any, Any]:
    """The table or list, and the key in it, that some numbers lead to; no key for an empty one."""
    table, key, node = None, None, holder
    for number in at:
        keys = list(node) if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()
        if not len(keys):
            break
        table, key = node, keys[number % len(keys)]
        node = table[key]
    return table, key


def _set(table: Any, key: Any, value: Any, _: Any) -> None:
    table[key] = copy.deepcopy(value)


def _scale(table: Any, key: Any, value: Any, _: Any) -> None:
    """Multiply a number, or all numbers of a list."""

    def scaled(node: Any) -> Any:
        if isinstance(node, list):
            return [scaled(entry) for entry in node]
        number = isinstance(node, int | float) and not isinstance(node, bool)
        return node * value if number and abs(node) < 1e300 else node

    table[key] = scaled(table[key])


def _delete(table: Any, key: Any, _: Any, __: Any) -> None:
    del table[key]


def _empty(table: Any, key: Any, _: Any, __: Any) -> None:
    table[key] = type(table[key])() if isinstance(table[key], dict | list | str) else None


def _wrap(table: Any, key: Any, _: Any, __: Any) -> None:
    table[key] = [table[key]]


def _reverse(table: Any, key: Any, _: Any, __: Any) -> None:
    if isinstance(table[key], list):
        table[key] = table[key][::-1]


def _rename(table: Any, key: Any, value: Any, _: Any) -> None:
    if isinstance(table, dict):
        table[value] = table.pop(key)


def _copy(table: Any, key: Any, value: Any, _: Any) -> None:
    if isinstance(table, dict):
        table[value] = copy.deepcopy(table[key])
    else:
        table.insert(key, copy.deepcopy(table[key]))


def _repeat(table: Any, key: Any, value: Any, _: Any) -> None:
    if isinstance(table[key], list | str) and len(table[key]) * value < 50_000:
        table[key] = table[key] * value


def _nest(table: Any, key: Any, value: Any, _: Any) -> None:
    node = table[key]
    for _depth in range(min(value, 200)):
        node = {"x": node} if value % 2 else [node]
    table[key] = node


def _swap(table: Any, key: Any, value: Any, holder: Any) -> None:
    other, place = _place(holder, (0, *value))
    if place is not None:
        one, two = copy.deepcopy(table[key]), copy.deepcopy(other[place])
        table[key], other[place] = two, one


_CHANGES: dict[str, Callable[[Any, Any, Any, Any], None]] = {
    "set": _set, "scale": _scale, "delete": _delete, "empty": _empty, "wrap": _wrap, "reverse": _reverse,
    "rename": _rename, "copy": _copy, "repeat": _repeat, "nest": _nest, "swap": _swap,
}  # fmt: skip


def cut(data: bytes, cuts: Sequence[Cut]) -> bytes:
    """Bytes with these changes."""
    for what, share, value in cuts:
        at = int(share * len(data))
        if what == "truncate":
            data = data[:at]
        elif what == "flip" and data:
            data = data[:at] + bytes([data[at] ^ (1 << value % 8)]) + data[at + 1 :]
        elif what == "insert":
            data = data[:at] + bytes([value]) * (1 + value % 9) + data[at:]
        elif what == "delete":
            data = data[:at] + data[at + 1 + value :]
        elif what == "repeat":
            data = data[: at + value] + data[at:]
        elif what == "number":  # a size or an offset of four bytes
            number = (0, 1, 0xFFFFFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFF, value)[value % 7]
            data = data[:at] + number.to_bytes(4, "little") + data[at + 4 :]
        elif what == "digit":
            data = data[:at] + f"{value}".encode() + data[at + 1 :]
    return data
