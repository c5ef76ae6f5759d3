"""A page to design with, in a browser (`malta app`) or a notebook (`malta.app.app_widget`): moves are seen at once."""

from __future__ import annotations

from typing import TYPE_CHECKING

from malta.contents import contents

if TYPE_CHECKING:
    from malta.app.server import app_widget as app_widget

__all__, __getattr__, __dir__ = contents(__name__, __file__)
