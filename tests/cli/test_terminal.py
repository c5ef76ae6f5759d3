"""What a terminal shows: one word for one argument in every help, and colours that carry a verdict."""

from __future__ import annotations

import io
import os
import pty
import re
import subprocess
import sys
from typing import Any

import pytest
from rich.console import Console

import malta
from malta.cli.main import Commands
from malta.margins.outcome import Outcome
from malta.report.ledger import Ledger, LedgerClaim
from malta.report.tables import COLOURS, end_cell

FILES = {
    "GAINS": "gain file",
    "DESIGN": "design file",
    "LOG": "log|what a bench would log",
    "DATA": "data file",
    "RUN": "simulate --out",
    "CERTIFICATE": "certificate|proof",
    "MODULE": "module",
    "FILE": "",
    "FOLDER": "",
    "FILE|FOLDER": "",
    "FOLDER:RUN": "",
}
WORDS = {
    *("NAME", "NAME=VALUE", "KIND", "SCENARIO", "WORD", "LIMIT", "ADDRESS", "PORT", "ADDRESS:PORT"),
    *("COLUMN", "NAME=COLUMN", "SPAN"),  # of logs of other programs, and parts of logs
    *("N", "SECONDS", "QUANTITY", "SHARE", "SHARE|NAME=SHARE", "LOW..HIGH"),
}
# Files of many kinds; a log or a time; of a serial line or of a page; a column of a log or what work may take.
SEVERAL = "--out", "--log", "--port", "--time"
COLOURED = re.compile(r"\x1b\[(?:\d+;)*3[1-7]m")
TOLD = "malta", "verify", "design/gains/halbach.json", "--no-proof"


def placeholders(name: str) -> list[tuple[str, str, str]]:
    """Of a command's arguments and options that take a value: name, placeholder, help."""
    taking = [
        one for one in Commands()[name].params if not getattr(one, "is_flag", False) and one.name != "help"
    ]
    return [(one.opts[0], str(one.metavar).strip("[]."), str(one.help)) for one in taking]


@pytest.mark.parametrize("name", [*Commands()])
def test_a_value_has_one_of_the_words_that_all_helps_have(name: str) -> None:
    for option, word, text in placeholders(name):
        assert word in {*FILES, *WORDS}, f"malta {name} {option}"
        assert re.search(FILES.get(word, ""), text, re.I), f"malta {name} {option} {word}: {text}"
        told = [
            other for other, kind in FILES.items() if kind and re.match(rf"(a |the )?({kind})\b", text, re.I)
        ]
        assert not told or word in told, f"malta {name} {option} {word}: {text}"


def test_an_option_has_the_same_word_in_every_command() -> None:
    words: dict[str, set[str]] = {}
    for name in Commands():
        for option, word, _ in placeholders(name):
            if option.startswith("--") and option not in SEVERAL:
                words.setdefault(option, set()).add(word)
    assert {option: found for option, found in words.items() if len(found) > 1} == {}


def printed(what: Any, **options: Any) -> str:
    """What a console prints."""
    console = Console(file=io.StringIO(), width=100, **options)
    console.print(what)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


@pytest.mark.parametrize(("found", "word", "code"), [(3.6, "holds", "32"), (2.4, "FAILS", "1;31")])
def test_a_requirement_has_the_colour_of_its_verdict(found: float, word: str, code: str) -> None:
    table = malta.report.requirements_table([Outcome("margin", 3.0, found, "1", "proven", at_least=True)])
    assert f"\x1b[{code}m{word}" in printed(table, force_terminal=True, color_system="standard")
    assert "\x1b[" not in printed(table)
    assert not COLOURED.search(printed(table, force_terminal=True, color_system="standard", no_color=True))
    assert {*COLOURS} == {"holds", "undecided", "fails"}


def on_terminal(*arguments: str, **variables: str) -> str:
    """What a command writes to a terminal of 100 columns."""
    ours, theirs = pty.openpty()
    known = {k: v for k, v in os.environ.items() if k not in ("NO_COLOR", "FORCE_COLOR")}
    process = subprocess.Popen(
        [sys.executable, "-m", *arguments], stdin=theirs, stdout=theirs, stderr=subprocess.DEVNULL,
        env=known | {"TERM": "xterm-256color", "COLUMNS": "100"} | variables,
    )  # fmt: skip
    os.close(theirs)
    read = bytearray()
    try:
        while part := os.read(ours, 1 << 16):
            read += part
    except OSError:  # the end of a terminal
        pass
    os.close(ours)
    assert process.wait() == 0
    return read.decode()


@pytest.mark.slow
def test_a_verdict_is_coloured_on_a_terminal_alone() -> None:
    assert re.search(r"loop\s+\x1b\[1;32mstable", on_terminal(*TOLD))
    plain = on_terminal(*TOLD, NO_COLOR="1")
    assert "stable" in plain
    assert not COLOURED.search(plain)
    piped = subprocess.run([sys.executable, "-m", *TOLD], capture_output=True, text=True, check=True).stdout
    assert "stable" in piped
    assert "\x1b" not in piped


@pytest.mark.parametrize(("end", "code"), [("completed", "32"), ("touchdown", "1;31")])
def test_the_end_of_a_run_has_a_colour(end: str, code: str) -> None:
    cell = end_cell(end, completed=end == "completed")
    assert f"\x1b[{code}m{end}" in printed(cell, force_terminal=True, color_system="standard")


def test_the_verdict_on_a_claim_has_a_colour_and_the_same_word_elsewhere_has_none() -> None:
    rows = [("near the centre", "within 2 %", "near"), ("pole", "reproduced", "reproduced")]
    claims = [LedgerClaim(subject, "1.0", ("1.0",), verdict, word) for subject, verdict, word in rows]  # type: ignore[arg-type]
    lines = malta.report.claims_table(Ledger("table", "paper", ("one",), tuple(claims)))
    shown = printed(lines, force_terminal=True, color_system="standard")
    assert "near the centre" in shown
    assert shown.count("\x1b[1;33mnear") == 1
    assert shown.count("\x1b[32mreproduced") == 1
