"""What a page may send, by viser's protocol."""

from __future__ import annotations

import math
import os
import random
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("viser")
import msgspec
from view_client import camera
from viser._messages import Message

from avatar.view.messages import MAX_WINDOW, MessageCheck, MessageError, one_of, pressed, switched, within

encode, decode = msgspec.msgpack.encode, msgspec.msgpack.decode


def handle(name: str) -> Any:
    return SimpleNamespace(_impl=SimpleNamespace(uuid=name))


@pytest.fixture
def messages() -> MessageCheck:
    messages = MessageCheck()
    messages.allow(handle("slider"), within(-0.5, 2.0))
    messages.allow(handle("button"), pressed)
    messages.allow(handle("checkbox"), switched)
    messages.allow(handle("list"), one_of(("none", "mesh")))
    return messages


def change(name: str, value: object, **more: object) -> bytes:
    return encode({"type": "GuiUpdateMessage", "uuid": name, "updates": {"value": value}, **more})


def value_of(messages: MessageCheck, name: str, value: object) -> object:
    return decode(messages.passed(change(name, value)))["updates"]["value"]


def test_controls_get_values_of_their_own_kind(messages: MessageCheck) -> None:
    assert value_of(messages, "slider", 1.5) == 1.5 and value_of(messages, "slider", 1) == 1
    assert value_of(messages, "slider", 1e308) == 2 and value_of(messages, "slider", -7) == -0.5, "it stays at its ends"
    assert value_of(messages, "button", True) is True and value_of(messages, "checkbox", False) is False
    assert value_of(messages, "list", "mesh") == "mesh"
    wrong: dict[str, tuple[object, ...]] = {
        "slider": (math.nan, math.inf, "nan", "1", True, None, [1], {}, b"1"),
        "button": (False, 1, "x", None),
        "checkbox": (1, 0.0, "on", None),
        "list": ("error", "", 0, True, "<img src=x>", "m" * 2000),
    }
    for name, values in wrong.items():
        for value in values:
            with pytest.raises(MessageError):
                messages.passed(change(name, value))


def test_only_values_of_controls_can_be_changed(messages: MessageCheck) -> None:
    for message in (
        change("another", 1.0),
        change("slider", 1.0, more=1),
        encode({"type": "GuiUpdateMessage", "uuid": "slider", "updates": {"visible": False}}),
        encode({"type": "GuiUpdateMessage", "uuid": "slider", "updates": {"value": 1.0, "min": -9.0}}),
        encode({"type": "GuiUpdateMessage", "uuid": "slider", "updates": {}}),
        encode({"type": "GuiUpdateMessage", "uuid": 1, "updates": {"value": 1.0}}),
    ):
        with pytest.raises(MessageError):
            messages.passed(message)


def test_cameras_are_finite_and_windows_bounded(messages: MessageCheck) -> None:
    assert decode(messages.passed(encode(camera()))) == camera()
    for size, kept in ((0, 1), (-5, 1), (10, 10), (10**5, MAX_WINDOW)):
        assert decode(messages.passed(encode(camera(image_width=size))))["image_width"] == kept
    for changes in (
        {"position": [math.nan, 0.0, 1.0]},
        {"position": [1e308, 0.0, 1.0]},
        {"position": [0.0, 1.0]},
        {"look_at": [0.0, math.inf, 0.0]},
        {"image_width": math.nan},
        {"image_height": "600"},
        {"fov": None},
        {"wxyz": []},
        {"excluded_self_client": 1},
    ):
        with pytest.raises(MessageError):
            messages.passed(encode(camera(**changes)))


def test_every_other_message_of_viser_is_refused(messages: MessageCheck) -> None:
    """Among them the one that opens a public tunnel."""
    others = {kind.__name__ for kind in Message.get_subclasses()} - {"ViewerCameraMessage", "GuiUpdateMessage"}
    assert {"ShareUrlRequest", "ShareUrlDisconnect", "FileTransferStartUpload", "GuiFormDirtyMessage"} < others
    for kind in others:
        for fields in ({}, {"uuid": "slider", "updates": {"value": 1.0}}):
            with pytest.raises(MessageError):
                messages.passed(encode({"type": kind, **fields}))


def test_text_and_what_is_no_message_is_refused(messages: MessageCheck) -> None:
    for data in (
        "{}",
        b"",
        b"\xc1",
        b"\x91" * 16000,
        b"\xdf\xff\xff\xff\xff",
        b"\xc7\xff\x05",
        encode([]),
        encode(None),
    ):
        with pytest.raises(MessageError):
            messages.passed(data)


def test_damaged_messages_are_refused_and_nothing_else(messages: MessageCheck) -> None:
    rng = random.Random(0)
    whole = [encode(camera()), change("slider", 0.25), change("list", "mesh"), change("button", True)]
    refused = passed = 0
    for _ in range(max(int(os.environ.get("AVATAR_FUZZ_CASES", 2000)) // 2, 1000)):
        data = bytearray(rng.choice(whole))
        for _ in range(rng.randint(1, 4)):
            where = rng.randrange(len(data) + 1)
            data[where : where + rng.choice((0, 0, 1, 1, 4, 8))] = rng.choice(
                (
                    b"",
                    rng.randbytes(1),
                    rng.randbytes(4),
                    b"\xcb" + rng.randbytes(8),
                    b"\x7f\xf8" + b"\0" * 6,
                    b"\xdf\xff\xff",
                )
            )
        try:
            message = decode(messages.passed(bytes(data)))
        except MessageError as error:
            assert len(str(error)) < 100
            refused += 1
            continue
        passed += 1
        if message["type"] == "ViewerCameraMessage":
            numbers = [*message["position"], *message["look_at"], *message["wxyz"], message["fov"]]
            assert all(math.isfinite(number) and abs(number) <= 1e6 for number in numbers)
            assert 1 <= message["image_width"] <= MAX_WINDOW and 1 <= message["image_height"] <= MAX_WINDOW
        else:
            value = message["updates"]["value"]
            assert value is True or value in ("none", "mesh") or -0.5 <= value <= 2.0
    assert refused > 100 and passed > 20
