"""Clients that do harm to a viewer if they can: python hostile_clients.py PORT STREAM TOKEN COUNT SECONDS"""

from __future__ import annotations

import math
import random
import socket
import sys
import threading
import time
from contextlib import closing, suppress
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1] / "helpers"))

import msgspec
from view_client import Page, camera, opened
from websockets.exceptions import WebSocketException
from websockets.typing import Origin

HEADS = (
    b"GET / HTTP/1.1\r\nHost: ",
    b"\x16\x03\x01\x02\x00",
    b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    b"",
    b"x" * 9000,
)
LINES = (
    b"{\n" * 50,
    b'{"token": "guess"}\n',
    b"x" * 200000,
    b"POST / HTTP/1.1\r\n\r\n",
    b"",
    b'{"expression": {"<b>": 1}}\n',
)
NUMBERS = (math.nan, math.inf, -math.inf, 1e308, -1e308, 0.0, 1.0, 2.0**63, 1e-308)


class Hostile:
    def __init__(self, port: int, stream: int, token: str, seed: int) -> None:
        self.port, self.stream = port, stream
        self.page = f"http://127.0.0.1:{port}/{token}/"
        self.rng = random.Random(seed)

    def half_open(self) -> None:
        sockets = [
            socket.create_connection(("127.0.0.1", self.port), timeout=5) for _ in range(self.rng.randint(1, 40))
        ]
        for client in sockets:
            client.sendall(self.rng.choice(HEADS))
        time.sleep(self.rng.random() * 3)
        for client in sockets:
            client.close()

    def sender(self) -> None:
        with socket.create_connection(("127.0.0.1", self.stream), timeout=5) as client:
            client.sendall(self.rng.choice(LINES))
            time.sleep(self.rng.random() * 3)

    def stranger(self) -> None:
        wrong = f"http://127.0.0.1:{self.port}/{self.rng.choice(('', 'guess/', '?token=guess'))}"
        with closing(opened(wrong)):
            raise AssertionError("a stranger is let in")

    def other_site(self) -> None:
        with closing(opened(self.page, origin=Origin("http://evil.example"))):
            raise AssertionError("another site is let in")

    def silent(self) -> None:
        with closing(opened(self.page)):
            time.sleep(self.rng.random() * 5)

    def unread(self) -> None:
        """A window for which much is sent and nothing read."""
        client = opened(self.page)
        client.send(msgspec.msgpack.encode(camera(image_width=self.rng.randint(1, 9000))))
        time.sleep(self.rng.random() * 5)
        client.socket.shutdown(socket.SHUT_RDWR)

    def odd(self) -> None:
        with Page(self.page, image_width=self.number(), image_height=self.rng.randint(1, 5000)) as page:
            page.until(lambda: "Reset face" in page.controls, 10)
            for _ in range(self.rng.randint(1, 300)):
                page.send(self.message(page))
            page.read(0.1)

    def number(self) -> float:
        return self.rng.choice(NUMBERS) if self.rng.random() < 0.5 else self.rng.uniform(-2000, 2000)

    def message(self, page: Page) -> bytes:
        uuid = self.rng.choice([*page.controls.values(), "nobody"])
        value = self.rng.choice([self.number(), True, False, None, "error", "x" * 3000, [1], {}])
        message = self.rng.choice(
            [
                {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}},
                {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"disabled": value}},
                camera(position=[self.number() for _ in range(3)]),
                camera(image_width=self.number(), image_height=self.number()),
                {"type": self.rng.choice(["ShareUrlRequest", "FileTransferStartUpload", "GuiFormDirtyMessage", "x"])},
            ]
        )
        data = bytearray(msgspec.msgpack.encode(message))
        if self.rng.random() < 0.2:
            data[self.rng.randrange(len(data))] ^= 1 << self.rng.randrange(8)
        return bytes(data)

    def run(self, end: float) -> None:
        kinds = (self.half_open, self.sender, self.stranger, self.other_site, self.silent, self.unread, self.odd)
        while time.monotonic() < end:
            # Refused, closed, pushed out of its place, or too late in a busy program.
            with suppress(OSError, WebSocketException, TimeoutError, AssertionError):
                try:
                    self.rng.choice(kinds)()
                except AssertionError as error:
                    if "let in" in str(error):
                        print(error, flush=True)


def main() -> None:
    port, stream, token, count, seconds = sys.argv[1:]
    end = time.monotonic() + float(seconds)
    hostile = [Hostile(int(port), int(stream), token, seed) for seed in range(int(count))]
    threads = [threading.Thread(target=one.run, args=(end,), daemon=True) for one in hostile]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(max(end + 20 - time.monotonic(), 0))


if __name__ == "__main__":
    main()
