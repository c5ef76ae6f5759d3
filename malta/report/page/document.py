"""Sections to one HTML file, and the record of a page that shows itself in a notebook."""

from __future__ import annotations

import base64
import hashlib
import html
import io
import json
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from malta.files import read_packaged, require_suffix
from malta.report.figures.drawing import BOUND_LINE, printable
from malta.report.page.analysis import KeyFigure
from malta.report.page.sections import Folded, Illustration, Item, PageTable, Section, polish
from malta.writing import replace_files

if TYPE_CHECKING:
    import jinja2
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_pdf import PdfPages
    from matplotlib.figure import Figure

    from malta.arrays import FloatArray


# A figure as SVG that stands inside a page: colours by CSS variables, so that a dark page has light lines.


NAMESPACE = re.compile(r"^\{[^}]*\}")
COLOUR = re.compile(r"#[0-9a-f]{6}\b")
REFERENCE = re.compile(r"url\(#([^)]+)\)")
NUMBER = re.compile(r"-?\d+\.\d{3,}")
ALONG_LABELS = ("time", "frequency")  # labels of axes along which one looks at curves
MAX_TOLD_POINTS = 160  # points of a curve of which a page knows the frequency
MAX_MARK_POINTS = 8  # points: what has fewer is no curve
FONT = re.compile(r"font-family: [^;]*;? ?")


def inline_svg(figure: Figure, prefix: str, label: str, styles: dict[str, str]) -> tuple[str, dict[str, Any]]:
    """Draw a figure as an <svg> element for a page, and say what its panels, lines and legends are.

    prefix : of the identifiers in it, which no other figure of the page may have
    label : what the figure shows, for readers who do not see it
    styles : style -> class, of all figures of the page so far; those of this figure are added
    """
    lines, entries, along = _mark_lines(figure)
    root = ElementTree.fromstring(_svg_bytes(figure))
    named = dict.fromkeys(found for node in root.iter() for found in _references(node))
    names = {name: f"{prefix}-{number}" for number, name in enumerate([*named, *lines, *entries])}
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
    told = {
        "axes": [_panel(axes, 72 * figure.get_size_inches()) for axes in figure.axes],
        "lines": [
            {"id": names[key], "axes": k, "label": label} | along.get(key, {})
            for key, (k, label) in lines.items()
        ],
        "legend": [{"id": names[key], "label": label} for key, label in entries.items()],
    }
    return ElementTree.tostring(root, encoding="unicode"), told


def _mark_lines(
    figure: Figure,
) -> tuple[dict[str, tuple[int, str]], dict[str, str], dict[str, dict[str, Any]]]:
    """Name the lines of a figure that are data, and the texts of its legends, so that its SVG has these names.

    A line without a name of its own has that of the legend's line in its look.

    Returns name -> (panel, label) of lines, name -> label of legends, and name -> the points of curves over frequency.
    """
    legends = [legend for legend in (*figure.legends, *(a.get_legend() for a in figure.axes)) if legend]
    looks: dict[str, str] = {}
    entries: dict[str, str] = {}
    for legend in legends:
        for handle, text in zip(legend.legend_handles, legend.get_texts(), strict=False):
            name = f"legend-{len(entries)}"
            text.set_gid(name)
            entries[name] = text.get_text()
            if handle is not None and hasattr(handle, "get_linestyle"):
                looks[_look_of(handle)] = text.get_text()
    lines: dict[str, tuple[int, str]] = {}
    along: dict[str, dict[str, Any]] = {}
    for k, axes in enumerate(figure.axes):
        for line in axes.lines:
            if line.get_gid() == BOUND_LINE or np.size(line.get_xdata()) < MAX_MARK_POINTS:
                continue
            name, label = f"line-{len(lines)}", str(line.get_label())
            line.set_gid(name)
            lines[name] = k, looks.get(_look_of(line), "") if label.startswith("_") else label
            if (known := getattr(line, "frequencies", None)) is not None:
                along[name] = {"points": _points_over_frequency(*known)}
    return lines, entries, along


def _points_over_frequency(w: FloatArray, values: Any) -> list[list[float]]:
    """Rows of frequency, rad/s, real and imaginary part, MAX_TOLD_POINTS at most of those that are drawn."""
    drawn = np.flatnonzero(np.isfinite(values))
    rows = drawn[:: max(1, -(-len(drawn) // MAX_TOLD_POINTS))]
    return [[float(f"{number:.4g}") for number in (w[k], values[k].real, values[k].imag)] for k in rows]


def _look_of(line: Any) -> str:
    """Colour and dashes of a line; matplotlib keeps the dashes of a style to itself."""
    return (
        f"{line.get_color()} {getattr(line, '_unscaled_dash_pattern', line.get_linestyle())}"
        if hasattr(line, "get_color")
        else ""
    )


def _panel(axes: Axes, size: FloatArray) -> dict[str, Any]:
    """Where a panel is in its SVG, points, and its axes; `along`: whether one looks at it along x."""
    wide, tall = size.tolist()
    place = axes.get_position()
    sides: dict[str, Any] = {}
    for name, side, limits in (("x", axes.xaxis, axes.get_xlim()), ("y", axes.yaxis, axes.get_ylim())):
        scale = side.get_scale() if side.get_scale() in ("log", "symlog") else "linear"
        sides[name] = {
            "scale": scale,
            "low": limits[0],
            "high": limits[1],
            "label": _shared_label(axes, name),
        }
        if scale == "symlog":
            found: Any = side.get_transform()
            sides[name] |= {"linear": found.linthresh, "slope": found.linscale / (1 - 1 / found.base)}
    return {
        "left": wide * place.x0, "right": wide * place.x1, "top": tall * (1 - place.y1),
        "bottom": tall * (1 - place.y0), "along": sides["x"]["label"].startswith(ALONG_LABELS), **sides,
    }  # fmt: skip


def _shared_label(axes: Axes, name: str) -> str:
    """The label of an axis, or of another panel that shares it."""
    panels = axes.get_shared_x_axes().get_siblings(axes) if name == "x" else [axes]
    return next((text for one in (axes, *panels) if (text := getattr(one, f"get_{name}label")())), "")


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
    rgb = np.array([[int(name[k : k + 2], 16) for k in (0, 2, 4)]]) / 255
    return "#" + "".join(f"{round(255 * part):02x}" for part in dark_colours(rgb)[0])


def dark_colours(rgb: FloatArray) -> FloatArray:
    """Colours of a dark page in place of those of a light one: rows of red, green, blue from 0 to 1.

    Lightness is the eye's, so that lines which differ in grey on a light page do so on a dark one.
    """
    middle = (rgb.min(axis=1) + rgb.max(axis=1))[:, None] / 2
    tint = (rgb - middle) / np.maximum(np.minimum(middle, 1 - middle), 1e-9)
    black, white = lightness(np.array([[0xED] * 3, [0x1A] * 3]) / 255)
    wanted = black + (white - black) * lightness(rgb) / 100
    low, high = np.zeros_like(middle), np.ones_like(middle)
    for _ in range(20):  # halves the interval of the colour's middle
        middle = (low + high) / 2
        turned = middle + np.minimum(middle, 1 - middle) * tint
        darker = (lightness(turned) < wanted)[:, None]
        low, high = np.where(darker, middle, low), np.where(darker, high, middle)
    return np.asarray(np.clip(turned, 0.0, 1.0))


def lightness(rgb: FloatArray) -> FloatArray:
    """CIE lightness of colours, 0 (black) to 100 (white): rows of red, green, blue from 0 to 1, of sRGB."""
    Y = luminance(rgb)
    return np.asarray(np.where(Y > (6 / 29) ** 3, 116 * np.cbrt(Y) - 16, Y * (29 / 3) ** 3))


def luminance(rgb: FloatArray) -> FloatArray:
    """Relative luminance of colours, 0 to 1: rows of red, green, blue from 0 to 1, of sRGB (IEC 61966-2-1)."""
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return np.asarray(linear @ [0.2126, 0.7152, 0.0722])


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
PAGE_BREAKS = ("margins", "job", "gains", "curves")  # anchors of sections that begin a printed page
PAGE_HEIGHT = "900"  # px, of a page in a notebook


@dataclass(frozen=True, repr=False)
class Page:
    """A page in HTML, whole in itself."""

    title: str
    html: str
    pictures: tuple[tuple[str, Illustration], ...] = ()  # each with its caption, for a PDF

    def __repr__(self) -> str:
        return f"Page({self.title!r}, {len(self.html)} characters)"

    def _repr_html_(self) -> str:
        """The page in a frame of its own, as notebooks show it."""
        source = html.escape(self.html, quote=True)
        return f'<iframe srcdoc="{source}" width="100%" height="{PAGE_HEIGHT}" style="border: 0"></iframe>'

    @property
    def content(self) -> bytes:
        """The bytes of the page's file."""
        return self.html.encode()

    def save(self, path: str | Path) -> Path:
        """Write the page, whole or not at all. Raises InputError for another suffix than .html, or no place for it."""
        path = require_suffix(Path(path), *SUFFIXES)
        replace_files({path: self.content})
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
    machine: str = ""  # the machine at rest, an element of SVG


def render(
    front: Front, sections: Sequence[Section], progress: Callable[[float], None] | None = None
) -> Page:
    """Write sections as one page, with its style and its figures in it.

    progress : takes the share of the figures that are drawn
    """
    from markupsafe import Markup  # here, as jinja2: only pages need them

    pictures = [item for section in sections for item in section.items if isinstance(item, Illustration)]
    drawn: dict[int, str] = {}
    styles: dict[str, str] = {}
    told = []
    for number, picture in enumerate(pictures, 1):
        drawn[id(picture)], panels = inline_svg(picture.draw(), f"f{number}", picture.caption, styles)
        told.append(panels)
        if progress is not None:
            progress(number / len(pictures))
    rules = style_rules(styles)
    parts = [
        {
            "anchor": section.anchor,
            "title": section.title,
            "breaks": section.anchor in PAGE_BREAKS,
            "parts": [_part(item, drawn) for item in section.items],
        }
        for section in sections
    ]
    title = f"{front.heading}: {front.kind.lower()}"
    policy, script = script_of(read_packaged("report/page/figures.js").decode())
    text = render_template(
        "page.html.jinja", title=title, kind=front.kind, heading=front.heading, about=front.about,
        figures=front.figures, foot=front.foot, verdict=Markup(front.verdict), machine=Markup(front.machine),
        sections=parts, style=Markup(page_style()), inks=Markup(f"{_inks([rules])}\n{rules}"),
        policy=policy, script=Markup(script), panels=Markup(json_in_page(told)),
    )  # fmt: skip
    return Page(title, text, tuple((picture.caption, picture) for picture in pictures))


def _part(item: Item, drawn: dict[int, str]) -> dict[str, Any]:
    """An item of a section, as the template takes it."""
    from markupsafe import Markup

    if isinstance(item, str):
        return {"kind": "text", "text": item}
    if isinstance(item, Illustration):
        return {"kind": "picture", "caption": item.caption, "svg": Markup(drawn[id(item)])}
    if isinstance(item, Folded):
        return {"kind": "folded", "summary": item.summary, "sheets": item.sheets, "narrow": item.narrow}
    sheet: PageTable = item
    return {"kind": "table", "sheet": sheet}


def _inks(texts: Any) -> str:
    """The colours of the figures, light and dark, as variables."""
    found = colours_of(texts)
    light = "".join(f"{name}:{light};" for name, (light, _) in found.items())
    dark = "".join(f"{name}:{dark};" for name, (_, dark) in found.items())
    return f":root{{{light}}}\n@media screen and (prefers-color-scheme: dark){{:root{{{dark}}}}}"


def render_template(name: str, **values: Any) -> str:
    """A page of a template beside this module; texts are escaped but for those of the class Markup."""
    return str(_environment().get_template(name).render(**values))


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


def json_in_page(content: Any) -> str:
    """A JSON document that stands in an element of a page: no text in it ends the element."""
    return json.dumps(content, allow_nan=False).replace("<", "\\u003c")


def script_of(text: str) -> tuple[str, str]:
    """The policy of a page that runs this script and asks no network, and the element of the script."""
    digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    policy = f"default-src 'none'; style-src 'unsafe-inline'; img-src data:; script-src 'sha256-{digest}'"
    return policy, f"<script>{text}</script>"


@cache
def page_style() -> str:
    """The style of all pages."""
    return read_packaged("report/page/style.css").decode()
