"""A local, read-only page of a folder of results: three documents, no files.

The server listens on 127.0.0.1 only, at an unused port, and answers GET requests for ``/``,
``/state.json`` and ``/flights.json``. A path is compared with these, never opened. Requests with
another ``Host`` are refused, so that no other site can read the page through a name of its own
(DNS rebinding).
"""

import json
import threading
import time
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

ADDRESS = "127.0.0.1"
HEADERS = {
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
Document = Callable[[], dict[str, Any] | None]


class Server:
    """The server of a page, in threads of this process.

    Attributes:
        url: of the page.
        asked: ``time.monotonic()`` of the latest request.
    """

    def __init__(self, page: Callable[[], str], documents: dict[str, Document]) -> None:
        """Listen at an unused port.

        Args:
            page: the HTML.
            documents: functions by path, such as ``/state.json``; None: there is nothing yet.
        """
        self.asked = time.monotonic()
        self._page, self._documents = page, documents
        server = self

        class Handler(_Handler):
            owner = server

        self._server = ThreadingHTTPServer((ADDRESS, 0), Handler)
        self._server.daemon_threads = True
        self.port = int(self._server.server_address[1])
        self.url = f"http://{ADDRESS}:{self.port}/"
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def answer(self, path: str) -> tuple[HTTPStatus, str, bytes]:
        """Status, type and body of the document at a path."""
        self.asked = time.monotonic()
        if path == "/":
            return HTTPStatus.OK, "text/html; charset=utf-8", self._page().encode()
        if path not in self._documents:
            return HTTPStatus.NOT_FOUND, "text/plain", b"not found\n"
        document = self._documents[path]()
        body = json.dumps(document, allow_nan=False).encode()
        return HTTPStatus.OK, "application/json", body

    def close(self) -> None:
        """Stop listening."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Handler(BaseHTTPRequestHandler):
    owner: Server
    server_version, sys_version = "quadjax", ""
    timeout = 30  # s, for a client that sends nothing

    def do_GET(self) -> None:  # noqa: N802
        """Answer one request."""
        hosts = [f"{name}:{self.owner.port}" for name in (ADDRESS, "localhost")]
        if self.headers.get("Host") not in hosts:
            self._send(HTTPStatus.MISDIRECTED_REQUEST, "text/plain", b"unknown host\n")
            return
        try:
            try:
                answer = self.owner.answer(self.path.partition("?")[0])
            except Exception as error:  # of a file that changes while it is read
                line = str(error).partition("\n")[0] or type(error).__name__
                answer = HTTPStatus.INTERNAL_SERVER_ERROR, "text/plain", f"{line}\n".encode()
            self._send(*answer)
        except (BrokenPipeError, ConnectionResetError):  # the page was closed
            self.close_connection = True

    def _send(self, status: HTTPStatus, kind: str, body: bytes) -> None:
        self.send_response(status)
        for name, value in {**HEADERS, "Content-Type": kind}.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *arguments: Any) -> None:
        """Log nothing."""
