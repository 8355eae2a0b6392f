"""`--stream PORT`: frames over TCP (lines of JSON) and UDP (OSC, Live Link Face) on this machine. The newest frame counts.

A frame that has not been shown when the next one comes is dropped, so that what is seen is never late; a packet that cannot
be read is counted and forgotten.
"""

from __future__ import annotations

import socket
import threading
import time
from contextlib import suppress
from dataclasses import dataclass

from avatar.errors import UserError
from avatar.head.model import matrix_from_6d
from avatar.motion.rest import RestPose
from avatar.motion.transfer import departed
from avatar.runs.trained import TrainedAvatar
from avatar.types import HeadParams
from avatar.view.live import Live
from avatar.view.packets import MAX_LINE, FrameReader, PacketError
from avatar.view.player import STREAM

MAX_SENDERS = 8
MAX_DATAGRAM = 1 << 16


@dataclass(frozen=True)
class Counts:
    received: int = 0
    dropped: int = 0  # frames that a newer one replaced before they were shown
    malformed: int = 0


class Receiver:
    """Listens until `close`. Expressions that come as coefficients are shown as they are until `calibrate`."""

    name = STREAM

    def __init__(self, trained: TrainedAvatar, port: int, host: str = "127.0.0.1") -> None:
        """Port 0 takes a free one, then in `port`. Raises UserError when it is taken."""
        self._assets = trained.assets
        self._goal = RestPose(trained.neutral.expression, trained.neutral.jaw, None)
        self._source: RestPose | None = None
        self._newest: tuple[HeadParams, bool] | None = None
        self._number, self._taken, self._is_shown = 0, 0.0, True
        self._received = self._dropped = self._malformed = 0
        self._complaint = ""
        self._lock = threading.Lock()
        self._is_open, self._senders = True, 0
        self._udp_reader = FrameReader(self._assets)
        try:
            self._tcp = socket.create_server((host, port))
            self.port: int = self._tcp.getsockname()[1]
            self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._udp.bind((host, self.port))
        except (OSError, OverflowError) as error:
            raise UserError(f"the stream cannot listen on {host}:{port} ({error}); give another --stream") from None
        for target in (self._accept, self._take_datagrams):
            threading.Thread(target=target, daemon=True, name="stream").start()

    @property
    def counts(self) -> Counts:
        with self._lock:
            return Counts(self._received, self._dropped, self._malformed)

    def status(self) -> str:
        """A sentence for the page."""
        counts, complaint = self.counts, self._complaint
        said = f"Stream on port {self.port}: {counts.received} frames, {counts.dropped} dropped"
        return said + (f", {counts.malformed} malformed (last: {complaint})" if counts.malformed else "")

    def newest(self) -> Live | None:
        """The newest frame as the avatar's; None before the first."""
        with self._lock:
            if self._newest is None:
                return None
            (params, is_departure), source, self._is_shown = self._newest, self._source, True
            number, taken = self._number, self._taken
        if is_departure and source is None:
            identity = matrix_from_6d(params.neck)  # no rotation
            source = RestPose(params.expression * 0, identity, None)
        own = params if source is None else departed([params], source, self._goal, 1.0)[0]
        return Live(number, own, taken=taken)

    def calibrate(self) -> None:
        """Take the newest frame for the driver's neutral face: departures from it are shown from the avatar's own."""
        with self._lock:
            if self._newest is not None:
                params = self._newest[0]
                self._source = RestPose(params.expression, matrix_from_6d(params.jaw), None)
                self._number += 1

    def close(self) -> None:
        self._is_open = False
        for listening in (self._tcp, self._udp):
            with suppress(OSError):
                listening.shutdown(socket.SHUT_RDWR)  # wakes who waits on it
            listening.close()

    def _take(self, params: HeadParams, is_departure: bool) -> None:
        with self._lock:
            self._dropped += not self._is_shown
            self._newest, self._is_shown = (params, is_departure), False
            self._received += 1
            self._number += 1
            self._taken = time.monotonic()

    def _refuse(self, error: PacketError) -> None:
        with self._lock:
            self._malformed += 1
            self._complaint = str(error)

    def _accept(self) -> None:
        while self._is_open:
            try:
                sender, _ = self._tcp.accept()
            except OSError:
                return
            with self._lock:
                is_welcome = self._senders < MAX_SENDERS
                self._senders += is_welcome
            if is_welcome:
                threading.Thread(target=self._take_lines, args=(sender,), daemon=True, name="stream").start()
            else:
                sender.close()

    def _take_lines(self, sender: socket.socket) -> None:
        reader = FrameReader(self._assets)
        try:
            with sender, sender.makefile("rb") as lines:
                while self._is_open and (line := lines.readline(MAX_LINE + 1)):
                    if len(line) > MAX_LINE:
                        self._refuse(PacketError(f"a line is longer than {MAX_LINE} bytes"))
                        while line and not line.endswith(b"\n"):
                            line = lines.readline(MAX_LINE)
                    elif line.strip():
                        try:
                            self._take(*reader.line(line))
                        except PacketError as error:
                            self._refuse(error)
        except OSError:
            pass  # the sender has gone
        finally:
            with self._lock:
                self._senders -= 1

    def _take_datagrams(self) -> None:
        while self._is_open:
            try:
                data = self._udp.recv(MAX_DATAGRAM)
            except OSError:
                return
            try:
                params = self._udp_reader.datagram(data)
            except PacketError as error:
                self._refuse(error)
                continue
            if params is not None:
                self._take(params, True)
