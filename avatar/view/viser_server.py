"""viser's server with checks: `AccessCheck` sees each handshake, `MessageCheck` each message, connections are bounded.

viser listens with `websockets.asyncio.server.serve` and has no option for a check. While it starts, that function is
replaced by one that adds the checks and takes a socket which listens already. Nothing else listens.
"""

from __future__ import annotations

import asyncio
import html
import http
import io
import logging
import socket
import warnings
from collections.abc import Awaitable, Callable
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any, cast

import viser
import websockets.asyncio.server as library
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response
from websockets.protocol import State

from avatar.errors import UserError
from avatar.view.auth import AccessCheck, Refusal
from avatar.view.messages import MAX_MESSAGE, MessageCheck, MessageError
from avatar.view.rate_limited_log import RateLimitedLog

MAX_WAITING = 64  # connections that have not been let in yet
MAX_CLIENTS = 16
HEAD_SECONDS = 10.0  # for the head of a request
PAGE_SECONDS = 60.0  # for the page, on a slow line
CLOSE_SECONDS = 20.0
FIRST_SECONDS = 20.0  # for a client's first message
MAX_RATE = 100  # messages a second of a client
MAX_REFUSED = 20  # messages of a client before it is closed
HEADERS = {
    "Cache-Control": "no-store",
    "Connection": "close",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",  # the address holds the token
    "X-Content-Type-Options": "nosniff",
}
PAGE_HEAD = Path(__file__).with_name("page_head.html").read_text(encoding="utf-8")
PageServer = Callable[[ServerConnection, Request], Response | None]


class Connection(ServerConnection):
    """One client: its messages are checked, counted and paced as they come in."""

    def __init__(self, *arguments: Any, messages: MessageCheck, complaints: RateLimitedLog, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._messages, self._complaints = messages, complaints
        self.heard = self.loop.time()  # when its last message came, or the connection itself
        self.is_served = False  # it gets the page
        self._is_silent, self._refused = True, 0
        self._second, self._count = 0, 0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        waiting = [c for c in connections(self.server, State.CONNECTING) if not c.transport.is_closing()]
        if len(waiting) > MAX_WAITING:  # the oldest goes: who holds connections open locks nobody out
            self._complaints.add("too many connections without a request")
            min(waiting, key=lambda other: other.is_served).transport.abort()
        self._deadline = self.loop.call_later(HEAD_SECONDS, self._end_without_request)

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._deadline.cancel()

    def _end_without_request(self) -> None:
        if self.request is None and not self.transport.is_closing():
            self._complaints.add("a connection without a request")
            self.transport.abort()

    async def recv(self, decode: bool | None = None) -> bytes:
        """The next message that may pass."""
        while True:
            try:
                async with asyncio.timeout(FIRST_SECONDS if self._is_silent else None):
                    data = await super().recv()
                if self.transport.is_closing():
                    continue  # what it left behind
                passed = self._messages.passed(data)
            except TimeoutError:
                self._complaints.add("a silent client")
                await self.close(1008)
            except MessageError as error:
                self._complaints.add(str(error))
                self._refused += 1
                if self._refused == MAX_REFUSED:
                    await self.close(1008)
            else:
                self._is_silent, self.heard = False, self.loop.time()
                await self._pace()
                return passed

    async def _pace(self) -> None:
        """What comes faster waits in the client's socket."""
        now = self.loop.time()
        if int(now) != self._second:
            self._second, self._count = int(now), 0
        self._count += 1
        if self._count > MAX_RATE:
            await asyncio.wait([self.connection_lost_waiter], timeout=self._second + 1 - now)


class WebServer:
    """viser, reached through `access` on a socket that listens."""

    def __init__(
        self,
        listening: socket.socket,
        access: AccessCheck,
        messages: MessageCheck,
        complaints: RateLimitedLog,
        label: str,
    ) -> None:
        self._access, self._messages, self._complaints = access, messages, complaints
        self._listening = listening
        self._head = f"<title>{html.escape(label)} - avatar</title>{PAGE_HEAD}".encode(errors="replace")
        self._library: library.Server | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection")  # a client may leave at any time
        original, library.serve = library.serve, self._serve  # type: ignore[assignment,misc]
        try:
            with redirect_stdout(io.StringIO()):  # it prints an address of its own
                self.viser = viser.ViserServer(host="127.0.0.1", port=0, label=label, verbose=False)
        finally:
            library.serve = original  # type: ignore[misc]
        if self._loop is None:
            self.viser.stop()
            raise UserError(f"avatar view does not work with viser {viser.__version__}: pip install 'viser==1.1.1'")

    def close(self) -> None:
        """End at once, whatever clients do."""
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._abort)
        with redirect_stdout(io.StringIO()):
            self.viser.stop()

    def _abort(self) -> None:
        for connection in list(self._library.handlers if self._library is not None else ()):
            connection.transport.abort()

    def _serve(
        self,
        handler: Callable[[ServerConnection], Awaitable[None]],
        host: str,
        port: int,
        *,
        process_request: PageServer,
        select_subprotocol: Any,
        **_: Any,
    ) -> library.serve:
        """What viser calls in the place of `websockets.asyncio.server.serve`."""
        self._loop = asyncio.get_running_loop()
        self._loop.set_exception_handler(self._count)
        logger = logging.Logger("viewer", logging.WARNING)
        logger.addHandler(_Counter(self._complaints))

        def connect(*arguments: Any, **options: Any) -> Connection:
            connection = Connection(*arguments, messages=self._messages, complaints=self._complaints, **options)
            self._library = connection.server
            return connection

        def answer(connection: ServerConnection, request: Request) -> Response | None:
            return self._answer(cast(Connection, connection), request, process_request)

        return _original(
            handler,
            sock=self._listening,
            process_request=answer,
            select_subprotocol=select_subprotocol,
            compression=None,
            server_header=None,
            open_timeout=PAGE_SECONDS,
            close_timeout=CLOSE_SECONDS,
            max_size=MAX_MESSAGE,
            logger=logger,
            create_connection=connect,  # type: ignore[arg-type]
        )

    def _answer(self, connection: Connection, request: Request, page: PageServer) -> Response | None:
        """The response; None opens a WebSocket."""
        refusal = self._access.refusal(request.path, request.headers)
        if refusal is None and [v.lower() for v in request.headers.get_all("Upgrade")] == ["websocket"]:
            refusal = self._refused_client(request.headers)
            if refusal is None:
                return None
        if refusal is not None:
            if refusal.location is None:
                self._complaints.add(f"a request was refused: {refusal.sentence}")
            return _response(refusal)
        response = page(connection, Request("/", Headers()))  # neither in parts nor compressed
        if response is not None:
            response.body = response.body.replace(b"<title>Viser</title>", self._head, 1)
            del response.headers["Content-Length"]
            response.headers.update({"Content-Length": str(len(response.body)), **HEADERS})
            connection.is_served = True
        return response

    def _refused_client(self, headers: Headers) -> Refusal | None:
        """A place for another client, made where there is none: the one that has been silent for longest goes."""
        if headers.get_all("Sec-WebSocket-Protocol") != [f"viser-v{viser.__version__}"]:
            return Refusal(http.HTTPStatus.BAD_REQUEST, "The page is of another version: load it again.")
        assert self._library is not None
        clients = connections(self._library, State.OPEN)
        if len(clients) >= MAX_CLIENTS:
            self._complaints.add(f"more than {MAX_CLIENTS} clients")
            min(clients, key=lambda client: client.heard).transport.abort()
        return None

    def _count(self, _: object, context: dict[str, Any]) -> None:
        self._complaints.add(f"trouble with a connection ({type(context.get('exception')).__name__})")


class _Counter(logging.Handler):
    def __init__(self, complaints: RateLimitedLog) -> None:
        super().__init__()
        self._complaints = complaints

    def emit(self, record: logging.LogRecord) -> None:
        kind = type(record.exc_info[1]).__name__ if record.exc_info else record.msg
        self._complaints.add(f"a broken connection ({kind})")


def connections(server: library.Server, state: State) -> list[Connection]:
    """Those in this state, the oldest first."""
    return [c for c in server.handlers if isinstance(c, Connection) and c.state is state]


def _response(refusal: Refusal) -> Response:
    body = refusal.sentence.encode()
    headers = Headers({"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body)), **HEADERS})
    if refusal.location is not None:
        headers["Location"] = refusal.location
    return Response(refusal.status, refusal.status.phrase, headers, body)


_original = library.serve
