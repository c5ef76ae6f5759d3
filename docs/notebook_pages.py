"""Pages of the notebooks: python docs/notebook_pages.py [NAME]..., after `make notebooks` has executed them.

Each build/NAME.ipynb becomes docs/notebooks/NAME.md, its pictures NAME_1.png, NAME_2.png and so on beside it, and
docs/notebooks/index.md a card for each notebook. Long code and long outputs fold. An output that agrees with the page's
as those of other pages do stays as it is, so that only what has changed is another line.
"""

from __future__ import annotations

import base64
import io
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from gallery import few_colours
from page_examples import agrees
from PIL import Image

ROOT = Path(__file__).parents[1]
EXECUTED = ROOT / "build"
FOLDER = ROOT / "docs" / "notebooks"
WIDEST = 860  # pixels of a picture
LONG = 14  # lines of code, or of an output, that a page shows unfolded
INDEX = """# Notebooks

Each is a text file of `notebooks/`: open it in Jupyter, VS Code or Spyder, or run it as a script. Their assertions hold
what their texts claim. `make notebooks` executes them.

::::{grid} 1 2 2 3
:gutter: 2
:class-container: gallery
"""


def source_of(cell: dict[str, Any], key: str = "source") -> str:
    """The text of a cell or an output."""
    return "".join(cell[key]).strip("\n")


def fenced(text: str, language: str, title: str) -> str:
    """A block of code or output, folded where it is long."""
    fence = "~~~" if "```" in text else "```"
    block = f"{fence}{language}\n{text}\n{fence}"
    lines = text.count("\n") + 1
    if lines <= LONG:
        return block
    return f":::{{dropdown}} {title}, {lines} lines\n{block}\n:::"


def picture(content: str) -> bytes:
    """A picture of an executed notebook as PNG of few colours, no wider than WIDEST."""
    shown = Image.open(io.BytesIO(base64.b64decode(content))).convert("RGB")
    shown.thumbnail((WIDEST, 2 * WIDEST), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    few_colours(shown).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def blocks(name: str, cells: list[dict[str, Any]], pictures: dict[str, bytes]) -> Iterator[str]:
    """The page's parts in order; pictures are added by the names of their files."""
    title = ""
    for cell in cells:
        text = source_of(cell)
        if cell["cell_type"] == "markdown":
            title = re.sub(r"^#+ ", "", text.partition("\n")[0]) if text.startswith("#") else title
            yield text
            continue
        yield fenced(text, "python", "Code")
        printed = ""
        for output in cell["outputs"]:
            data = output.get("data", {})
            if "image/png" in data:
                file = f"{name}_{len(pictures) + 1}.png"
                pictures[file] = picture(source_of(data, "image/png"))
                yield f"![{title}]({file})"
            elif output["output_type"] == "stream" and output["name"] == "stdout":
                printed += "".join(output["text"])
            elif "text/plain" in data:
                printed += source_of(data, "text/plain") + "\n"
        if printed.strip():
            yield fenced(
                "\n".join(line.rstrip() for line in printed.strip("\n").splitlines()), "text", "Output"
            )


def page_of(name: str, cells: list[dict[str, Any]], before: str) -> tuple[str, dict[str, bytes]]:
    """A notebook's page and its pictures; outputs of the page `before` stay where they agree."""
    pictures: dict[str, bytes] = {}
    found = list(blocks(name, cells, pictures))
    shown = re.findall(
        r"^(?::::\{dropdown\} Output.*\n)?```text\n.*?^```(?:\n:::)?$", before, re.MULTILINE | re.DOTALL
    )
    kept = iter(shown)
    for k, block in enumerate(found):
        if "```text\n" in block:
            old = next(kept, "")
            found[k] = old if agrees(old, block) else block
    return "\n\n".join(found) + "\n", pictures


def card(name: str, text: str) -> str:
    """A card of the index: title, first question, and the notebook's largest picture."""
    title = text.partition("\n")[0].removeprefix("# ")
    drawn = sorted(FOLDER.glob(f"{name}_*.png"), key=lambda file: file.stat().st_size)
    image = f"```{{image}} {drawn[-1].name}\n:alt: {title}\n```\n" if drawn else ""
    return f":::{{grid-item-card}} {title}\n:link: {name}\n:link-type: doc\n{image}:::\n"


def write(names: list[str]) -> Iterator[Path]:
    """Write the pages of the named notebooks, of all that are executed without names, and the index."""
    FOLDER.mkdir(exist_ok=True)
    for file in sorted(EXECUTED.glob("[0-9][0-9]_*.ipynb")):
        if names and file.stem not in names:
            continue
        page = FOLDER / f"{file.stem}.md"
        before = page.read_text(encoding="utf-8") if page.is_file() else ""
        text, pictures = page_of(file.stem, json.loads(file.read_text(encoding="utf-8"))["cells"], before)
        for old in FOLDER.glob(f"{file.stem}_*.png"):
            old.unlink()
        for name, content in pictures.items():
            (FOLDER / name).write_bytes(content)
        page.write_text(text, encoding="utf-8")
        yield page
    pages = {page.stem: page.read_text(encoding="utf-8") for page in sorted(FOLDER.glob("[0-9]*.md"))}
    cards = "\n".join(card(name, text) for name, text in pages.items())
    tree = "\n".join(pages)
    index = FOLDER / "index.md"
    index.write_text(
        f"{INDEX}\n{cards}::::\n\n```{{toctree}}\n:maxdepth: 1\n:hidden:\n\n{tree}\n```\n", encoding="utf-8"
    )
    yield index


if __name__ == "__main__":
    for written in write(sys.argv[1:]):
        print(written.relative_to(ROOT))
