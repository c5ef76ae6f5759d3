"""What is true of every page: one file, well-formed, nothing loaded, every figure and table named."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from html.parser import HTMLParser

VOID = {
    "meta",
    "link",
    "br",
    "img",
    "input",
    "hr",
    "path",
    "use",
    "rect",
    "circle",
    "line",
    "polygon",
    "polyline",
}
LOADING = {"src", "href", "srcset", "data", "poster", "action", "formaction", "xlink:href"}


class Reader(HTMLParser):
    """Elements of a page, those that are open, and everything that is wrong with them."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.count: dict[str, int] = {}
        self.faults: list[str] = []
        self.ids: set[str] = set()
        self.named: list[tuple[str, str]] = []  # what names an element by its identifier, and the identifier
        self.text: list[str] = []

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._look(tag, attrs)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._look(tag, attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if not self.open or self.open.pop() != tag:
            self.faults.append(f"</{tag}> closes another element")

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("style", "script"):
            self.text.append(data)

    def _look(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.count[tag] = self.count.get(tag, 0) + 1
        found = {name: value or "" for name, value in attrs}
        for name, value in found.items():
            if name in LOADING and not value.startswith(("#", "data:")):
                self.faults.append(f"{tag} {name}={value}")
            if name.startswith("on"):
                self.faults.append(f"{tag} has a script in {name}")
            if name in ("href", "aria-labelledby") and value.startswith("#") | (name != "href"):
                self.named.append((tag, value.removeprefix("#")))
        if "id" in found:
            if found["id"] in self.ids:
                self.faults.append(f"id {found['id']} twice")
            self.ids.add(found["id"])
        if tag in ("svg", "table") and not found.get("aria-label"):
            self.faults.append(f"{tag} without a label")


def read_page(html: str) -> Reader:
    """Read a page, which has to be whole in itself."""
    reader = Reader()
    reader.feed(html)
    reader.close()
    assert reader.faults == []
    assert reader.open == []
    assert [name for name in reader.named if name[1] not in reader.ids] == []
    assert reader.count["h1"] == 1
    policy = re.findall(r'http-equiv="Content-Security-Policy" content="([^"]*)"', html)
    for kind, text in re.findall(r"<script([^>]*)>(.*?)</script>", html, re.DOTALL):
        if "application/json" in kind:
            json.loads(text)
        else:  # the page's own, and no other runs
            digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
            assert policy == [
                f"default-src 'none'; style-src 'unsafe-inline'; img-src data:; script-src 'sha256-{digest}'"
            ]
    assert reader.count.get("script", 0) == 2
    assert not re.search(r"https?://(?!www\.w3\.org/2000/svg)", html)
    figures, captions, drawings = (reader.count.get(tag, 0) for tag in ("figure", "figcaption", "svg"))
    assert figures == captions == drawings - html.count('<svg class="machine"')
    return reader


def cells_of(html: str, title: str) -> list[list[str]]:
    """The rows of the table with this title, as texts."""
    from html import unescape

    start = html.index(f'<p class="caption">{title}')
    table = html[start : html.index("</table>", start)]
    rows = re.findall(r"<tr>(.*?)</tr>", table)
    return [[unescape(cell) for cell in re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row)] for row in rows]
