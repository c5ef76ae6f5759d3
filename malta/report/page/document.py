"""Sections to one HTML file, and the record of a page that shows itself in a notebook."""

from __future__ import annotations

import colorsys
import html
import io
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

from malta.errors import InputError
from malta.files import replace_files
from malta.report.figures.drawing import printable
from malta.report.page.analysis import KeyFigure
from malta.report.page.sections import Folded, Item, Picture, Section, plain_sheet, polish
from malta.report.tables.experiments import finding_cells

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    import jinja2
    from matplotlib.backends.backend_pdf import PdfPages
    from matplotlib.figure import Figure

    from malta.identification.commission import Commissioning, Entry
    from malta.report.page.analysis import KeyFigure
    from malta.report.page.sections import Sheet


# A figure as SVG that stands inside a page: colours by CSS variables, so that a dark page has light lines.


NAMESPACE = re.compile(r"^\{[^}]*\}")
COLOUR = re.compile(r"#[0-9a-f]{6}\b")
REFERENCE = re.compile(r"url\(#([^)]+)\)")
NUMBER = re.compile(r"-?\d+\.\d{3,}")
FONT = re.compile(r"font-family: [^;]*;? ?")


def inline_svg(figure: Figure, prefix: str, label: str, styles: dict[str, str]) -> str:
    """Draw a figure as an <svg> element for a page.

    prefix : of the identifiers in it, which no other figure of the page may have
    label : what the figure shows, for readers who do not see it
    styles : style -> class, of all figures of the page so far; those of this figure are added
    """
    root = ElementTree.fromstring(_svg_bytes(figure))
    named = dict.fromkeys(found for node in root.iter() for found in _references(node))
    names = {name: f"{prefix}-{number}" for number, name in enumerate(named)}
    for node in root.iter():
        _simplify(node, names, styles)
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag in ("metadata", "style"):
                parent.remove(child)
    box = root.get("viewBox", "")
    least = f"min-width:{float(box.split()[2]):.0f}px"  # of a narrow screen, which scrolls
    root.attrib.clear()
    root.attrib.update({"viewBox": box, "role": "img", "aria-label": printable(label), "style": least})
    return ElementTree.tostring(root, encoding="unicode")


def _svg_bytes(figure: Figure) -> bytes:
    import matplotlib

    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "malta", "svg.fonttype": "none"}), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph")  # the browser's fonts have it
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None}, transparent=True)
    return buffer.getvalue()


def _references(node: ElementTree.Element) -> list[str]:
    """The identifiers that an element names."""
    found = [REFERENCE.findall(value) for value in node.attrib.values()]
    links = [value[1:] for key, value in node.attrib.items() if key.endswith("href") and value[:1] == "#"]
    return [name for names in (*found, links) for name in names]


def _simplify(node: ElementTree.Element, names: Mapping[str, str], styles: dict[str, str]) -> None:
    """Drop namespaces, unused identifiers and digits that no screen shows; name colours and styles.

    names : identifiers in the page of those that are used
    """
    node.tag = NAMESPACE.sub("", str(node.tag))
    attributes = {}
    for key, value in node.attrib.items():
        name = NAMESPACE.sub("", key)
        if (name == "id" and value not in names) or (name == "transform" and value.startswith("rotate(-0 ")):
            continue
        if name == "id":
            value = names[value]
        elif name == "href" and value[1:] in names:
            value = f"#{names[value[1:]]}"
        elif name == "style":
            value = COLOUR.sub(lambda found: f"var(--ink-{found[0][1:]})", FONT.sub("", value))
        elif name in ("d", "points", "x", "y", "transform"):
            value = NUMBER.sub(lambda found: f"{float(found[0]):.2f}", " ".join(value.split()))
        value = REFERENCE.sub(lambda found: f"url(#{names[found[1]]})", value)
        if name == "style":
            name, value = "class", styles.setdefault(value, f"k{len(styles)}")
        attributes[name] = value
    node.attrib.clear()
    node.attrib.update(attributes)


def style_rules(styles: Mapping[str, str]) -> str:
    """The rules of the classes that stand in place of styles, as `inline_svg` collects them."""
    return "\n".join(f".{name}{{{style}}}" for style, name in styles.items())


def colours_of(texts: Iterable[str]) -> dict[str, tuple[str, str]]:
    """The variables of all colours in some texts: for each the colour on a light page and on a dark one."""
    names = {"000000", "ffffff"}
    for text in texts:
        names.update(re.findall(r"var\(--ink-([0-9a-f]{6})\)", text))
    return {f"--ink-{name}": (f"#{name}", dark_colour(name)) for name in sorted(names)}


def dark_colour(name: str) -> str:
    """The colour of six hexadecimal digits for a dark page: of the same hue, as light as the other was dark.

    >>> dark_colour("000000"), dark_colour("ffffff")
    ('#ededed', '#1a1a1a')
    """
    red, green, blue = (int(name[k : k + 2], 16) / 255 for k in (0, 2, 4))
    hue, light, strength = colorsys.rgb_to_hls(red, green, blue)
    turned = colorsys.hls_to_rgb(hue, 0.93 - 0.83 * light, strength)
    return "#" + "".join(f"{round(255 * part):02x}" for part in turned)


# The figures of a page as a PDF for a paper: one on each sheet, with its caption, in vectors with embedded fonts.


CAPTION = 0.62  # inch below the figure
LETTERS = 112  # of a caption in a line


def pdf_of(page: Page) -> bytes:
    """Draw the figures of a page as the content of a PDF; the same figures give the same bytes."""
    import matplotlib
    from matplotlib.backends.backend_pdf import PdfPages

    buffer = io.BytesIO()
    with matplotlib.rc_context({"pdf.fonttype": 42}), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph")  # a letter that matplotlib's font lacks is a box
        metadata = {"Title": page.title, "Creator": "malta", "Producer": None, "CreationDate": None}
        with PdfPages(buffer, metadata=metadata) as document:
            for number, (caption, picture) in enumerate(page.pictures, 1):
                _add_page(document, picture.draw(), f"Figure {number}. {caption}")
    return buffer.getvalue()


def _add_page(document: PdfPages, figure: Figure, caption: str) -> None:
    """Add a figure with its caption below it."""
    import textwrap

    from matplotlib.transforms import Bbox

    width, height = figure.get_size_inches()
    lines = "\n".join(textwrap.wrap(caption, round(LETTERS * width / 9.0)))
    figure.text(0.02, -0.12 / height, lines, fontsize=9, va="top", ha="left")
    document.savefig(figure, bbox_inches=Bbox([[0.0, -CAPTION], [width, height]]))  # type: ignore[no-untyped-call]


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
    verdict: str = ""  # an element of HTML


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
        foot=front.foot, verdict=Markup(front.verdict),
        sections=parts, style=Markup(_style()), inks=Markup(f"{_inks([rules])}\n{rules}"),
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


# The page of a commissioning for the lab's binder: steps, findings with limits, logs, signature.


def binder_page(done: Commissioning) -> Page:
    """Write a commissioning as one page in HTML that needs no network and no other file, with a place to sign."""
    passed = sum(entry.passed for entry in done.entries)
    state = "good" if done.passed else "bad"
    heads = [
        KeyFigure("steps passed", f"{passed} of {len(done.steps)}", "", state),
        KeyFigure("signature", done.signature[:16], "sha256 of the gain file, logs and results"),
    ]
    front = Front("Commissioning", done.gains, f"Machine {done.machine}", heads, "malta commission")
    return render(front, [*map(_section, done.entries), _signed(done)])


def _section(entry: Entry) -> Section:
    """A step: its question, its findings, and why it was refused."""
    state = "passed" if entry.passed else "FAILED"
    items = [] if not entry.refusal else [entry.refusal]
    sheet = plain_sheet(
        "", ("finding", "found", "95 %", "limits", ""), [finding_cells(one) for one in entry.findings]
    )
    return Section(entry.name, f"{entry.question} {state}", (*items, *([sheet] if entry.findings else [])))


def _signed(done: Commissioning) -> Section:
    """The files with their sha256, the signature, and lines for names."""
    rows = [(done.gains, done.sha256), *((e.log, e.sha256) for e in done.entries if e.sha256)]
    lines = ("Date, name: ______________________________", "Witness: ______________________________")
    sheet = plain_sheet("Files", ("file", "sha256"), rows)
    return Section("signature", "Signature", (sheet, f"Signature {done.signature}", *lines))


def binder_text(done: Commissioning) -> str:
    """The same as plain text."""
    lines = [f"Commissioning of a {done.machine}, gain file {done.gains}", f"sha256 {done.sha256}", ""]
    for entry in done.entries:
        lines.append(f"{entry.name}: {entry.question} {'passed' if entry.passed else 'FAILED'}")
        lines += [f"    {entry.refusal}"] if entry.refusal else []
        for one in entry.findings:
            name, found, half, limits, word = finding_cells(one)
            lines.append(
                f"    {name}: {found} +- {half}{'' if not limits else f', {limits}'} {word}".rstrip()
            )
        lines += [f"    {entry.log} sha256 {entry.sha256}"] if entry.sha256 else []
    left = done.steps[len(done.entries) :]
    lines += [f"not gone: {' '.join(left)}"] if left else []
    return "\n".join([*lines, "", f"signature {done.signature}", "", "Date, name:", "Witness:", ""])
