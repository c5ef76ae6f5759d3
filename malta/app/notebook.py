"""The page of `malta app` as a widget in a notebook: the same JavaScript, with messages of the kernel for a server.

anywidget carries the messages; it comes with the extra `notebooks`.
"""

from __future__ import annotations

import re
import threading
from importlib.resources import files
from pathlib import Path
from typing import Any

from malta.app.session import Document, Session
from malta.errors import InputError
from malta.files import locate
from malta.synthesis.spec import Spec

SCRIPTS = ("numbers", "chart", "controls", "figures", "tables", "app", "widget")  # each after what it imports
HEIGHT = 820  # px


def app_widget(design: str | Path | Spec, *, folder: str | Path = ".", height: int = HEIGHT) -> Any:
    """Show a design with sliders, curves at every move, and the proof of its margin, in a notebook.

    design : a design file, or what `malta.read_design` made of one
    folder : in which files may be saved
    height : px

    The last line of a cell shows the widget; `widget.close()` ends it and its processes. Needs
    `pip install 'malta[notebooks]'`. Raises InputError as `malta.read_design`, and where anywidget is missing.

    >>> import malta
    >>> widget = malta.app_widget("design/halbach_pid.toml")
    >>> widget.session.files.fields["pid.Kp.F_x"].unit
    'N/m'
    >>> widget.close()
    """
    path = design.path if isinstance(design, Spec) else locate(design)
    return _widget_class()(path, Path(folder), height)


def _widget_class() -> Any:
    """The class of the widget, made when it is asked for: anywidget is an extra."""
    try:
        import anywidget
        import traitlets
    except ImportError as error:
        raise InputError("app_widget", "anywidget", "nothing", "pip install 'malta[notebooks]'") from error

    class AppWidget(anywidget.AnyWidget):
        """A design under edit; `session` answers its messages."""

        _esm = script()
        _css = files("malta.app").joinpath("static", "app.css").read_text(encoding="utf-8")
        height = traitlets.Int(HEIGHT).tag(sync=True)

        def __init__(self, path: Path, folder: Path, height: int) -> None:
            super().__init__(height=height)
            self.session = Session(path, folder, hear=lambda news: self.send({"news": news}))
            self.on_msg(self._answer)

        def _answer(self, _widget: Any, content: Document, _buffers: Any) -> None:
            """Answer a message {"id", "body"}; what takes long does so in a thread, as the kernel answers others."""
            body = content.get("body")
            if isinstance(body, dict) and body.get("ask") == "gains":
                threading.Thread(target=self._reply, args=(content,), daemon=True).start()
            else:
                self._reply(content)

        def _reply(self, content: Document) -> None:
            self.send({"id": content.get("id"), "body": self.session.answer(content.get("body"))})

        def close(self) -> None:
            """Close the widget and end the processes that follow its design."""
            self.session.close()
            super().close()

    return AppWidget


def script() -> str:
    """The modules of the page as one module of JavaScript, without their imports of each other."""
    folder = files("malta.app").joinpath("static")
    parts = [folder.joinpath(f"{name}.js").read_text(encoding="utf-8") for name in SCRIPTS]
    plain = [re.sub(r"^import .*\n", "", part, flags=re.MULTILINE) for part in parts]
    return "\n".join(re.sub(r"^export (?!default)", "", part, flags=re.MULTILINE) for part in plain)
