"""Frames over a socket: what each kind of packet means, and that no packet does harm."""

from __future__ import annotations

import json
import os
import random
import socket
import struct
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from lively import lively_run
from pythonosc.osc_message_builder import OscMessageBuilder
from waiting import until

from avatar.commands.arguments import parse
from avatar.commands.viewing import run_send
from avatar.errors import UserError
from avatar.head.expression_names import ExpressionNames
from avatar.motion.drive import Drive
from avatar.motion.drive_file import write_drive
from avatar.runs.trained import TrainedAvatar, load_avatar
from avatar.view.packets import LIVE_LINK, MAX_LINE, FrameReader, PacketError
from avatar.view.receiver import Receiver
from avatar.view.sender import encode_line, send

NAMES = ExpressionNames(("mouth_smile_left", "mouth_smile_right", None, "brow_inner_up"))


@pytest.fixture(scope="module")
def trained(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainedAvatar:
    run = lively_run(tracked_folder, tmp_path_factory.mktemp("runs") / "run", "model.uv_size=8")
    avatar = load_avatar(run, tracked_folder / "head_model")
    avatar.avatar.head.assets = replace(avatar.assets, names=NAMES)
    return avatar


@pytest.fixture
def receiver(trained: TrainedAvatar) -> Iterator[Receiver]:
    receiver = Receiver(trained, 0)
    yield receiver
    receiver.close()


def live_link(values: dict[str, float], subject: bytes = b"phone") -> bytes:
    device = b"01234567-89ab-cdef-0123-456789abcdef"
    floats = [values.get(name, 0.0) for name in LIVE_LINK]
    head = b"\x06" + struct.pack(">i", len(device)) + device + struct.pack(">i", len(subject)) + subject
    return head + struct.pack(">ifii", 7, 0.5, 60, 1) + struct.pack(">B61f", 61, *floats)


def osc(address: str, *values: object) -> bytes:
    builder = OscMessageBuilder(address)
    for value in values:
        builder.add_arg(value)  # type: ignore[arg-type]
    return builder.build().dgram


def test_lines_of_json(trained: TrainedAvatar) -> None:
    reader = FrameReader(trained.assets)
    listed, is_departure = reader.line(b'{"expression": [0.5, 0, 1], "jaw": [0.2, 0, 0], "eyelids": [1, 0.5]}')
    assert listed.expression[:4].tolist() == [0.5, 0, 1, 0] and listed.eyelids.tolist() == [1, 0.5] and not is_departure
    assert listed.jaw[4] == pytest.approx(np.cos(0.2), abs=1e-6) and listed.neck.tolist() == [1, 0, 0, 0, 1, 0]
    named, _ = reader.line(b'{"expression": {"mouthSmile_L": 0.25, "2": -1}}')
    assert named.expression[:3].tolist() == [0.25, 0, -1]
    shapes, is_departure = reader.line(b'{"blendshapes": {"mouthSmileLeft": 0.5, "eyeBlinkRight": 1, "jawOpen": 1}}')
    assert shapes.expression[0] == 0.5 and shapes.eyelids.tolist() == [0, 1] and is_departure
    assert shapes.jaw[4] == pytest.approx(np.cos(0.35), abs=1e-6)


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        (b"nonsense", "a line is not JSON"),
        (b"[" * 60000, "a line is not JSON"),
        (b"[1]", "not a JSON object"),
        (b"{}", "neither expression nor blendshapes"),
        (b'{"expression": [NaN]}', "expression is not within"),
        (b'{"expression": [1e99]}', "expression is not within"),
        (b'{"expression": [1' + b"0" * 400 + b"]}", "expression is not within"),
        (b'{"expression": [true]}', "expression is not a number"),
        (b'{"expression": {"nobody": 1}}', "there is no expression 'nobody'"),
        (b'{"expression": {"10": 1}}', "there is no expression '10'"),
        (b'{"expression": [0,0,0,0,0,0,0,0,0,0,0]}', "at most 10 numbers"),
        (b'{"expression": [0], "jaw": [0]}', "jaw is not a list of 3 numbers"),
        (b'{"blendshapes": [1]}', "blendshapes is not an object"),
        (b'{"blendshapes": {"jawOpen": "1"}}', "jawOpen is not a number"),
    ],
)
def test_lines_that_are_refused(line: bytes, complaint: str, trained: TrainedAvatar) -> None:
    with pytest.raises(PacketError, match=complaint):
        FrameReader(trained.assets).line(line)


def test_live_link_face(trained: TrainedAvatar) -> None:
    reader = FrameReader(trained.assets)
    params = reader.datagram(live_link({"MouthSmileRight": 0.75, "EyeBlinkLeft": 0.5, "HeadYaw": 0.3}))
    assert params is not None and params.expression[1] == 0.75 and params.eyelids.tolist() == [0.5, 0]
    assert len(LIVE_LINK) == len(set(LIVE_LINK)) == 61
    whole = live_link({})
    for damaged in (whole[:-1], whole + b"\0", whole[:20], whole[:1], live_link({"JawOpen": float("nan")})):
        with pytest.raises(PacketError):
            reader.datagram(damaged)


def test_osc(trained: TrainedAvatar) -> None:
    reader = FrameReader(trained.assets)
    assert reader.datagram(osc("/VMC/Ext/Blend/Val", "MouthSmileLeft", 0.5)) is None
    assert reader.datagram(osc("/VMC/Ext/Blend/Val", "Sorrow", 1.0)) is None, "others' names are left unread"
    params = reader.datagram(osc("/VMC/Ext/Blend/Apply"))
    assert params is not None and params.expression[0] == 0.5
    params = reader.datagram(osc("/face/browInnerUp", 0.25))
    assert params is not None and params.expression[[0, 3]].tolist() == [0.5, 0.25], "what is not sent keeps its value"
    for strange in (osc("/volume", 1.0), osc("/face/jawOpen", "wide"), b"", b"/", b"#bundle\0"):
        with pytest.raises(PacketError):
            reader.datagram(strange)


def test_damaged_packets_are_refused_and_nothing_else(trained: TrainedAvatar) -> None:
    rng = random.Random(0)
    reader = FrameReader(trained.assets)
    lines = [
        b'{"expression": [0.5, 0, 1], "jaw": [0.2, 0, 0], "eyes": [0,0,0,0,0,0]}',
        b'{"blendshapes": {"jawOpen": 1, "mouthSmileLeft": 0.5}, "x": {"y": [1, "z"]}}',
    ]
    datagrams = [live_link({"JawOpen": 0.5}), osc("/face/jawOpen", 0.5), osc("/VMC/Ext/Blend/Val", "JawOpen", 0.5)]
    refused = taken = 0
    for case in range(max(int(os.environ.get("AVATAR_FUZZ_CASES", 2000)) // 2, 1000)):
        kind = lines if case % 2 else datagrams
        data = bytearray(rng.choice(kind))
        for _ in range(rng.randint(1, 6)):
            where = rng.randrange(len(data) + 1)
            data[where : where + rng.choice((0, 0, 1, 1, 4))] = rng.choice(
                (b"", rng.randbytes(1), rng.randbytes(4), b"[", b"9" * 9)
            )
        try:
            found = reader.line(bytes(data))[0] if case % 2 else reader.datagram(bytes(data))
            assert found is None or all(torch.isfinite(value).all() for value in vars(found).values())
            taken += 1
        except PacketError as error:
            assert len(str(error)) < 200
            refused += 1
    assert refused > 100 and taken > 20


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


def test_departures_begin_at_the_avatars_own_neutral_face(receiver: Receiver, trained: TrainedAvatar) -> None:
    with socket.create_connection(("127.0.0.1", receiver.port)) as sender:
        sender.sendall(b'{"blendshapes": {"mouthSmileLeft": 0.5}}\n')
        until(lambda: receiver.counts.received == 1)
        expected = trained.neutral.expression.clone()
        expected[0] += 0.5
        torch.testing.assert_close(receiver.newest()[1].expression, expected)  # type: ignore[index]
        sender.sendall(b'{"expression": [0.3, 0.1], "jaw": [0.1, 0, 0]}\n')
        until(lambda: receiver.counts.received == 2)
        assert receiver.newest()[1].expression[0] == pytest.approx(0.3), "as it is"  # type: ignore[index]
        receiver.calibrate()
        number, params, *_ = receiver.newest()  # type: ignore[misc]
        torch.testing.assert_close(params.expression, trained.neutral.expression)
        torch.testing.assert_close(params.jaw, trained.rest_params().jaw, atol=1e-6, rtol=0)
        sender.sendall(b'{"expression": [0.8, 0.1], "jaw": [0.1, 0, 0]}\n')
        until(lambda: receiver.counts.received == 3)
        expected = trained.neutral.expression.clone()
        expected[0] += 0.5
        later, params, *_ = receiver.newest()  # type: ignore[misc]
        torch.testing.assert_close(params.expression, expected)
        assert later > number


def test_a_drive_file_is_replayed(
    receiver: Receiver, trained: TrainedAvatar, tracked_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = trained.recording
    motion = recording.motion(range(5))
    drive = Drive("x", 50.0, tuple("abcde"), motion, None, recording.identity)
    write_drive(tmp_path / "x.npz", drive, trained.assets.fingerprint)
    words = ["send", str(tmp_path / "x.npz"), str(receiver.port), "--head", str(tracked_folder / "head_model")]
    begin = time.monotonic()
    assert run_send(parse(words)) == 0 and "5 frames" in capsys.readouterr().out
    assert time.monotonic() - begin > 4 / 50, "at its own rate"
    until(lambda: receiver.counts.received == 5)
    last = receiver.newest()[1]  # type: ignore[index]
    for name in ("expression", "jaw", "eyes", "eyelids"):
        torch.testing.assert_close(getattr(last, name), getattr(motion[-1], name), atol=1e-5, rtol=0)
    receiver.close()
    with pytest.raises(UserError, match="does not take any more"):
        send(drive, "127.0.0.1", receiver.port)
    assert encode_line(motion[0]).endswith(b"}\n")


def test_a_port_that_is_taken(receiver: Receiver, trained: TrainedAvatar) -> None:
    with pytest.raises(UserError, match="the stream cannot listen on 127.0.0.1"):
        Receiver(trained, receiver.port)
