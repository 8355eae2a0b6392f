"""What stands between the network and the viewer: only people who know the token come in, and no page of another site.

The viewer's own server listens on this machine alone, at a port that nobody is told. A browser shows the token once, in the
address (?token=...), and keeps it as a cookie from then on; a connection is looked at by its first request and then handed
through, byte for byte. Requests that are not for a WebSocket are asked to be the last of their connection, so that no proxy
in between can put another's request on it.
"""

from __future__ import annotations

import asyncio
import hmac
import http.cookies
import re
import threading
import urllib.parse
from collections.abc import Callable

from avatar.errors import UserError

COOKIE = "avatar_token"
LOCAL = ("127.0.0.1", "localhost", "::1")
MAX_HEAD, HEAD_SECONDS = 1 << 16, 20.0
CHUNK = 1 << 16


def answer(head: bytes, token: str | None, is_local: bool) -> bytes | None:
    """The response that ends a connection with this first request; None lets it in."""
    lines = head.decode("latin-1").split("\r\n")
    words = lines[0].split(" ")
    if len(words) != 3 or not words[2].startswith("HTTP/1."):
        return _response("400 Bad Request", "This is not a request that a browser makes.")
    headers = {}
    for line in lines[1:]:
        name, _, value = line.partition(":")
        headers[name.strip().lower()] = value.strip()
    host = headers.get("host", "")
    # Another site's page must not talk to the viewer, nor a name that was made to point to this machine.
    if is_local and urllib.parse.urlsplit(f"//{host}").hostname not in LOCAL:
        return _response("403 Forbidden", "Open the viewer under the address that it printed.")
    if "origin" in headers and urllib.parse.urlsplit(headers["origin"]).netloc != host:
        return _response("403 Forbidden", "Another site's page may not use the viewer.")
    if token is None:
        return None
    cookies: http.cookies.SimpleCookie = http.cookies.SimpleCookie()
    try:
        cookies.load(headers.get("cookie", ""))
    except http.cookies.CookieError:
        cookies.clear()
    if COOKIE in cookies and _same(cookies[COOKIE].value, token):
        return None
    address = urllib.parse.urlsplit(words[1])
    shown = urllib.parse.parse_qs(address.query).get("token", [""])[0]
    if not _same(shown, token):
        return _response("401 Unauthorized", "This viewer needs its token: open the whole address that it printed.")
    more = f"Location: /\r\nSet-Cookie: {COOKIE}={token}; HttpOnly; SameSite=Strict; Path=/\r\n"
    return _response("303 See Other", "", more)


def _same(a: str, b: str) -> bool:
    return hmac.compare_digest(a.encode(), b.encode())


def _response(status: str, sentence: str, more: str = "") -> bytes:
    body = sentence.encode()
    last = f"Content-Type: text/plain\r\nContent-Length: {len(body)}\r\nConnection: close\r\n\r\n"
    return f"HTTP/1.1 {status}\r\n{more}{last}".encode() + body


def last_of_its_connection(head: bytes) -> bytes:
    """A request's head; what is not for a WebSocket says that nothing follows it."""
    if re.search(rb"\r\nupgrade:[ \t]*websocket", head, re.IGNORECASE):
        return head
    without = re.sub(rb"\r\nconnection:[^\r]*", b"", head, flags=re.IGNORECASE)
    return without[:-4] + b"\r\nConnection: close\r\n\r\n"


class Gate:
    """Listens on `host`:`port` and hands through to `inner` on this machine, in a thread of its own."""

    def __init__(self, host: str, port: int, inner: int, token: str | None) -> None:
        """Raises UserError when the address cannot be listened on. Port 0 takes a free one, then in `port`."""
        self._inner, self._token, self._is_local = inner, token, host in LOCAL
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True, name="gate")
        self._thread.start()
        try:
            self._server = self._call(lambda: asyncio.start_server(self._meet, host, port, limit=MAX_HEAD))
        except OSError as error:
            self._loop.call_soon_threadsafe(self._loop.stop)
            raise UserError(
                f"the viewer cannot listen on {host}:{port} ({error.strerror or error}); give another --port"
            ) from None
        self.port: int = self._server.sockets[0].getsockname()[1]

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._server.close)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(5)

    def _call(self, start: Callable[[], object]) -> asyncio.Server:
        async def run() -> asyncio.Server:
            return await start()  # type: ignore[misc]

        return asyncio.run_coroutine_threadsafe(run(), self._loop).result(10)

    async def _meet(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), HEAD_SECONDS)
            refusal = answer(head, self._token, self._is_local)
            if refusal is not None:
                writer.write(refusal)
                await writer.drain()
                return
            inner_reader, inner_writer = await asyncio.open_connection("127.0.0.1", self._inner)
            inner_writer.write(last_of_its_connection(head))
            await asyncio.gather(_pour(reader, inner_writer), _pour(inner_reader, writer))
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # who breaks off or does not speak HTTP is not answered
        finally:
            writer.close()


async def _pour(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    try:
        while data := await reader.read(CHUNK):
            writer.write(data)
            await writer.drain()
    finally:
        writer.close()
