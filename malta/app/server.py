"""The local server of `malta app`: loopback only, a token in the address, nothing but this page and its documents.

A page of another origin cannot ask it anything: the Host must be this address (which stops rebinding of names), an
Origin must be this page's, and every document needs the token. There are no cookies.
"""

from __future__ import annotations

import hmac
import json
import secrets
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any
from urllib.parse import parse_qs, urlsplit

from malta.app.session import Session
from malta.errors import InputError

ADDRESS = "127.0.0.1"
LARGEST = 1_000_000  # bytes of a document
IDLE = 60  # s, until a connection that says nothing is closed
PAGES = {
    "/": ("index.html", "text/html"),
    "/app.css": ("app.css", "text/css"),
    **{
        f"/{name}.js": (f"{name}.js", "text/javascript")
        for name in ("page", "app", "controls", "chart", "figures", "numbers", "tables")
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
    timeout = IDLE

    def do_GET(self) -> None:
        """A file of the page; the page itself only with the token."""
        address = urlsplit(self.path)
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
        self._send(HTTPStatus.OK, kind, files("malta.app").joinpath("static", name).read_bytes())

    def do_POST(self) -> None:
        """A document of the page."""
        if not self._is_from_here():
            return
        if not self._knows(self.headers.get("X-Malta-Token", "")):
            self._refuse(HTTPStatus.FORBIDDEN, "a wrong token")
            return
        if urlsplit(self.path).path != "/ask":
            self._refuse(HTTPStatus.NOT_FOUND, "no such page")
            return
        if self.headers.get_content_type() != "application/json":
            self._refuse(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "not JSON")
            return
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit()):
            self._refuse(HTTPStatus.LENGTH_REQUIRED, "no length")
            return
        if int(length) > LARGEST:
            self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"more than {LARGEST} bytes")
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
