"""The web server of one page: what it hands out, with which type, and what it keeps to itself."""

import socket
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from email.message import Message
from http.client import HTTPConnection
from pathlib import Path

import pytest

from formats.errors import QueryError
from prt_bake.export.server import PageServer


@pytest.fixture
def server(tmp_path: Path) -> Iterator[PageServer]:
    (tmp_path / "view.js").write_text("1;")
    (tmp_path / "secret").write_text("secret")
    files = {
        "index.html": b"<p>",
        "view.js": tmp_path / "view.js",
        "vendor/three/LICENSE": b"MIT",
        "sun 1.hdr": b"#?",
        "gone.h5": tmp_path / "gone.h5",
    }
    with PageServer(files) as running:
        thread = threading.Thread(target=running.serve_forever, args=(0.01,))
        thread.start()
        yield running
        running.shutdown()
        thread.join()


def answer(server: PageServer, name: str) -> tuple[Message, bytes]:
    with urllib.request.urlopen(server.address + name) as answered:
        return answered.headers, answered.read()


@pytest.mark.parametrize(
    ("name", "kind", "content"),
    [
        ("", "text/html; charset=utf-8", b"<p>"),
        ("index.html?a=1#b", "text/html; charset=utf-8", b"<p>"),
        ("view.js", "text/javascript; charset=utf-8", b"1;"),
        ("vendor/three/LICENSE", "application/octet-stream", b"MIT"),
        ("sun%201.hdr", "application/octet-stream", b"#?"),
    ],
)
def test_files_are_handed_out_by_name(server: PageServer, name: str, kind: str, content: bytes) -> None:
    headers, found = answer(server, name)
    assert (headers["Content-Type"], headers["Content-Length"], found) == (kind, str(len(content)), content)


@pytest.mark.parametrize("name", ["secret", "vendor", "vendor/", "../secret", "%2e%2e/secret", "//secret", "gone.h5"])
def test_nothing_else_is_handed_out(server: PageServer, name: str) -> None:
    connection = HTTPConnection("127.0.0.1", server.server_port)
    connection.request("GET", f"/{name}")  # urllib would tidy the path
    assert connection.getresponse().status == 404
    connection.close()


def test_a_changed_file_is_handed_out_anew(server: PageServer, tmp_path: Path) -> None:
    assert answer(server, "view.js")[1] == b"1;"
    (tmp_path / "view.js").write_text("two")
    headers, found = answer(server, "view.js")
    assert (headers["Content-Length"], headers["Cache-Control"], found) == ("3", "no-store", b"two")


def test_a_head_has_no_content_and_nothing_can_be_written(server: PageServer) -> None:
    connection = HTTPConnection("127.0.0.1", server.server_port)
    connection.request("HEAD", "/view.js")
    head = connection.getresponse()
    assert (head.status, head.headers["Content-Length"], head.read()) == (200, "2", b"")
    connection.request("PUT", "/view.js", b"other")
    assert connection.getresponse().status == 501
    connection.close()


def test_other_machines_are_not_answered() -> None:
    with PageServer({}) as closed:
        assert closed.socket.getsockname()[0] == "127.0.0.1"


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1:{}", 200),
        ("LocalHost:{}", 200),
        ("localhost", 421),
        ("127.0.0.1:1", 421),
        ("example.org:{}", 421),
        ("127.0.0.1:{}.example.org", 421),
        ("", 421),
        (None, 421),
    ],
)
@pytest.mark.parametrize("method", ["GET", "HEAD"])
def test_requests_to_another_host_are_refused(server: PageServer, method: str, host: str | None, status: int) -> None:
    connection = HTTPConnection("127.0.0.1", server.server_port)
    connection.putrequest(method, "/view.js", skip_host=True)
    if host is not None:
        connection.putheader("Host", host.format(server.server_port))
    connection.endheaders()
    found = connection.getresponse()
    content = found.read()
    connection.close()
    assert found.status == status
    if method == "GET":
        assert content == b"1;" if status == 200 else server.address.encode() in content


def test_port_80_is_left_out_of_hosts(server: PageServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "server_port", 80)
    assert {"localhost", "127.0.0.1", "localhost:80"} < server.hosts


def test_a_browser_that_leaves_is_no_error(server: PageServer, capsys: pytest.CaptureFixture[str]) -> None:
    server.files = {"large": bytes(1 << 25)}
    with socket.create_connection(("127.0.0.1", server.server_port)) as left:
        left.sendall(b"GET /large HTTP/1.1\r\nHost: localhost:%d\r\n\r\n" % server.server_port)
        assert left.recv(12) == b"HTTP/1.1 200"
    server.files = {"index.html": b"<p>"}
    assert answer(server, "")[1] == b"<p>"
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("port", ["taken", 70000])
def test_a_port_that_cannot_be_used_is_one_sentence(server: PageServer, port: object) -> None:
    number = server.server_port if port == "taken" else 70000
    with pytest.raises(QueryError, match=f"port {number}: cannot be used: .*; choose another"):
        PageServer({}, number)
