"""Frames in packets: what each kind means, and that no packet does harm."""

from __future__ import annotations

import json
import os
import random
import struct

import numpy as np
import pytest
import torch
from stream_packets import bundle, live_link, osc

from avatar.runs.trained_avatar import TrainedAvatar
from avatar.view.packets import LIVE_LINK, FrameReader, PacketError


def test_lines_of_json(named_avatar: TrainedAvatar) -> None:
    reader = FrameReader(named_avatar.assets)
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
def test_lines_that_are_refused(line: bytes, complaint: str, named_avatar: TrainedAvatar) -> None:
    with pytest.raises(PacketError, match=complaint):
        FrameReader(named_avatar.assets).line(line)


def test_live_link_face(named_avatar: TrainedAvatar) -> None:
    reader = FrameReader(named_avatar.assets)
    params = reader.datagram(live_link({"MouthSmileRight": 0.75, "EyeBlinkLeft": 0.5, "HeadYaw": 0.3}))
    assert params is not None and params.expression[1] == 0.75 and params.eyelids.tolist() == [0.5, 0]
    assert len(LIVE_LINK) == len(set(LIVE_LINK)) == 61
    order = {"JawLeft": 15, "JawRight": 16, "MouthLeft": 21, "MouthRight": 22, "BrowInnerUp": 43}
    assert {name: LIVE_LINK.index(name) for name in order} == order
    whole = live_link({})
    for damaged in (whole[:-1], whole + b"\0", whole[:20], whole[:1], live_link({"JawOpen": float("nan")})):
        with pytest.raises(PacketError):
            reader.datagram(damaged)


def test_osc(named_avatar: TrainedAvatar) -> None:
    reader = FrameReader(named_avatar.assets)
    assert reader.datagram(osc("/VMC/Ext/Blend/Val", "MouthSmileLeft", 0.5)) is None
    assert reader.datagram(osc("/VMC/Ext/Blend/Val", "Sorrow", 1.0)) is None, "others' names are left unread"
    params = reader.datagram(osc("/VMC/Ext/Blend/Apply"))
    assert params is not None and params.expression[0] == 0.5
    params = reader.datagram(osc("/face/browInnerUp", 0.25))
    assert params is not None and params.expression[[0, 3]].tolist() == [0.5, 0.25], "what is not sent keeps its value"
    for strange in (osc("/volume", 1.0), osc("/face/jawOpen", "wide"), b"", b"/", b"#bundle\0"):
        with pytest.raises(PacketError):
            reader.datagram(strange)


def test_bundles_of_osc(named_avatar: TrainedAvatar) -> None:
    reader = FrameReader(named_avatar.assets)
    bone = b"/VMC/Ext/Bone/Pos\0\0\0,sfffffff\0\0\0" + b"Head\0\0\0\0" + bytes(28)
    value, apply = osc("/VMC/Ext/Blend/Val", "MouthSmileLeft", 0.5), osc("/VMC/Ext/Blend/Apply")
    params = reader.datagram(bundle(bone, bundle(value), apply))
    assert params is not None and params.expression[0] == 0.5
    nested = value
    for _ in range(300):
        nested = bundle(nested)
    negative = b"#bundle\0" + bytes(8) + struct.pack(">i", -4)
    endless = negative + struct.pack(">i", -8) * 4
    for hostile in (
        nested,
        negative,
        endless,
        bundle(b""),
        bundle(b"x"),
        bundle(value)[:-2],
        bundle(value) + b"\0",
        b"/" * 60000,
    ):
        with pytest.raises(PacketError):
            reader.datagram(hostile)


def test_nothing_of_a_datagram_is_printed(
    named_avatar: TrainedAvatar, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    reader = FrameReader(named_avatar.assets)
    for hostile in (b"/face/jawOpen\0\0\0,zzz\0\0\0\0", bundle(b"secret"), b"/\x1b[31m\0,f\0\0", b"\xff" * 60000):
        with pytest.raises(PacketError) as refused:
            reader.datagram(hostile)
        assert len(str(refused.value)) < 100 and str(refused.value).isprintable()
    assert capfd.readouterr() == ("", "") and not caplog.records


@pytest.mark.parametrize(
    "name", ["<b>x</b>", "![](/etc/hostname)", "\x1b[31m", "jaw\u202eOpen", "\ud800", "a\nb", "x" * 9999]
)
def test_names_from_a_sender_are_told_as_ascii(name: str, named_avatar: TrainedAvatar) -> None:
    for line in ({"expression": {name: 1}}, {"blendshapes": {f"jaw{name}Open": "1", "jawOpen": []}}):
        with pytest.raises(PacketError) as refused:
            FrameReader(named_avatar.assets).line(json.dumps(line).encode())
        said = str(refused.value)
        assert said.isascii() and said.isprintable() and len(said) < 400


def test_damaged_packets_are_refused_and_nothing_else(named_avatar: TrainedAvatar) -> None:
    rng = random.Random(0)
    reader = FrameReader(named_avatar.assets)
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
