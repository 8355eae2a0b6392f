"""The viewer over real sockets: what odd, silent and many clients do to a good one, which is nothing."""

from __future__ import annotations

import http.client
import math
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Any

import msgspec
import pytest

pytest.importorskip("viser")
from view_client import TOKEN, WIDTH, Page, camera, opened
from waiting import until
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.typing import Origin

from avatar.view import rate_limited_log, viser_server
from avatar.view.view_renderer import ViewRenderer
from avatar.view.viewer import LARGEST, Viewer, _listen


@pytest.fixture(autouse=True)
def said(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """What the viewer says of its clients."""
    lines: list[str] = []
    monkeypatch.setattr(rate_limited_log.RateLimitedLog.__init__, "__defaults__", (lines.append, time.monotonic))
    yield lines


def address(viewer: Viewer, token: str = TOKEN) -> str:
    return f"http://127.0.0.1:{viewer.port}/{token}/"


def get(viewer: Viewer, path: str, **headers: str) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", viewer.port, timeout=10)
    connection.request("GET", path, headers=headers)
    return connection.getresponse()


def half_open(viewer: Viewer, count: int) -> list[socket.socket]:
    sockets = [socket.create_connection(("127.0.0.1", viewer.port), timeout=10) for _ in range(count)]
    for opened_socket in sockets:
        opened_socket.sendall(b"GET / HTTP/1.1\r\nHost: ")
    return sockets


def still_drawn(viewer: Viewer, page: Page) -> bool:
    """Whether a change that another makes comes to this page."""
    before = page.next_picture() if page.pictures == 0 else page.picture
    page.set("jaw open", 0.1 if viewer.setting.joints.get("jaw") != 0.1 else 0.2)
    page.next_picture()
    return page.picture.shape == before.shape


def test_the_page_and_its_websocket_need_the_token(viewer: Viewer) -> None:
    assert get(viewer, "/").status == 401
    led = get(viewer, f"/?token={TOKEN}")
    assert led.status == 303 and led.getheader("Location") == f"./{TOKEN}/" and not led.getheader("Set-Cookie")
    page = get(viewer, f"/{TOKEN}/")
    assert page.status == 200 and b"<html" in page.read()
    assert page.getheader("Referrer-Policy") == "no-referrer" and page.getheader("Cache-Control") == "no-store"
    for token, origin, status in (("", None, 401), ("another", None, 401), (TOKEN, "http://evil.example", 403)):
        with pytest.raises(InvalidStatus) as refused:
            opened(address(viewer, token), origin=origin)
        assert refused.value.response.status_code == status
    with Page(address(viewer)) as client:
        assert client.next_picture().shape == (WIDTH, 128, 3), "in the middle of a window of 4 to 3"


def test_a_proxy_that_was_named_passes_websockets(viewer: Viewer) -> None:
    viewer._web._access = replace(viewer._web._access, url="https://hub.example.org/proxy/8080/")
    hub = f"http://127.0.0.1:{viewer.port}/proxy/8080/{TOKEN}"
    opened(hub, origin=Origin("https://hub.example.org")).close()
    with pytest.raises(InvalidStatus):
        opened(hub, origin=Origin("https://evil.example.org"))


def test_malformed_requests_are_one_counted_line(
    viewer: Viewer, said: list[str], capfd: pytest.CaptureFixture[str]
) -> None:
    for head in (
        b"\x16\x03\x01 hello\r\n\r\n",
        b"POST / HTTP/1.1\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost\r\n\r\n",
        b"x" * 70000,
    ):
        for _ in range(3):
            with socket.create_connection(("127.0.0.1", viewer.port), timeout=10) as client:
                client.sendall(head)
                with suppress(ConnectionError):
                    client.recv(1000)
    assert get(viewer, f"/{TOKEN}/", Origin="http://[::1").status == 403
    viewer.complaints.close()
    assert len([line for line in said if "broken connection" in line]) in (1, 2), said
    assert "times)" in "".join(said) and "Traceback" not in capfd.readouterr().err


def test_a_good_client_is_drawn_for_whatever_odd_ones_send(viewer: Viewer, said: list[str]) -> None:
    nan = math.nan
    with Page(address(viewer)) as good, Page(address(viewer)) as odd:
        odd.until(lambda: "jaw open" in odd.controls)
        slider, button = odd.controls["jaw open"], odd.controls["Save picture"]
        messages: list[Any] = [
            camera(position=[nan, nan, nan]),
            camera(position=[0.0, 0.0, 0.0]),
            camera(position=[1e308, 0.0, 0.0]),
            camera(image_width=3000, image_height=1),
            camera(image_width=10**9, image_height=1),
            camera(image_width=1, image_height=10**9),
            camera(image_width=0, image_height=0),
            camera(fov=nan),
            {"type": "GuiUpdateMessage", "uuid": slider, "updates": {"value": nan}},
            {"type": "GuiUpdateMessage", "uuid": slider, "updates": {"value": 1e308}},
            {"type": "GuiUpdateMessage", "uuid": slider, "updates": {"value": "x"}},
            {"type": "GuiUpdateMessage", "uuid": slider, "updates": {"max": 1e9}},
            {"type": "GuiUpdateMessage", "uuid": button, "updates": {"value": False}},
            {"type": "ShareUrlRequest"},
            {"type": "NoSuchMessage"},
            b"\xc1",
        ]
        for message in messages:
            odd.send(message)
        assert still_drawn(viewer, good)
        assert all(math.isfinite(v) and abs(v) < 100 for v in viewer.setting.joints.values())
        with pytest.raises(ConnectionClosed):  # it is closed after some more
            for _ in range(200):
                odd.send(b"\xc1")
                odd.read(0.05)
        assert still_drawn(viewer, good)
    viewer.complaints.close()
    assert any("a message is none of this viewer's page" in line and "times" in line for line in said)
    assert len(said) < 12


def test_nobody_opens_a_public_tunnel(viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []
    monkeypatch.setattr(type(viewer.server), "request_share_url", lambda *_: asked.append(1))
    with Page(address(viewer)) as page:
        page.send({"type": "ShareUrlRequest"})
        assert still_drawn(viewer, page) and not asked


@pytest.mark.parametrize(("width", "height"), [(10, 900), (3000, 1)])
def test_pictures_keep_their_shape_in_any_window(viewer: Viewer, width: int, height: int) -> None:
    viewer._width = 2048
    with Page(address(viewer), image_width=width, image_height=height) as page:
        page.next_picture()
        page.until(lambda: viewer.picture is not None and viewer.picture.shape[1] == 2048)
        tall, wide = page.picture.shape[:2]
        assert max(tall, wide) <= LARGEST
        assert wide / tall == pytest.approx(width / height, rel=0.3)


def test_a_picture_that_cannot_be_drawn_does_not_end_drawing(
    viewer: Viewer, monkeypatch: pytest.MonkeyPatch, said: list[str]
) -> None:
    with Page(address(viewer)) as page:
        page.next_picture()
        with monkeypatch.context() as broken:
            broken.setattr(ViewRenderer, "draw", lambda *_: 1 / 0)
            page.set("jaw open", 0.2)
            until(lambda: any("ZeroDivisionError" in line for line in said))
        assert still_drawn(viewer, page)


def test_an_error_in_a_control_is_one_counted_line(
    viewer: Viewer, monkeypatch: pytest.MonkeyPatch, said: list[str]
) -> None:
    monkeypatch.setattr(viewer.player, "play", lambda: 1 / 0)
    viewer.player.choose("train")
    with Page(address(viewer)) as page:
        page.next_picture()
        for _ in range(3):
            page.set("Play", True)
        until(lambda: viewer.complaints._counts.get("a control failed (ZeroDivisionError)") == 3)
        assert len(said) == 1 and still_drawn(viewer, page)


@pytest.mark.slow
def test_half_open_requests_do_not_stop_the_viewer(
    viewer: Viewer, said: list[str], capfd: pytest.CaptureFixture[str]
) -> None:
    with Page(address(viewer)) as page:
        page.next_picture()
        sockets = half_open(viewer, 400)
        begin = time.monotonic()
        assert get(viewer, f"/{TOKEN}/").status == 200
        with Page(address(viewer)) as another:
            another.next_picture()
        assert still_drawn(viewer, page) and time.monotonic() - begin < 15
        assert viewer._web._library is not None
        assert len(viewer._web._library.handlers) <= viser_server.MAX_WAITING + 10
        for client in sockets:
            client.close()
    assert len(said) < 5 and "Traceback" not in capfd.readouterr().err


def test_who_says_nothing_is_closed(viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viser_server, "HEAD_SECONDS", 0.2)
    monkeypatch.setattr(viser_server, "FIRST_SECONDS", 0.2)
    (client,) = half_open(viewer, 1)
    assert client.recv(1000) == b""
    silent = opened(address(viewer))
    with pytest.raises(ConnectionClosed):
        while True:
            silent.recv(timeout=10)


def test_there_is_always_a_place_for_another_client(viewer: Viewer) -> None:
    pages = [Page(address(viewer)) for _ in range(viser_server.MAX_CLIENTS)]
    with Page(address(viewer)) as another:
        assert still_drawn(viewer, another)
        with pytest.raises(ConnectionClosed):  # who has been silent for longest has gone
            while True:
                pages[0].read(10)
    for page in pages:
        page.socket.close()


def test_a_flood_of_messages_waits_in_its_socket(viewer: Viewer) -> None:
    message = msgspec.msgpack.encode(camera())
    stop = threading.Event()

    def flood() -> None:
        with Page(address(viewer)) as page:
            page.socket.socket.settimeout(1)
            try:
                while not stop.is_set():
                    page.send(message)
            except (OSError, ConnectionClosed):
                pass

    thread = threading.Thread(target=flood)
    with Page(address(viewer)) as good:
        thread.start()
        assert still_drawn(viewer, good)
        queued = viewer.server._thread_executor._work_queue.qsize()
        stop.set()
        thread.join(20)
        assert queued < 300


def test_another_version_of_the_page_is_told_to_load_it_again(
    viewer: Viewer, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(InvalidStatus):
        opened(address(viewer), additional_headers={"Sec-WebSocket-Protocol": "viser-v0[bold red]"})
    assert not capfd.readouterr().out


def test_closing_takes_no_time_whatever_clients_do(viewer: Viewer) -> None:
    page = Page(address(viewer))
    page.next_picture()
    half_open(viewer, 5)
    viewer.player.choose("train")
    page.set("Save video", True)
    begin = time.monotonic()
    viewer.close()
    assert time.monotonic() - begin < 5


def test_a_viser_that_listens_in_another_way_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the checks it would listen for everybody."""
    monkeypatch.setattr(viser_server.WebServer, "_serve", viser_server._original)
    with (
        socket.create_server(("127.0.0.1", 0)) as listening,
        pytest.raises(Exception, match="does not work with viser"),
    ):
        viser_server.WebServer(listening, None, None, rate_limited_log.RateLimitedLog(), "x")  # type: ignore[arg-type]


def test_complaints_are_counted() -> None:
    now, lines = [0.0], []
    counted = rate_limited_log.RateLimitedLog(lines.append, lambda: now[0])
    for _ in range(500):
        counted.add("a silent client")
    assert lines == ["Viewer: a silent client"]
    now[0] = rate_limited_log.SILENCE
    counted.add("a silent client")
    counted.add("a silent client")
    for number in range(200):
        counted.add(f"kind {number}")
    counted.close()
    counted.close()
    assert lines[1] == "Viewer: a silent client (501 times)" and lines.count("Viewer: a silent client (502 times)") == 1
    assert len(lines) <= rate_limited_log.MAX_KINDS + 5


@pytest.mark.skipif(not socket.has_dualstack_ipv6(), reason="this system has no IPv6")
def test_every_address_is_ipv4s_too() -> None:
    with _listen("::", 0) as listening, socket.socket() as caller:
        assert caller.connect_ex(("127.0.0.1", listening.getsockname()[1])) == 0
