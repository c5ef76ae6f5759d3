"""Pages that a keyboard and a screen reader get through: what themes and Sphinx leave out is added to written pages."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sphinx.application import Sphinx

PARAMETERS = re.compile(r"<dl>\n((?:<dd><em class=\"sig-param\">.*</dd>\n)+)</dl>")
PLAIN = (
    ('<p class="caption" role="heading">', '<p class="caption" role="heading" aria-level="2">'),
    ('<aside class="sidebar-drawer">', '<aside class="sidebar-drawer" aria-label="all pages">'),
    ('<aside class="toc-drawer">', '<aside class="toc-drawer" aria-label="on this page">'),
    ('<div class="table-wrapper', '<div tabindex="0" class="table-wrapper'),
    ("<pre>", '<pre tabindex="0">'),  # it scrolls where it is wider than the page
)


def accessible_page(text: str) -> str:
    """A page whose captions have a level, whose code is scrolled by keys, and whose lists of terms have terms.

    >>> accessible_page("<pre>x</pre>")
    '<pre tabindex="0">x</pre>'
    """
    for written, meant in PLAIN:
        text = text.replace(written, meant)
    return PARAMETERS.sub(lambda found: f'<div class="parameters">\n{_lines(found[1])}</div>', text)


def _lines(items: str) -> str:
    """Parameters of a signature, a line each: no list of terms, since they have none."""
    return re.sub(r"^<dd>(.*)</dd>$", r"<div>\1</div>", items, flags=re.MULTILINE)


def write_pages(app: Sphinx, problem: Exception | None) -> None:
    """Write the pages of a finished site again."""
    if problem is not None or app.builder.format != "html":
        return
    for page in Path(app.outdir).rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        if (better := accessible_page(text)) != text:
            page.write_text(better, encoding="utf-8")


def setup(app: Sphinx) -> dict[str, Any]:
    """Called by Sphinx."""
    app.connect("build-finished", write_pages)
    return {"parallel_read_safe": True}
