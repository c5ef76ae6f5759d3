"""Examples of Markdown pages: run them, and compare their outputs with what the page shows or write them anew.

    python docs/page_examples.py README.md docs/tutorial.md    # replaces the outputs that no longer agree

An example is a fenced block `console` (each line after `$ ` is run by bash) or `pycon` (lines after `>>> `). All blocks
of a page run in order, in one new folder, one shell and one namespace, 80 columns wide. A token `...` in a shown output
stands for anything. Numbers agree within TOLERANCE, since processors round differently and noise follows the rounding.
Of long outputs of a `console` block a comment above it names the tables that are shown, by words of their titles:

    <!-- only: Where the margin goes | Worst-case -->

A comment `<!-- drawn -->` is above a block whose numbers are of drawn noise that follows the rounding, as those of an
excitation whose phases are searched for: words are compared, and that numbers are where numbers are.
"""

from __future__ import annotations

import contextlib
import doctest
import io
import os
import re
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[1]  # shipped files are named as in a checkout
TOLERANCE = 0.05
ANYTHING = "..."
BLOCK = re.compile(
    r"(?P<head>^(?:<!-- only: (?P<only>.+?) -->\n\n?)?(?P<drawn><!-- drawn -->\n\n?)?```)"
    r"(?P<kind>console|pycon)\n(?P<text>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)
COMMAND = re.compile(r"^\$ ((?:.*\\\n)*.*)\n?", re.MULTILINE)
PROGRESS = re.compile(r"malta: .+: (.+, )?[\d.]+ (s|min|h|days)(,.+ left)?")  # a line of how far a command is
NUMBER = re.compile(r"[-+±]*\d[\d,]*\.?\d*(?:e[-+]?\d+)?")


class Example(NamedTuple):
    """What is typed, as the page shows it with its prompts, what the page shows below, and what came out."""

    typed: str
    shown: str
    found: str
    drawn: bool = False  # numbers are of drawn noise

    @property
    def agrees(self) -> bool:
        """Whether the page shows what came out."""
        shown, found = (_without_numbers(text) if self.drawn else text for text in (self.shown, self.found))
        return agrees(shown, found)


def _without_numbers(text: str) -> str:
    """A text with the same number everywhere."""
    return NUMBER.sub("1", text)


def without_progress(text: str) -> str:
    """What a command says on standard error, but for lines of how far it is: a loaded computer gets some."""
    return "".join(f"{line}\n" for line in text.splitlines() if not PROGRESS.fullmatch(line))


def agrees(shown: str, found: str) -> bool:
    """Whether two outputs have the same words, and numbers within TOLERANCE; `...` in the first matches anything."""
    parts: list[list[str]] = [[]]
    for token in _tokens(shown):
        if token == ANYTHING:
            parts.append([])
        else:
            parts[-1].append(token)
    tokens = _tokens(found)
    if len(parts) == 1:
        return _same(parts[0], tokens)
    first, *middle, last = parts
    if len(tokens) < len(first) + len(last) or not _same(first, tokens[: len(first)]):
        return False
    if last and not _same(last, tokens[-len(last) :]):
        return False
    at, end = len(first), len(tokens) - len(last)
    for part in middle:
        while at + len(part) <= end and not _same(part, tokens[at : at + len(part)]):
            at += 1
        if at + len(part) > end:
            return False
        at += len(part)
    return True


def _tokens(text: str) -> list[str]:
    """Words and numbers of an output, without the rules of tables, whose length follows the numbers."""
    return [token for token in text.split() if not set(token) <= set("─━-│|")]


def _same(one: Sequence[str], two: Sequence[str]) -> bool:
    return len(one) == len(two) and all(a == b or _close(a, b) for a, b in zip(one, two, strict=True))


def _close(one: str, two: str) -> bool:
    """Whether two tokens differ in their numbers alone, and these by little."""
    if NUMBER.sub("#", one) != NUMBER.sub("#", two):
        return False
    pairs = zip(NUMBER.findall(one), NUMBER.findall(two), strict=True)
    return all(
        abs(a - b) <= TOLERANCE * max(abs(a), abs(b)) for a, b in ((_value(a), _value(b)) for a, b in pairs)
    )


def _value(text: str) -> float:
    return float(text.replace(",", "").lstrip("±+-")) * (-1 if text.startswith("-") else 1)


def run_page(text: str) -> list[list[Example]]:
    """Run the examples of a page in a new folder; of each block its examples, in order."""
    before = Path.cwd()
    names: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryDirectory() as state:
        os.chdir(folder)
        try:
            return [
                [
                    example._replace(drawn=bool(block["drawn"]))
                    for example in run_console(block["text"], Path(state), (block["only"] or "").split(" | "))
                ]
                if block["kind"] == "console"
                else run_pycon(block["text"], names)
                for block in BLOCK.finditer(text)
            ]
        finally:
            os.chdir(before)


def run_console(block: str, state: Path, titles: Sequence[str] = ("",)) -> list[Example]:
    """Run the commands of a block; a command that fails shows its errors, others only their output.

    state : the folder that keeps the shell's variables from command to command
    titles : of the tables that are shown of each output; one empty title: all of it
    """
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", "")))
    environment = os.environ | {"COLUMNS": "80", "NO_COLOR": "1", "OPENBLAS_NUM_THREADS": "1", "PATH": path}
    variables, place = state / "variables", state / "place"
    commands, examples = list(COMMAND.finditer(block)), []
    for command, after in zip(commands, [*(c.start() for c in commands[1:]), len(block)], strict=True):
        keep = f"code=$?; export -p > {variables}; pwd > {place}; exit $code"
        script = f"[ -e {variables} ] && . {variables}\n{command[1]}\n{keep}"
        done = subprocess.run(
            ["bash", "-c", script],
            env=environment, capture_output=True, text=True, timeout=600, check=False,
        )  # fmt: skip
        os.chdir(place.read_text(encoding="utf-8").rstrip("\n"))
        found = (done.stdout + (without_progress(done.stderr) if done.returncode else "")).replace(
            f"{ROOT}/", ""
        )
        lines = [line.rstrip() for line in found.splitlines()]
        tidy = "\n".join(_only(lines, titles)).strip("\n")
        examples.append(Example(command[0].rstrip("\n"), block[command.end() : after].strip("\n"), tidy))
    return examples


def _only(lines: Sequence[str], titles: Sequence[str]) -> list[str]:
    """The tables with these titles: each from its title to the second empty line; all lines without a title."""
    if not any(titles):
        return list(lines)
    shown: list[str] = []
    for title in titles:
        first = next((k for k, line in enumerate(lines) if title in line), None)
        if first is None:
            continue
        empty = [k for k in range(first, len(lines)) if not lines[k]] + [len(lines)] * 2
        shown += [ANYTHING, *lines[first : empty[1]], *([ANYTHING] if empty[1] < len(lines) else [])]
    return [line for k, line in enumerate(shown) if k == 0 or (line, shown[k - 1]) != (ANYTHING, ANYTHING)]


def run_pycon(block: str, names: dict[str, Any]) -> list[Example]:
    """Run the statements of a block in a namespace; an error shows its last line, as in a session."""
    examples = []
    for part in doctest.DocTestParser().parse(block):
        if isinstance(part, str):
            continue
        out = io.StringIO()
        with contextlib.redirect_stdout(out):
            try:
                exec(compile(part.source, "<page>", "single"), names)
            except Exception as error:
                out.write("Traceback (most recent call last):\n  ...\n")
                out.write("".join(traceback.format_exception_only(error)))
        first, *rest = part.source.rstrip("\n").split("\n")
        typed = "\n".join((f">>> {first}", *(f"... {line}".rstrip() for line in rest)))
        found = "\n".join(line.rstrip() for line in out.getvalue().splitlines())
        examples.append(Example(typed, part.want.rstrip("\n"), found))
    return examples


def renew(text: str) -> str:
    """Put what comes out in place of outputs that no longer agree."""
    blocks = iter(run_page(text))

    def with_outputs(block: re.Match[str]) -> str:
        rows = []
        for example in next(blocks):
            output = example.shown if example.agrees else example.found
            rows += [example.typed, *([output] if output else [])]
        return f"{block['head']}{block['kind']}\n" + "\n".join(rows) + "\n```"

    return BLOCK.sub(with_outputs, text)


def main(names: Sequence[str]) -> None:
    """Renew the outputs of pages."""
    for name in names:
        page = Path(name)
        text = page.read_text(encoding="utf-8")
        page.write_text(renew(text), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
