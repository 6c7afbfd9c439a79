"""A web server for one page on this machine: a fixed set of files, each by its name, and nothing else."""

import os
import shutil
import sys
import webbrowser
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from pathlib import Path
from typing import BinaryIO
from urllib.parse import unquote, urlsplit

from formats.errors import QueryError

Files = Mapping[str, Path | bytes]
"""Files, or their content, by their names in the address, with / between folders."""

# Not those of the module mimetypes, which reads the tables of the system: on Windows they may say otherwise.
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".json": "application/json",
    ".wasm": "application/wasm",
    ".glb": "model/gltf-binary",
    ".h5": "application/x-hdf5",
}
_ADDRESS = "127.0.0.1"


class PageServer(ThreadingHTTPServer):
    """Serves `files` on 127.0.0.1; port 0 is a free one.

    Files are opened when they are asked for, so that a page that is loaded again shows their newest content.

    Raises:
        QueryError: the port is in use, or may not be used.
    """

    daemon_threads = True

    def __init__(self, files: Files, port: int = 0) -> None:
        self.files = files
        try:
            super().__init__((_ADDRESS, port), _Handler)
        except (OSError, OverflowError) as cause:
            reason = getattr(cause, "strerror", None) or cause
            raise QueryError(f"port {port}: cannot be used: {reason}; choose another, or 0 for a free one") from cause

    @property
    def address(self) -> str:
        """The address of the page."""
        return f"http://{_ADDRESS}:{self.server_port}/"

    @property
    def hosts(self) -> set[str]:
        """The hosts of requests that are answered; browsers leave port 80 out."""
        names = {_ADDRESS, "localhost"}
        return {f"{name}:{self.server_port}" for name in names} | (names if self.server_port == 80 else set())

    def handle_error(self, request: object, client_address: object) -> None:
        """Say nothing of a browser that closed its connection; other errors keep their traceback."""
        if not isinstance(sys.exc_info()[1], ConnectionError):
            super().handle_error(request, client_address)  # type: ignore[arg-type]


class _Handler(BaseHTTPRequestHandler):
    server: PageServer
    protocol_version = "HTTP/1.1"

    def parse_request(self) -> bool:
        """Refuse what was sent to another host: a page of the web whose name is resolved to this machine."""
        if not super().parse_request():
            return False
        host = self.headers.get("Host", "").lower()
        if host in self.server.hosts:
            return True
        self.send_error(HTTPStatus.MISDIRECTED_REQUEST, explain=f"expected {self.server.address}, found host {host!a}")
        return False

    def do_GET(self) -> None:
        self._answer(with_content=True)

    def do_HEAD(self) -> None:
        self._answer(with_content=False)

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing for each file."""

    def _answer(self, with_content: bool) -> None:
        name = unquote(urlsplit(self.path).path).removeprefix("/") or "index.html"
        content = self.server.files.get(name)
        try:
            opened, size = _open(content)
        except OSError:
            self.send_error(HTTPStatus.NOT_FOUND, explain=f"this page has no file {name!a}")
            return
        with opened:
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", _TYPES.get(Path(name).suffix.lower(), "application/octet-stream"))
            self.send_header("Content-Length", str(size))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            if with_content:
                shutil.copyfileobj(opened, self.wfile, 1 << 20)


def _open(content: Path | bytes | None) -> tuple[BinaryIO, int]:
    if content is None:
        raise FileNotFoundError
    if isinstance(content, bytes):
        return BytesIO(content), len(content)
    file = open(content, "rb")  # noqa: SIM115  # the caller closes it
    return file, os.fstat(file.fileno()).st_size


def show_page(files: Files, port: int, say: Callable[[str], None]) -> bool:
    """Serve a page and open it in the browser until Ctrl-C; return whether Ctrl-C ended it.

    `say` is called with the address. Without a display no browser is opened. Raises QueryError as `PageServer`.
    """
    with PageServer(files, port) as server:
        say(server.address)
        if _has_display():
            webbrowser.open(server.address)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            return True
    return False


def _has_display() -> bool:
    """Return false where `webbrowser` would run a browser of texts in this terminal, or nothing."""
    return not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
