"""The most read pages are in plain English: no sentence is longer than 30 words."""

from __future__ import annotations

import re

import pytest
from conftest import ROOT

PAGES = (
    "README.md",
    "docs/tutorial.md",
    "docs/howto/commands.md",
    "docs/howto/margin.md",
    "docs/howto/tune.md",
    "docs/howto/firmware.md",
    "docs/howto/identification.md",
    "docs/howto/campaign.md",
    "docs/theory/index.md",
)
MOST_WORDS = 30
# What is no prose: fenced blocks, comments, tables, indented code, headings.
SKIPPED = re.compile(r"^```.*?^```$|<!--.*?-->|^\|[^\n]*\|$|^    [^\n]*$|^#[^\n]*$", re.MULTILINE | re.DOTALL)
SENTENCE = re.compile(r"(?<=[.?!])[*)\"]*\s+|(?<=:)\s*\n")
LINK = re.compile(r"!?\[([^\]]*)\]\([^)]*\)")


def sentences_of(text: str) -> list[str]:
    """The sentences of a page: a paragraph, an item of a list and a line that ends with a colon end one, too."""
    parts = re.split(r"\n\s*\n|\n(?=\s*(?:[-*]|\d+\.) )", SKIPPED.sub("\n\n", text))
    prose = [LINK.sub(r"\1", re.sub(r"^\s*(?:[-*]|\d+\.) ", "", part)) for part in parts]
    return [found.strip() for part in prose for found in SENTENCE.split(part) if found.strip()]


def words_of(sentence: str) -> list[str]:
    """Words: what has a letter or a digit; a command or a formula between backticks is one word."""
    return [word for word in re.sub(r"`[^`]*`", "x", sentence).split() if re.search(r"\w", word)]


@pytest.mark.parametrize("page", PAGES)
def test_no_sentence_is_long(page: str) -> None:
    long = [
        s for s in sentences_of((ROOT / page).read_text(encoding="utf-8")) if len(words_of(s)) > MOST_WORDS
    ]
    assert long == []


def test_long_sentences_are_found_and_code_is_not_prose() -> None:
    most, more = (" ".join(["word"] * n) + "." for n in (MOST_WORDS, MOST_WORDS + 1))
    page = f"# {more}\n\n```\n{more}\n```\n\n| {more} |\n\n- {most}\n- **{more}** {most}\n\n[{most}](x.md) `{more}`"
    assert [len(words_of(s)) for s in sentences_of(page)] == [30, 31, 30, 30, 1]
