"""A figure as SVG that stands inside a page: colours by CSS variables, so that a dark page has light lines."""

from __future__ import annotations

import colorsys
import io
import re
import warnings
from typing import TYPE_CHECKING
from xml.etree import ElementTree

from malta.report.figures.parts import printable

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from matplotlib.figure import Figure

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
