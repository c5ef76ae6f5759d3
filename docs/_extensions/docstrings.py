"""Docstrings of malta as reStructuredText.

A docstring is plain text: paragraphs, entries "name : meaning", indented equations, and examples that begin with >>>.
Names in single backticks are code, and a link where they are public names of malta.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from itertools import groupby

ENTRY = re.compile(r"(?P<names>\*{0,2}[A-Za-z_]\w*(?:, [A-Za-z_]\w*)*) : (?P<text>.+)")
CODE = re.compile(r"(?<![`\w])`([^`\n]+)`(?!`)")


def to_rest(lines: Iterable[str], public: Iterable[str]) -> list[str]:
    """Convert the lines of a docstring; links are made to names that are public."""
    known = frozenset(public)
    found: list[str] = []
    for block in _blocks(lines):
        found += [*_convert(block, known), ""]
    return found


def _blocks(lines: Iterable[str]) -> Iterator[list[str]]:
    """Groups of lines with an empty line between each two; entries and examples begin a group of their own."""
    for empty, group in groupby((line.rstrip() for line in lines), key=lambda line: not line.strip()):
        if empty:
            continue
        block: list[str] = []
        kind = None
        for line in group:
            now = _kind(line, kind)
            if block and now != kind:
                yield block
                block = []
            block.append(line)
            kind = now
        yield block


def _kind(line: str, before: str | None) -> str:
    """What a line belongs to: an example, entries, an equation or text."""
    if line.startswith(">>>") or before == "example":
        return "example"
    if ENTRY.match(line) or (before == "entries" and line.startswith("    ")):
        return "entries"
    return "equation" if line.startswith("    ") else "text"


def _convert(block: list[str], known: frozenset[str]) -> list[str]:
    kind = _kind(block[0], None)
    if kind == "example":
        return block
    if kind == "equation":
        return [".. code-block:: none", "", *block]
    if kind == "entries":
        return [_field(line, known) for line in block]
    if len(block) == 2 and set(block[1]) == {"-"}:  # the underlined word above entries
        return []
    return [text for line in _join_lines(block) for text in [_mark_names(line, known)]]


def _join_lines(block: list[str]) -> list[str]:
    """Lines of a paragraph, so that code in backticks does not end with its line."""
    return [" ".join(line.strip() for line in block)]


def _field(line: str, known: frozenset[str]) -> str:
    entry = ENTRY.match(line)
    if entry is None:
        return _mark_names(line, known)
    names = _escape(entry["names"].replace(" ", ""))  # what follows a space would be a type
    return f":param {names}: {_mark_names(entry['text'], known)}"


def _mark_names(text: str, known: frozenset[str]) -> str:
    """Text with its code marked and its other characters taken as they are."""
    parts = CODE.split(text)
    return "".join(_link(part, known) if k % 2 else _escape(part) for k, part in enumerate(parts))


def _escape(text: str) -> str:
    return re.sub(r"([\\*|_`])", r"\\\1", text)


def _link(code: str, known: frozenset[str]) -> str:
    name = code if code.startswith("malta.") else f"malta.{code}"
    if name in known:
        return rf":py:obj:`{code} <{name}>`\ "
    return rf"``{code}``\ "
