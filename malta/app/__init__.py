"""A page to design with, in a browser (`malta app`) or a notebook (`malta.app.app_widget`): moves are seen at once."""

from malta.app.server import app_widget as app_widget
