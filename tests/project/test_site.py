"""Pages of docs/: public names have a place, pages too, commands exist; the site is built without a warning."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from conftest import ROOT
from docstrings import to_rest
from docutils import nodes
from gallery import FOLDER, cards, few_colours
from links import broken_links
from llms import Entry, first_sentence, llms_text
from PIL import Image
from public import all_names, docstring_of, names_of
from typer.main import get_command

from malta.cli.main import app
from malta.schemas import SCHEMAS

DOCS = ROOT / "docs"
PAGES = sorted(page for page in DOCS.rglob("*.md") if "_build" not in page.parts)
COMMAND = re.compile(r"(?:^|&& |; )malta ((?:[^#\n&|>;]|\\\n)+)", re.MULTILINE)
FENCED = re.compile(r"^```(\w*|\{code-block\} \w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SHELL = ("console", "sh", "bash", "")


def test_every_public_name_stands_on_a_page() -> None:
    listed = [
        name
        for page in (DOCS / "reference").glob("*.md")
        for part in re.findall(r"^```\{public-names\} (\S+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
        for name in names_of(part)
    ]
    assert sorted(listed) == sorted(all_names())
    assert len(listed) > 120


def test_every_schema_stands_on_a_page() -> None:
    texts = [page.read_text(encoding="utf-8") for page in (DOCS / "formats").glob("*.md")]
    listed = [name for text in texts for name in re.findall(r"^```\{entries\} (\S+)$", text, re.MULTILINE)]
    assert sorted(listed) == sorted(SCHEMAS)
    assert any("\n```{outputs}\n" in text for text in texts)


def test_every_page_is_in_a_table_of_contents() -> None:
    reached = {DOCS / "index.md"}
    for page in PAGES:
        for block in re.findall(
            r"^```\{toctree\}\n(.*?)^```$", page.read_text(encoding="utf-8"), re.M | re.S
        ):
            lines = [line for line in block.splitlines() if line and not line.startswith(":")]
            found = [match for line in lines for match in page.parent.glob(f"{line}.md")]
            assert len(found) >= len(lines), page
            reached |= {*found} - {page}
    assert {*PAGES} - reached == set()


@pytest.mark.parametrize("page", [page for page in PAGES if page.parent.name == "howto" and page.stem != "index"],
                         ids=lambda page: page.stem)  # fmt: skip
def test_every_how_to_has_a_picture(page: Path) -> None:
    shown = re.findall(r"^!\[(.+)\]\((\S+)\)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    assert shown
    assert all((page.parent / file).is_file() for _, file in shown)


def _commands(page: Path) -> list[str]:
    text = page.read_text(encoding="utf-8")
    blocks = [(kind, block) for kind, block in FENCED.findall(text) if kind in SHELL]
    typed = [  # of a session what is typed, without what comes out
        "\n".join(re.findall(r"^\$ ((?:.*\\\n)*.*)", block, re.MULTILINE)) if kind == "console" else block
        for kind, block in blocks
    ]
    return [line for block in typed for line in COMMAND.findall(block)]


@pytest.mark.parametrize("page", [ROOT / "README.md", *PAGES], ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_on_a_page_exist_with_their_options(page: Path) -> None:
    """Arguments are parsed as the program does; files are not looked for."""
    program: Any = get_command(app)
    for line in _commands(page):
        name, *arguments = shlex.split(line.replace("\\\n", " "))
        if name.startswith("-"):
            name, arguments = "", [name, *arguments]
        assert not name or name in program.commands, line
        command = program.commands[name] if name else program
        parser = command.make_parser(command.context_class(command, info_name=name))
        parser.parse_args(list(arguments))


def test_commands_are_found_in_pages() -> None:
    assert COMMAND.findall("cd x && malta design a.toml  # one\n") == ["design a.toml  "]
    assert len(_commands(DOCS / "howto" / "commands.md")) > 15
    assert len(_commands(DOCS / "tutorial.md")) > 10


def test_docstrings_become_pages() -> None:
    text = """Close the loop of `plant`.

    x' = A x

a, b : sizes of |S|
    in each axis
`malta.verify` and `nothing` follow *here*.

>>> 1 + 1
2
"""
    found = "\n".join(to_rest(text.splitlines(), ["malta.verify"]))
    assert ".. code-block:: none\n\n    x' = A x\n" in found
    assert ":param a,b: sizes of \\|S\\|\n    in each axis\n" in found
    assert ":py:obj:`malta.verify <malta.verify>`" in found
    assert "``nothing``\\  follow \\*here\\*." in found
    assert ">>> 1 + 1\n2\n" in found
    assert all(docstring_of(name) is not None for name in all_names())


def test_broken_links_are_found(tmp_path: Path) -> None:
    (tmp_path / "a.html").write_text(
        '<h1 id="top">A</h1><a href="#top"></a><a href="b.html#one">b</a><a href="https://example.org"></a>'
    )
    (tmp_path / "b.html").write_text(
        '<p id="one"><a href="a.html#gone"></a><a href="c.html"></a><script src="https://cdn.example/x.js"></script>'
    )
    assert broken_links(tmp_path) == [
        "b.html: loads https://cdn.example/x.js from a network",
        "b.html: a.html#gone, an anchor that is not there",
        "b.html: c.html, a file that is not there",
    ]


def test_llms_txt_has_a_line_for_a_page() -> None:
    pages = [
        Entry("Margins", "howto/margin.html", "A proven margin."),
        Entry("Theory", "theory/index.html", ""),
    ]
    assert llms_text("malta", "Controllers.", {"Use": pages}) == (
        "# malta\n\n> Controllers.\n\n## Use\n\n"
        "- [Margins](howto/margin.html): A proven margin.\n- [Theory](theory/index.html)\n"
    )


@pytest.mark.parametrize(
    ("text", "line"),
    [("It is 1.5 m.\nIt is proven.", "It is 1.5 m."), ("How far? So far.", "How far?"), ("A list:", "A list")],
)  # fmt: skip
def test_the_line_of_a_page_is_its_first_sentence(text: str, line: str) -> None:
    page: Any = nodes.document(None, None)
    page += nodes.section(
        "", nodes.title("", "Page"), nodes.paragraph("", text), nodes.paragraph("", "Later.")
    )
    assert first_sentence(page) == line


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    """Every link within it leads to its place; it holds every name, the schemas, and nothing from a network."""
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-n", "-q", "-d", tmp_path / "trees"]
    built = subprocess.run(
        [*map(str, command), str(DOCS), str(tmp_path / "site")],
        cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (built.returncode, built.stderr) == (0, "")
    pages = {page: page.read_text(encoding="utf-8") for page in (tmp_path / "site").rglob("*.html")}
    for text in pages.values():
        assert "<pre>" not in text  # scrolled by keys
        assert 'role="heading"><span' not in text  # each heading has its level
        assert not re.search(r"<dl>\s*<dd>", text)  # a list of terms has terms
    known = {found for text in pages.values() for found in re.findall(r'id="(malta\.[\w.]+)"', text)}
    assert set(all_names()) <= known
    assert json.loads((tmp_path / "site" / "schemas" / "gain.json").read_text())["title"] == "malta gain file"
    listed = re.findall(
        r"^- \[.+\]\((.+)\.html\)", (tmp_path / "site" / "llms.txt").read_text("utf-8"), re.MULTILINE
    )
    assert sorted([*listed, "index"]) == sorted(str(page.relative_to(DOCS).with_suffix("")) for page in PAGES)


def test_every_card_of_the_gallery_has_a_command_and_small_pictures() -> None:
    """Light and dark, made of commands that exist; all of them together stay small."""
    page = (DOCS / "index.md").read_text(encoding="utf-8")
    found = cards(page)
    assert len(found) == page.count(":::{grid-item-card}") >= 20
    program: Any = get_command(app)
    for line in "\n".join(found.values()).replace(" && ", "\n").splitlines():
        name, *arguments = shlex.split(line)[1:]
        command = program.commands[name]
        command.make_parser(command.context_class(command, info_name=name)).parse_args(arguments)
    files = {f"{name}{suffix}.png" for name in found for suffix in ("", "_dark")}
    for folder, room in ((FOLDER, 600_000), (FOLDER / "full", 2_500_000)):
        pictures = {file.name: file.stat().st_size for file in folder.glob("*.png")}
        assert {*pictures} == files
        assert sum(pictures.values()) < room


def test_every_card_leads_to_the_page_that_makes_it() -> None:
    """To its large pictures, below the command of the card."""
    page, pictures = ((DOCS / name).read_text(encoding="utf-8") for name in ("index.md", "pictures.md"))
    for name, command in cards(page).items():
        assert f":link: picture-{name}\n:link-type: ref" in page
        section = pictures.partition(f"(picture-{name})=\n")[2].partition("\n(picture-")[0]
        assert f"`{command}`" in section
        assert section.index(f"gallery/full/{name}.png") < section.index(f"gallery/full/{name}_dark.png")


def test_a_picture_of_few_colours_keeps_its_paper() -> None:
    picture = Image.new("RGB", (90, 60), (26, 26, 26))
    for k in range(60):
        picture.putpixel((k, k), (4 * k, 200, 255 - 4 * k))
    picture.paste(
        (193, 68, 14), (70, 40, 74, 43)
    )  # a cross of twelve pixels beside shades of blue of twenty each
    for k in range(60):
        picture.paste((30 * (k % 8), 100 + 17 * (k // 8), 200), (k, 40, k + 1, 60))
    small = few_colours(picture).convert("RGB")
    assert small.getpixel((80, 5)) == (26, 26, 26)
    assert small.getpixel((71, 41)) == (193, 68, 14)
