"""Formulas as MathML, by docutils' own converter: browsers draw them without a script, so that pages work offline.

MathJax is a script of more than a megabyte, or a network; pictures of formulas need LaTeX where pages are built. An
expression that the converter does not know is a warning, which ends the build.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from docutils.nodes import SkipNode
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.util import logging

if TYPE_CHECKING:
    from sphinx.application import Sphinx

LOGGER = logging.getLogger(__name__)
# A block stands in the environment `align` of amsmath or in none; rows and columns are marked in both alike.
ENVIRONMENT = re.compile(r"\\begin\{(align|gather|equation)(\*?)\}(.*)\\end\{\1\2\}\s*", re.S)


def render(tex: str, node: Any, *, block: bool) -> str:
    """Convert a formula to MathML. What the converter does not know is a warning, and the formula stays as it is."""
    inside = ENVIRONMENT.fullmatch(tex.strip())
    try:
        return str(tex2mathml(tex if inside is None else inside[3].strip(), as_block=block))
    except MathError as error:
        LOGGER.warning("a formula that is no MathML: %s in %r", error, tex, location=node)
        return f"<code>{tex}</code>"


def visit_inline(translator: Any, node: Any) -> None:
    """Write a formula within a line."""
    translator.body.append(render(node.astext(), node, block=False))
    raise SkipNode


def visit_block(translator: Any, node: Any) -> None:
    """Write a formula on lines of its own, with its number if it has one; furo's frame around it has its anchor."""
    number = f'<span class="eqno">({node["number"]})</span>' if node.get("number") else ""
    translator.body.append(f'<div class="math">{render(node.astext(), node, block=True)}{number}</div>\n')
    raise SkipNode


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the renderer under the name mathml."""
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
