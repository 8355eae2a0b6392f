"""Frames over a socket: whose are taken, and that no sender stops the others."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Iterator
from contextlib import closing, suppress

import pytest
import torch
from stream_packets import live_link
from waiting import until

from avatar.errors import UserError
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.view import receiver as receiver_module
from avatar.view.packets import MAX_LINE, FrameReader
from avatar.view.receiver import MAX_SENDERS, SHARE, Receiver, Throttle


@pytest.fixture
def receiver(named_avatar: TrainedAvatar) -> Iterator[Receiver]:
    receiver = Receiver(named_avatar, 0)
    yield receiver
    receiver.close()


def test_a_slow_reader_sees_the_newest_frame(receiver: Receiver) -> None:
    with socket.create_connection(("127.0.0.1", receiver.port)) as sender:
        for i in range(50):
            sender.sendall(json.dumps({"expression": [i / 100]}).encode() + b"\n")
        until(lambda: receiver.counts.received == 50)
        number, params, *_ = receiver.newest()  # type: ignore[misc]
        assert params.expression[0] == pytest.approx(0.49) and receiver.counts.dropped == 49
        assert receiver.newest()[0] == number  # type: ignore[index]
        sender.sendall(b'{"expression": [1]}\n')
        until(lambda: receiver.counts.received == 51)
        assert receiver.counts.dropped == 49, "the last one was seen"


def test_malformed_packets_are_counted_and_the_stream_goes_on(receiver: Receiver) -> None:
    with socket.create_connection(("127.0.0.1", receiver.port)) as sender:
        sender.sendall(b"{\n" + b"x" * (3 * MAX_LINE) + b"\n\n" + b'{"expression": [1]}\n')
        until(lambda: receiver.counts.received == 1)
        assert receiver.counts.malformed == 2
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as phone:
        phone.sendto(b"\x06hello", ("127.0.0.1", receiver.port))
        phone.sendto(live_link({"MouthSmileLeft": 0.5}), ("127.0.0.1", receiver.port))
        until(lambda: receiver.counts.received == 2)
    assert receiver.counts.malformed == 3
    assert "2 frames" in receiver.status() and "3 malformed (last: a packet of Live Link Face" in receiver.status()


def connected(receiver: Receiver) -> socket.socket:
    return socket.create_connection(("127.0.0.1", receiver.port), timeout=10)


def is_closed(sender: socket.socket) -> bool:
    try:
        return sender.recv(1) == b""
    except ConnectionError:
        return True


def test_a_stream_with_a_token_takes_frames_from_who_knows_it(named_avatar: TrainedAvatar) -> None:
    with closing(Receiver(named_avatar, 0, "a-token-that-is-long")) as receiver:
        wrong = ({"token": "another"}, {"token": 1}, {"token": None}, {"expression": [1]}, ["a-token-that-is-long"])
        for line in (*(json.dumps(line).encode() for line in wrong), b"a-token-that-is-long", b"{" * 70000):
            with connected(receiver) as stranger:
                stranger.sendall(line + b'\n{"expression": [1]}\n')
                assert is_closed(stranger)
        assert receiver.counts.received == 0 and receiver.counts.malformed == 7
        with connected(receiver) as sender:
            sender.sendall(b'{"token": "a-token-that-is-long"}\n{"expression": [1]}\n{"expression": [0.5]}\n')
            until(lambda: receiver.counts.received == 2)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as phone, pytest.raises(ConnectionRefusedError):
            phone.connect(("127.0.0.1", receiver.port))  # a packet of UDP cannot carry a token
            for _ in range(3):
                phone.send(live_link({}))
                time.sleep(0.05)


def test_requests_of_web_pages_are_refused(receiver: Receiver) -> None:
    body = b'{"expression": [1]}\n'
    for request in (
        b"POST / HTTP/1.1",
        b"GET /" + b"a" * 70000 + b" HTTP/1.1",
        b"m-search * HTTP/1.1",
        b"\x16\x03\x01\x02",
        b"",
    ):
        with connected(receiver) as page:
            with suppress(ConnectionError):
                page.sendall(request + b"\r\nHost: 127.0.0.1\r\n\r\n" + body * 3)
            assert is_closed(page)
    assert receiver.counts.received == 0 and "web pages may not" in receiver.status()


def test_silent_senders_lock_nobody_out(receiver: Receiver) -> None:
    good = connected(receiver)
    good.sendall(b'{"expression": [1]}\n')
    until(lambda: receiver.counts.received == 1)
    silent = [connected(receiver) for _ in range(3 * MAX_SENDERS)]
    with connected(receiver) as another:
        another.sendall(b'{"expression": [1]}\n')
        good.sendall(b'{"expression": [1]}\n')
        until(lambda: receiver.counts.received == 3)
    assert is_closed(silent[0]) and len(receiver._senders) <= MAX_SENDERS
    for sender in (good, *silent):
        sender.close()


def test_idle_senders_are_closed(named_avatar: TrainedAvatar, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(receiver_module, "IDLE_SECONDS", 0.2)
    with closing(Receiver(named_avatar, 0)) as receiver, connected(receiver) as sender:
        sender.sendall(b'{"expression": [1]}\n')
        assert is_closed(sender) and receiver.counts.received == 1


def test_a_stream_goes_on_when_files_have_run_out(receiver: Receiver, monkeypatch: pytest.MonkeyPatch) -> None:
    accept, failed = receiver._tcp.accept, []

    class Broken:
        def accept(self) -> object:
            if len(failed) < 3:
                failed.append(1)
                raise OSError(24, "Too many open files")
            return accept()

    monkeypatch.setattr(receiver, "_tcp", Broken())
    connected(receiver).close()
    until(lambda: len(failed) == 3)
    with connected(receiver) as sender:
        sender.sendall(b'{"expression": [1]}\n')
        until(lambda: receiver.counts.received == 1)
    monkeypatch.undo()
    assert len(failed) == 3 and receiver.counts.malformed == 0


def test_what_nobody_foresaw_is_counted(receiver: Receiver, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FrameReader, "line", lambda *_: 1 / 0)
    with connected(receiver) as sender:
        sender.sendall(b'{"expression": [1]}\n')
        until(lambda: receiver.counts.malformed == 1)
    assert "ZeroDivisionError" in receiver.status()


def test_a_flood_takes_a_part_of_the_time() -> None:
    now, used = [0.0], [0.0]

    def sleep(seconds: float) -> None:
        now[0] += seconds

    def work(seconds: float) -> None:
        now[0] += seconds
        used[0] += seconds
        throttle.sleep()

    throttle = Throttle(lambda: now[0], lambda: used[0], sleep)
    while now[0] < 100:
        work(0.003)
    assert used[0] / now[0] == pytest.approx(SHARE, rel=0.1)
    begin = now[0]
    for _ in range(60):  # at a rate that is not too high
        sleep(1 / 60)
        work(0.002)
    assert now[0] - begin == pytest.approx(1 + 60 * 0.002)


def test_departures_begin_at_the_avatars_own_neutral_face(receiver: Receiver, named_avatar: TrainedAvatar) -> None:
    with socket.create_connection(("127.0.0.1", receiver.port)) as sender:
        sender.sendall(b'{"blendshapes": {"mouthSmileLeft": 0.5}}\n')
        until(lambda: receiver.counts.received == 1)
        expected = named_avatar.neutral.expression.clone()
        expected[0] += 0.5
        torch.testing.assert_close(receiver.newest()[1].expression, expected)  # type: ignore[index]
        sender.sendall(b'{"expression": [0.3, 0.1], "jaw": [0.1, 0, 0]}\n')
        until(lambda: receiver.counts.received == 2)
        assert receiver.newest()[1].expression[0] == pytest.approx(0.3), "as it is"  # type: ignore[index]
        receiver.calibrate()
        number, params, *_ = receiver.newest()  # type: ignore[misc]
        torch.testing.assert_close(params.expression, named_avatar.neutral.expression)
        torch.testing.assert_close(params.jaw, named_avatar.rest_params().jaw, atol=1e-6, rtol=0)
        sender.sendall(b'{"expression": [0.8, 0.1], "jaw": [0.1, 0, 0]}\n')
        until(lambda: receiver.counts.received == 3)
        expected = named_avatar.neutral.expression.clone()
        expected[0] += 0.5
        later, params, *_ = receiver.newest()  # type: ignore[misc]
        torch.testing.assert_close(params.expression, expected)
        assert later > number


def test_a_port_that_is_taken(receiver: Receiver, named_avatar: TrainedAvatar) -> None:
    with pytest.raises(UserError, match="the stream cannot listen on 127.0.0.1"):
        Receiver(named_avatar, receiver.port)


def test_a_port_that_is_taken_for_udp_alone_is_let_go_of(named_avatar: TrainedAvatar) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        with pytest.raises(UserError, match="another --stream") as refused:
            Receiver(named_avatar, port)
        socket.create_server(("127.0.0.1", port)).close()
    assert refused.value.__traceback__ is not None, "it keeps the receiver alive"
