"""A figure that shows itself in a notebook. Importing matplotlib takes long: `drawing.new_figure` imports this late."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from malta.report.figures.drawing import show_plain_texts


class InlineFigure(Figure):
    """A figure that a notebook shows as the value of a cell or by `display(figure)`, with or without pyplot.

    pyplot does not know the figure, so no second picture follows when the cell ends.
    """

    def draw(self, renderer: Any) -> None:
        """Draw with texts as they stand: they have names from files."""
        show_plain_texts(self)
        super().draw(renderer)

    def _repr_png_(self) -> bytes:
        """The picture, as IPython asks for it."""
        return png_of(self)


def png_of(figure: Figure, *, dark: bool = False) -> bytes:
    """The content of a .png file of a figure; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    # Figure.savefig first draws once for the layout, which only tight bounding boxes need.
    canvas: Any = FigureCanvasAgg(figure)
    if not dark:
        canvas.print_png(buffer, metadata={"Software": None}, pil_kwargs={"compress_level": 1})
        return buffer.getvalue()
    canvas.draw()
    drawn = np.asarray(canvas.buffer_rgba())[:, :, :3]
    Image.fromarray(_darken(drawn)).save(buffer, "png", compress_level=1)
    return buffer.getvalue()


def _darken(drawn: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """A picture, height x width x (red, green, blue), 0 to 255, for a dark page."""
    from malta.report.page.document import dark_colours

    found, which = np.unique(drawn.reshape(-1, 3) @ np.array([1 << 16, 1 << 8, 1]), return_inverse=True)
    colours = np.column_stack([found >> 16, found >> 8 & 255, found & 255])
    return np.round(255 * dark_colours(colours / 255)).astype(np.uint8)[which].reshape(drawn.shape)
