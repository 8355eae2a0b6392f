"""A page of the viewer without a browser: it speaks viser's protocol over a WebSocket."""

from __future__ import annotations

import contextlib
import re
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import viser
import zstandard
from command_line import running
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

TOKEN, WIDTH = "a-token-that-is-long", 96  # of the viewer in tests/view/conftest.py
PROTOCOL = Subprotocol(f"viser-v{viser.__version__}")


def camera(**changes: Any) -> dict[str, Any]:
    """The message that says how a page's window looks at the head."""
    return {
        "type": "ViewerCameraMessage",
        "wxyz": [1.0, 0.0, 0.0, 0.0],
        "position": [0.0, 0.0, 0.6],
        "fov": 1.3,
        "near": 0.01,
        "far": 1000.0,
        "image_height": 600,
        "image_width": 800,
        "look_at": [0.0, 0.0, 0.0],
        "up_direction": [0.0, 1.0, 0.0],
        **changes,
    }


def opened(address: str, **options: Any) -> ClientConnection:
    """A WebSocket to a page's address, without a message yet."""
    return connect(
        address.replace("http", "ws", 1),
        subprotocols=[PROTOCOL],
        compression=None,
        max_size=None,
        open_timeout=10,
        close_timeout=1,
        **options,
    )


class Page:
    """Connected, with a window; what comes is read while something is waited for."""

    def __init__(self, address: str, **window: Any) -> None:
        self.socket = opened(address)
        self.controls: dict[str, str] = {}  # label -> what viser calls it
        self.values: dict[str, Any] = {}  # by the same
        self.folders: list[str] = []
        self.notifications: list[str] = []
        self.pictures = 0
        self._picture, self.format = b"", ""
        self.send(camera(**window))

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    @property
    def picture(self) -> np.ndarray:
        return cv2.imdecode(np.frombuffer(self._picture, np.uint8), cv2.IMREAD_COLOR)

    def send(self, message: dict[str, Any] | bytes) -> None:
        self.socket.send(message if isinstance(message, bytes) else msgspec.msgpack.encode(message))

    def set(self, label: str, value: object) -> None:
        self.until(lambda: label in self.controls)
        self.send({"type": "GuiUpdateMessage", "uuid": self.controls[label], "updates": {"value": value}})

    def until(self, condition: Callable[[], object], seconds: float = 20.0) -> None:
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end
            self.read(0.05)

    def next_picture(self) -> np.ndarray:
        before = self.pictures
        self.until(lambda: self.pictures > before)
        return self.picture

    def read(self, seconds: float) -> None:
        """Take in one batch of messages, if it comes within so long."""
        try:
            data = self.socket.recv(timeout=seconds)
        except TimeoutError:
            return
        assert isinstance(data, bytes)
        end = 16 + int.from_bytes(data[8:16], "little")
        packed = zstandard.ZstdDecompressor().decompress(data[16:end], int.from_bytes(data[:8], "little"))
        found = msgspec.msgpack.decode(packed)
        at, buffers = end, []
        for length in found["binaryBufferLengths"]:
            at += -at % 8
            buffers.append(data[at : at + length])
            at += length
        for message in found["messages"]:
            self._take(message, buffers)

    def _take(self, message: dict[str, Any], buffers: list[bytes]) -> None:
        kind, props = message["type"], message.get("props") or {}
        if kind == "BackgroundImageMessage" and (data := message["rgb_data"]) is not None:
            self._picture = buffers[data["__binary_index"]] if isinstance(data, dict) else data
            self.pictures, self.format = self.pictures + 1, message["format"]
        elif kind == "GuiFolderMessage":
            self.folders.append(props["label"])
        elif kind == "GuiUpdateMessage":
            for name, value in message["updates"].items():
                self.values[f"{message['uuid']} {name}"] = value
        elif kind == "NotificationShowMessage":
            self.notifications.append(f"{props['title']}: {props['body']}")
        elif kind.startswith("Gui") and props.get("label"):
            self.controls[props["label"]] = message["uuid"]


@dataclass
class Started:
    """`avatar view` in a process of its own."""

    process: subprocess.Popen[str]
    said: str

    @property
    def address(self) -> str:
        """Of the page, as it was printed."""
        found = re.search(r"http\S+", self.said)
        assert found is not None, self.said
        return found[0]

    @property
    def port(self) -> int:
        return int(self.address.split(":")[2].split("/")[0])

    @property
    def token(self) -> str:
        return self.address.partition("token=")[2]

    @property
    def page(self) -> str:
        """Where the printed address leads."""
        return f"http://127.0.0.1:{self.port}/{self.token}/"

    @property
    def stream(self) -> int:
        found = re.search(r"Stream   127\.0\.0\.1:(\d+)", self.said)
        assert found is not None, self.said
        return int(found[1])

    def listening(self) -> set[int]:
        """Every port at which the process listens over TCP."""
        owned = set()
        for link in Path(f"/proc/{self.process.pid}/fd").iterdir():
            with contextlib.suppress(FileNotFoundError):  # it was closed meanwhile
                owned.add(str(link.readlink()))
        ports = set()
        for table in ("tcp", "tcp6"):
            for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
                words = line.split()
                if words[3] == "0A" and f"socket:[{words[9]}]" in owned:
                    ports.add(int(words[1].rpartition(":")[2], 16))
        return ports

    def interrupt(self) -> float:
        """Ctrl-C; seconds until the process has ended as it should."""
        begin = time.monotonic()
        self.process.send_signal(signal.SIGINT)
        assert self.process.wait(20) == 130
        return time.monotonic() - begin


@contextmanager
def started(run: Path, *options: object, log: Path | None = None) -> Iterator[Started]:
    """`log` gets what goes to stderr."""
    words = ["view", run, "--port", 0, *options]
    with (log or Path("/dev/null")).open("w") as stderr, running(*words, until="Ctrl-C", stderr=stderr) as found:
        yield Started(*found)
