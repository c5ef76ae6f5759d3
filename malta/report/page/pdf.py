"""The figures of a page as a PDF for a paper: one on each sheet, with its caption, in vectors with embedded fonts."""

from __future__ import annotations

import io
import warnings
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.backends.backend_pdf import PdfPages
    from matplotlib.figure import Figure

    from malta.report.page.document import Page

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
