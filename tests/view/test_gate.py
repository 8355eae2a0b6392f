"""Who comes in to the viewer."""

from __future__ import annotations

import http.client
import http.server
import threading
from collections.abc import Iterator

import pytest

from avatar.errors import UserError
from avatar.view.gate import Gate, answer, last_of_its_connection

TOKEN = "a-token-that-is-long"


def head(path: str = "/", *lines: str, host: str = "127.0.0.1:8080") -> bytes:
    return "\r\n".join([f"GET {path} HTTP/1.1", f"Host: {host}", *lines, "", ""]).encode()


def refused(*arguments: object) -> str:
    response = answer(*arguments)  # type: ignore[arg-type]
    assert response is not None
    return response.decode().splitlines()[0]


def test_on_this_machine_other_sites_are_kept_out() -> None:
    assert answer(head(), None, True) is None
    assert answer(head("/", "Origin: http://127.0.0.1:8080"), None, True) is None
    assert "403" in refused(head("/", "Origin: http://evil.example"), None, True)
    assert "403" in refused(head("/", "Origin: null"), None, True)
    assert "403" in refused(head(host="evil.example:8080"), None, True), "a name made to point here"
    assert answer(head(host="localhost:8080"), None, True) is None
    assert "400" in refused(b"\x16\x03\x01 hello\r\n\r\n", None, True)


def test_from_elsewhere_the_token_is_needed_once() -> None:
    far = "192.168.0.7:8080"
    assert "401" in refused(head(host=far), TOKEN, False)
    assert "401" in refused(head("/?token=another", host=far), TOKEN, False)
    assert "401" in refused(head("/", "Cookie: avatar_token=another", host=far), TOKEN, False)
    shown = answer(head(f"/?token={TOKEN}", host=far), TOKEN, False)
    assert shown is not None and b"303" in shown and b"HttpOnly" in shown and b"SameSite=Strict" in shown
    assert answer(head("/", f"Cookie: x=1; avatar_token={TOKEN}", host=far), TOKEN, False) is None
    cookie = f"Cookie: avatar_token={TOKEN}"
    assert "403" in refused(head("/", cookie, "Origin: http://evil.example", host=far), TOKEN, False)


def test_only_websockets_keep_their_connection() -> None:
    socket = head("/", "Connection: Upgrade", "Upgrade: websocket")
    assert last_of_its_connection(socket) == socket
    plain = last_of_its_connection(head("/", "Connection: keep-alive", "Accept: x"))
    assert b"keep-alive" not in plain and b"Accept: x" in plain and plain.endswith(b"\r\nConnection: close\r\n\r\n")


@pytest.fixture
def inner() -> Iterator[int]:
    class Hello(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.end_headers()
            self.wfile.write(b"hello" * 100_000)

        def log_message(self, format: str, *args: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Hello)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server.server_address[1]
    server.shutdown()
    server.server_close()


def test_what_is_let_in_is_handed_through(inner: int) -> None:
    gate = Gate("127.0.0.1", 0, inner, TOKEN)

    def get(path: str, **headers: str) -> tuple[int, bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", gate.port, timeout=10)
        connection.request("GET", path, headers=headers)
        response = connection.getresponse()
        return response.status, response.read()

    assert get("/")[0] == 401
    assert get(f"/?token={TOKEN}")[0] == 303
    assert get("/", Cookie=f"avatar_token={TOKEN}") == (200, b"hello" * 100_000)
    with pytest.raises(UserError, match="cannot listen on 127.0.0.1"):
        Gate("127.0.0.1", gate.port, inner, None)
    gate.close()
