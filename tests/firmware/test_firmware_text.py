"""The exported C reads as the law: one function an equation, results by their names, nothing too long to review."""

from __future__ import annotations

import re
from functools import cache
from typing import NamedTuple

import pytest
from conftest import ROOT
from exported import target

from malta.firmware.ctext import c_name
from malta.firmware.signals import Target
from malta.firmware.sources import MOST_PARAMETERS, sources

LINES = 150  # of a function
LONGER = {
    "init",
    "decide_sums",
    "currents_sums",
}  # a table of v0(z); 22 harmonics of the planar motor's coils, in a loop
NAMES = [
    "halbach",
    *(
        pytest.param(name, marks=pytest.mark.slow)
        for name in ("robust", "tubular_pid", "halbach_late", "planar")
    ),
]
HEAD = re.compile(r"^(?:static )?(?:\w+_APART )?(?:void|int32_t|\w+_real) (\w+)\(([^;{]*)\) \{", re.MULTILINE)
NUMBERED = re.compile(r"\bt\d+\b")


class Function(NamedTuple):
    """A function of the text."""

    name: str
    before: str  # the line above
    parameters: str
    text: str


@cache
def files(t: Target) -> dict[str, str]:
    """The controller's files by how their names end."""
    name = c_name(t.controller.name)
    return {file.removeprefix(name): text for file, text in sources(t, "0" * 64).items()}


def functions(text: str) -> list[Function]:
    """All functions of a file."""
    found = []
    for head in HEAD.finditer(text):
        end = len(text) if head[0].endswith("}") else text.index("\n}\n", head.start()) + 3
        if text[head.end() : head.end() + 1] != "\n":  # a whole function in a line
            end = text.index("\n", head.start())
        above = text[: head.start()].rstrip("\n").rpartition("\n")[2]
        found.append(Function(head[1], above, head[2], text[head.start() : end]))
    return found


@pytest.mark.parametrize("name", NAMES)
def test_functions_are_of_a_size_to_review(name: str) -> None:
    """Lines and parameters, in both files."""
    t = target(name, "float")
    prefix = c_name(name) + "_"
    for end in (".c", "_parts.c"):
        found = functions(files(t)[end])
        assert len(found) > 10
        for f in found:
            assert f.text.count("\n") <= LINES or f.name.removeprefix(prefix) in LONGER, f.name
            assert len(f.parameters.split(",")) <= MOST_PARAMETERS, f.name


@pytest.mark.parametrize("name", NAMES)
def test_numbers_are_names_in_a_block_alone(name: str) -> None:
    """A numbered result is declared where it is used, once, and in no record nor parameter."""
    t = target(name, "float")
    for end in (".c", "_parts.c"):
        rest = files(t)[end]
        for f in functions(rest):
            used = set(NUMBERED.findall(f.text))
            declared = re.findall(r"const (?:bool|\w+_real) (t\d+) =", f.text)
            assert used == set(declared), f.name
            assert len(declared) == len(used), f.name
            assert not NUMBERED.search(f.parameters)
            rest = rest.replace(f.text, "")
        assert not NUMBERED.search(rest)
    assert not NUMBERED.search(files(t)[".h"])


@pytest.mark.parametrize("name", NAMES)
def test_every_block_says_its_equation(name: str) -> None:
    """The comment above a block names what it gives."""
    t = target(name, "float")
    prefix = c_name(name)
    blocks = [f for f in functions(files(t)[".c"]) if re.match(rf"{prefix}_(sense|decide|state_at)_", f.name)]
    assert len(blocks) > 12
    for f in blocks:
        assert f.before.endswith("*/"), f.name
        above = files(t)[".c"].partition(f.text)[0]
        comment = above[above.rindex("/*") :]
        given = set(re.findall(r"(?:s|out|mid)->(\w+)\[[^\]]*\] = ", f.text))
        named = {word for word in given if re.search(rf"\b{re.sub('_(rest|next)$', '', word)}\b", comment)}
        assert named or "all others" in comment, (f.name, comment, given)


@pytest.mark.parametrize("name", NAMES)
def test_every_name_is_documented(name: str) -> None:
    """What blocks hand on stands in the header or on the page of gain files; parts of a long block hand on values."""
    t = target(name, "float")
    page = (ROOT / "docs" / "formats" / "gain.md").read_text(encoding="utf-8")
    known = set(re.findall(r"`(\w+)`", page)) | set(re.findall(r"_real (\w+)\[", files(t)[".h"]))
    for end in (".c", "_parts.c"):
        records = re.findall(r"typedef struct \{\n(.*?)\} \w+_values;", files(t)[end], re.DOTALL)
        members = {member for record in records for member in re.findall(r"_real (\w+)\[", record)}
        unnamed = {member for member in members if member.endswith("_parts")}
        assert members - unnamed <= known
        assert len(unnamed) <= 1


def test_the_top_of_a_step_reads_as_the_law() -> None:
    """In the order of the page of gain files."""
    text = files(target("halbach", "double"))[".c"]
    whole = next(f.text for f in functions(text) if f.name == "halbach_decide")
    steps = re.findall(r"halbach_decide_(\w+)\(", whole)
    order = [
        "estimate",
        "sum_errors",
        "law",
        "limit_forces",
        "predict",
        "currents",
        "limit_currents",
        "set_points",
    ]
    assert [step for step in steps if step in order] == order


@pytest.mark.slow
def test_the_coils_are_loops_over_tables() -> None:
    """One text for sixteen coils, four rows of them, ten decays; written out they are as many operations."""
    t = target("planar", "float")
    loops, written_out = (sources(t, "0" * 64, loops=loops)["planar.c"] for loops in (True, False))
    assert len(re.findall(r"^static PLANAR_APART void", loops, re.MULTILINE)) == 6
    assert "PLANAR_APART" not in written_out
    assert loops.count("\n") < 0.65 * written_out.count("\n")
