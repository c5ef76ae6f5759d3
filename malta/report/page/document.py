"""Sections to one HTML file, and the record of a page that shows itself in a notebook."""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from malta.errors import InputError
from malta.files import replace_files
from malta.report.figures.parts import printable
from malta.report.page.inline import colours_of, inline_svg, style_rules
from malta.report.page.sections import Folded, Item, Picture, Section
from malta.report.page.sheets import polish

if TYPE_CHECKING:
    import jinja2

    from malta.report.page.headline import KeyFigure
    from malta.report.page.sheets import Sheet

SUFFIXES = (".html", ".htm")
BREAKS = ("margins", "job", "gains", "curves")  # anchors of sections that begin a printed page
TALL = "900"  # px, of a page in a notebook


@dataclass(frozen=True, repr=False)
class Page:
    """A page in HTML, whole in itself."""

    title: str
    html: str
    pictures: tuple[tuple[str, Picture], ...] = ()  # each with its caption, for a PDF

    def __repr__(self) -> str:
        return f"Page({self.title!r}, {len(self.html)} characters)"

    def _repr_html_(self) -> str:
        """The page in a frame of its own, as notebooks show it."""
        source = html.escape(self.html, quote=True)
        return f'<iframe srcdoc="{source}" width="100%" height="{TALL}" style="border: 0"></iframe>'

    @property
    def content(self) -> bytes:
        """The bytes of the page's file."""
        return self.html.encode()

    def save(self, path: str | Path) -> Path:
        """Write the page, whole or not at all. Raises InputError for another suffix than .html, or no place for it."""
        path = require_suffix(Path(path), *SUFFIXES)
        replace_files({path: self.content})
        return path


def require_suffix(path: Path, *suffixes: str) -> Path:
    """The same path. Raises InputError for another suffix."""
    if path.suffix.lower() not in suffixes:
        raise InputError(path, "", f"suffix {path.suffix!r}", " or ".join(suffixes[:1]))
    return path


@dataclass(frozen=True)
class Front:
    """What stands at the top of a page."""

    kind: str
    heading: str
    about: str
    figures: Sequence[KeyFigure] = ()
    foot: str = ""


def render(
    front: Front, sections: Sequence[Section], progress: Callable[[float], None] | None = None
) -> Page:
    """Write sections as one page, with its style and its figures in it.

    progress : takes the share of the figures that are drawn
    """
    from markupsafe import Markup  # here, as jinja2: only pages need them

    pictures = [item for section in sections for item in section.items if isinstance(item, Picture)]
    drawn: dict[int, str] = {}
    styles: dict[str, str] = {}
    for number, picture in enumerate(pictures, 1):
        drawn[id(picture)] = inline_svg(picture.draw(), f"f{number}", picture.caption, styles)
        if progress is not None:
            progress(number / len(pictures))
    rules = style_rules(styles)
    parts = [
        {
            "anchor": section.anchor,
            "title": section.title,
            "breaks": section.anchor in BREAKS,
            "parts": [_part(item, drawn) for item in section.items],
        }
        for section in sections
    ]
    title = f"{front.heading}: {front.kind.lower()}"
    text = _environment().get_template("page.html.jinja").render(
        title=title, kind=front.kind, heading=front.heading, about=front.about, figures=front.figures,
        foot=front.foot, sections=parts, style=Markup(_style()), inks=Markup(f"{_inks([rules])}\n{rules}"),
    )  # fmt: skip
    return Page(title, text, tuple((picture.caption, picture) for picture in pictures))


def _part(item: Item, drawn: dict[int, str]) -> dict[str, Any]:
    """An item of a section, as the template takes it."""
    from markupsafe import Markup

    if isinstance(item, str):
        return {"kind": "text", "text": item}
    if isinstance(item, Picture):
        return {"kind": "picture", "caption": item.caption, "svg": Markup(drawn[id(item)])}
    if isinstance(item, Folded):
        return {"kind": "folded", "summary": item.summary, "sheets": item.sheets, "narrow": item.narrow}
    sheet: Sheet = item
    return {"kind": "table", "sheet": sheet}


def _inks(texts: Any) -> str:
    """The colours of the figures, light and dark, as variables."""
    found = colours_of(texts)
    light = "".join(f"{name}:{light};" for name, (light, _) in found.items())
    dark = "".join(f"{name}:{dark};" for name, (_, dark) in found.items())
    return f":root{{{light}}}\n@media screen and (prefers-color-scheme: dark){{:root{{{dark}}}}}"


@cache
def _environment() -> jinja2.Environment:
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("malta.report", "page"),
        undefined=jinja2.StrictUndefined,
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=lambda value: printable(value) if type(value) is str else value,
    )
    environment.filters["polish"] = polish
    return environment


@cache
def _style() -> str:
    return Path(__file__).with_name("style.css").read_text(encoding="utf-8")
