"""The local server of `malta app`: loopback only, a token in the address, nothing but this page and its documents.

A page of another origin cannot ask it anything: the Host must be this address (which stops rebinding of names), an
Origin must be this page's, and every document needs the token. There are no cookies.
"""

from __future__ import annotations

import hmac
import json
import re
import secrets
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import SplitResult, parse_qs, urlsplit

from malta.app.session import Document, Session
from malta.errors import InputError
from malta.files import locate, read_packaged
from malta.synthesis.spec import Spec

ADDRESS = "127.0.0.1"
MAX_DOCUMENT_BYTES = 1_000_000  # bytes of a document
IDLE_TIMEOUT = 60  # s, until a connection that says nothing is closed
PAGES = {
    "/": ("index.html", "text/html"),
    "/app.css": ("app.css", "text/css"),
    **{
        f"/{name}.js": (f"{name}.js", "text/javascript")
        for name in ("page", "app", "controls", "chart", "export", "figures", "numbers", "tables", "tuning")
    },
}
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Cache-Control": "no-store",
}


class Server(ThreadingHTTPServer):
    """A server of one session. port: 0 for a free one. Raises InputError for a port that is taken."""

    daemon_threads = True
    request_queue_size = 128  # of connections that wait; the five of the library refuse a busy page

    def __init__(self, session: Session, port: int = 0) -> None:
        self.session, self.token = session, secrets.token_urlsafe(24)
        try:
            super().__init__((ADDRESS, port), _Handler)
        except OSError as error:
            found = error.strerror or str(error)
            raise InputError("malta app", "--port", f"{port} ({found})", "a free port") from error

    @property
    def origin(self) -> str:
        """Scheme, address and port."""
        return f"http://{ADDRESS}:{self.server_port}"

    @property
    def url(self) -> str:
        """What a browser opens."""
        return f"{self.origin}/?token={self.token}"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that hangs up is no error to print."""


class _Handler(BaseHTTPRequestHandler):
    server: Server
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "malta", ""
    timeout = IDLE_TIMEOUT

    def do_GET(self) -> None:
        """A file of the page; the page itself only with the token."""
        address = self._address()
        if not self._is_from_here():
            return
        if address.path not in PAGES:
            self._refuse(HTTPStatus.NOT_FOUND, "no such page")
            return
        if address.path == "/" and not self._knows(parse_qs(address.query).get("token", [""])[0]):
            self._refuse(
                HTTPStatus.FORBIDDEN,
                "the address of this page ends with a token: open the one that malta app printed",
            )
            return
        name, kind = PAGES[address.path]
        self._send(HTTPStatus.OK, kind, read_packaged(f"app/static/{name}"))

    def do_POST(self) -> None:
        """A document of the page."""
        if not self._is_from_here():
            return
        if not self._knows(self.headers.get("X-Malta-Token", "")):
            self._refuse(HTTPStatus.FORBIDDEN, "a wrong token")
            return
        if self._address().path != "/ask":
            self._refuse(HTTPStatus.NOT_FOUND, "no such page")
            return
        if self.headers.get_content_type() != "application/json":
            self._refuse(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "not JSON")
            return
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit()):
            self._refuse(HTTPStatus.LENGTH_REQUIRED, "no length")
            return
        if len(length) > len(str(MAX_DOCUMENT_BYTES)) or int(length) > MAX_DOCUMENT_BYTES:
            self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"more than {MAX_DOCUMENT_BYTES} bytes")
            return
        try:
            body = json.loads(self.rfile.read(int(length)))
        except (ValueError, RecursionError):
            self._refuse(HTTPStatus.BAD_REQUEST, "not JSON")
            return
        answer = json.dumps(self.server.session.answer(body), allow_nan=False)
        self._send(HTTPStatus.OK, "application/json", answer.encode())

    def _refuse_method(self) -> None:
        self._refuse(HTTPStatus.METHOD_NOT_ALLOWED, "GET or POST")

    do_HEAD = do_PUT = do_DELETE = do_PATCH = do_OPTIONS = do_TRACE = do_CONNECT = _refuse_method

    def _address(self) -> SplitResult:
        """The parts of the address that was asked for; no path where it is none."""
        try:
            return urlsplit(self.path)
        except ValueError:
            return SplitResult("", "", "", "", "")

    def _is_from_here(self) -> bool:
        """Whether a request is for this address and of this page; else it is refused."""
        port = self.server.server_port
        names = {f"{ADDRESS}:{port}", f"localhost:{port}"}
        origin = self.headers.get("Origin")
        site = self.headers.get("Sec-Fetch-Site", "same-origin")
        if self.headers.get_all("Host", []) not in [[name] for name in names]:
            self._refuse(HTTPStatus.MISDIRECTED_REQUEST, "another host")
        elif origin is not None and origin not in {f"http://{name}" for name in names}:
            self._refuse(HTTPStatus.FORBIDDEN, "another origin")
        elif site not in ("same-origin", "none"):
            self._refuse(HTTPStatus.FORBIDDEN, "another site")
        else:
            return True
        return False

    def _knows(self, token: str) -> bool:
        return hmac.compare_digest(token.encode(), self.server.token.encode())

    def _refuse(self, status: HTTPStatus, why: str) -> None:
        self.close_connection = True  # what follows in the connection was not read
        self._send(status, "text/plain", f"malta app: {why}\n".encode())

    def _send(self, status: HTTPStatus, kind: str, content: bytes) -> None:
        self.send_response(status)
        for name, value in HEADERS.items():
            self.send_header(name, value)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(content)))
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not printed: an address holds the token."""


# The page of `malta app` as a widget in a notebook: the same JavaScript, with messages of the kernel for a server.
#
# anywidget carries the messages; it comes with the extra `notebooks`.


# Each after what it imports.
SCRIPTS = ("numbers", "chart", "controls", "export", "figures", "tables", "tuning", "app", "widget")
HEIGHT = 820  # px


def app_widget(design: str | Path | Spec, *, folder: str | Path = ".", height: int = HEIGHT) -> Any:
    """Show a design with sliders, curves at every move, and the proof of its margin, in a notebook.

    design : a design file, or what `malta.read_design` made of one
    folder : in which files may be saved
    height : px

    The last line of a cell shows the widget; `widget.close()` ends it and its processes. Needs
    `pip install 'malta[notebooks]'`. Raises InputError as `malta.read_design`, and where anywidget is missing.

    >>> import malta
    >>> widget = malta.app.app_widget("design/halbach_pid.toml")
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
        _css = read_packaged("app/static/app.css").decode()
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
    parts = [read_packaged(f"app/static/{name}.js").decode() for name in SCRIPTS]
    plain = [re.sub(r"^import .*\n", "", part, flags=re.MULTILINE) for part in parts]
    return "\n".join(re.sub(r"^export (?!default)", "", part, flags=re.MULTILINE) for part in plain)
