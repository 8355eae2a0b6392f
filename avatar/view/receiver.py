"""`--stream PORT`: frames from other programs of this machine. The newest frame counts.

Lines of JSON come over TCP; the first says the token. OSC and Live Link Face come over UDP, whose packets cannot carry a
token, so UDP is listened to only where none is asked for. A frame that has not been shown when the next one comes is
dropped, so that what is seen is never late; a packet that cannot be read is counted and forgotten.
"""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from avatar.errors import UserError
from avatar.head.model import matrix_from_6d
from avatar.motion.neutral_pose import RestPose
from avatar.motion.transfer import retargeted
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.types import HeadParams
from avatar.view.auth import equal_tokens
from avatar.view.live import LiveFrame
from avatar.view.packets import MAX_LINE, FrameReader, PacketError
from avatar.view.player import STREAM

MAX_SENDERS = 8
IDLE_SECONDS = 30.0  # after which a sender that says nothing is closed
SHARE = 0.3  # of a processor that a sender's packets may take
MAX_DATAGRAM = 1 << 16


@dataclass(frozen=True)
class Counts:
    received: int = 0
    dropped: int = 0  # frames that a newer one replaced before they were shown
    malformed: int = 0


class Receiver:
    """Listens until `close`. Expressions that come as coefficients are shown as they are until `calibrate`."""

    name = STREAM

    def __init__(self, trained: TrainedAvatar, port: int, token: str | None = None) -> None:
        """Port 0 takes a free one, then in `port`. Raises UserError when it is taken."""
        host = "127.0.0.1"
        self._assets = trained.assets
        self._goal = RestPose(trained.neutral.expression, trained.neutral.jaw, None)
        self._source: RestPose | None = None
        self._newest: tuple[HeadParams, bool] | None = None
        self._number, self._taken, self._is_shown = 0, 0.0, True
        self._received = self._dropped = self._malformed = 0
        self._complaint = ""
        self._lock = threading.Lock()
        self._token, self._is_open = token, True
        self._senders: dict[socket.socket, float] = {}  # when the last frame of each came; 0: never
        self._udp: socket.socket | None = None
        try:
            self._tcp = socket.create_server((host, port))
            self.port: int = self._tcp.getsockname()[1]
            if token is None:
                self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
                self._udp.bind((host, self.port))
        except (OSError, OverflowError) as error:
            if self._udp is not None:  # the port was free for TCP alone
                self._tcp.close()
                self._udp.close()
            raise UserError(f"the stream cannot listen on {host}:{port} ({error}); give another --stream") from None
        threading.Thread(target=self._accept, daemon=True, name="stream").start()
        if self._udp is not None:
            threading.Thread(target=self._take_datagrams, args=(self._udp,), daemon=True, name="stream").start()

    @property
    def counts(self) -> Counts:
        with self._lock:
            return Counts(self._received, self._dropped, self._malformed)

    def status(self) -> str:
        """A sentence for the page: plain text, in which stands what strangers have sent."""
        counts, complaint = self.counts, self._complaint
        said = f"Port {self.port}: {counts.received} frames, {counts.dropped} dropped"
        return said + (f", {counts.malformed} malformed (last: {complaint})" if counts.malformed else "")

    def newest(self) -> LiveFrame | None:
        """The newest frame as the avatar's; None before the first."""
        with self._lock:
            if self._newest is None:
                return None
            (params, is_departure), source, self._is_shown = self._newest, self._source, True
            number, taken = self._number, self._taken
        if is_departure and source is None:
            identity = matrix_from_6d(params.neck)  # no rotation
            source = RestPose(params.expression * 0, identity, None)
        own = params if source is None else retargeted([params], source, self._goal, 1.0)[0]
        return LiveFrame(number, own, taken=taken)

    def calibrate(self) -> None:
        """Take the newest frame for the driver's neutral face: departures from it are shown from the avatar's own."""
        with self._lock:
            if self._newest is not None:
                params = self._newest[0]
                self._source = RestPose(params.expression, matrix_from_6d(params.jaw), None)
                self._number += 1

    def close(self) -> None:
        self._is_open = False
        with self._lock:
            sockets = [self._tcp, *self._senders, *([] if self._udp is None else [self._udp])]
        for used in sockets:
            _shut_down(used)
        self._tcp.close()
        if self._udp is not None:
            self._udp.close()

    def _take(self, params: HeadParams, is_departure: bool) -> None:
        with self._lock:
            self._dropped += not self._is_shown
            self._newest, self._is_shown = (params, is_departure), False
            self._received += 1
            self._number += 1
            self._taken = time.monotonic()

    def _refuse(self, complaint: str) -> None:
        with self._lock:
            self._malformed += 1
            self._complaint = complaint

    def _accept(self) -> None:
        while self._is_open:
            try:
                sender, _ = self._tcp.accept()
            except OSError:  # closed, or the process has no file left for it
                time.sleep(0.05)
                continue
            sender.settimeout(IDLE_SECONDS)
            with self._lock:
                if len(self._senders) == MAX_SENDERS:  # the one whose last frame is the oldest goes
                    _shut_down(longest := min(self._senders, key=lambda other: self._senders[other]))
                    del self._senders[longest]
                self._senders[sender] = 0.0
            threading.Thread(target=self._take_lines, args=(sender,), daemon=True, name="stream").start()

    def _take_lines(self, sender: socket.socket) -> None:
        reader, throttle, is_first = FrameReader(self._assets), Throttle(), True
        try:
            with sender, sender.makefile("rb") as lines:
                while self._is_open and (line := lines.readline(MAX_LINE + 1)):
                    if is_first:
                        is_first = False
                        if (complaint := self._refusal(line)) is not None:
                            return self._refuse(complaint)
                        if self._token is not None:
                            continue
                    if len(line) > MAX_LINE:
                        self._refuse(f"a line is longer than {MAX_LINE} bytes")
                        while line and not line.endswith(b"\n"):
                            line = lines.readline(MAX_LINE)
                    elif line.strip():
                        self._take_line(reader, line, sender)
                    throttle.sleep()
        except OSError:
            pass  # the sender has gone, or says nothing
        finally:
            with self._lock:
                self._senders.pop(sender, None)

    def _refusal(self, line: bytes) -> str | None:
        """Why a sender with this first line is closed."""
        if not line.startswith(b"{"):  # a web page can send anything, but not before the head of its request
            return "a sender's first line is not JSON: web pages may not send frames"
        if self._token is not None and not has_token(line, self._token):
            return "a sender's first line does not say the token"
        return None

    def _take_line(self, reader: FrameReader, line: bytes, sender: socket.socket) -> None:
        try:
            self._take(*reader.line(line))
        except Exception as error:
            self._refuse(_told(error))
            return
        with self._lock:
            if sender in self._senders:
                self._senders[sender] = time.monotonic()

    def _take_datagrams(self, udp: socket.socket) -> None:
        reader, throttle = FrameReader(self._assets), Throttle()
        while self._is_open:
            try:
                data = udp.recv(MAX_DATAGRAM)
            except OSError:
                return
            try:
                if (params := reader.datagram(data)) is not None:
                    self._take(params, True)
            except Exception as error:
                self._refuse(_told(error))
            throttle.sleep()


class Throttle:
    """Keeps its thread from more than SHARE of a processor: what comes faster waits, or is lost, in the socket."""

    def __init__(
        self,
        clock: Callable[[], float] = time.monotonic,
        used: Callable[[], float] = time.thread_time,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._clock, self._used, self._sleep = clock, used, sleep
        self._since, self._before = clock(), used()

    def sleep(self) -> None:
        """Called after each packet; sleeps where the last second's took too long."""
        used = self._used() - self._before
        if used > SHARE:
            self._sleep(max(self._since + used / SHARE - self._clock(), 0.0))
        if self._clock() - self._since > 1:
            self._since, self._before = self._clock(), self._used()


def has_token(line: bytes, token: str) -> bool:
    """Whether a sender's first line is {"token": TOKEN}."""
    try:
        found = json.loads(line)
    except (ValueError, RecursionError):
        return False
    given = found.get("token") if isinstance(found, dict) else None
    return isinstance(given, str) and equal_tokens(given, token)


def _told(error: Exception) -> str:
    return str(error) if isinstance(error, PacketError) else f"a packet cannot be read ({type(error).__name__})"


def _shut_down(used: socket.socket) -> None:
    """End what a thread waits for."""
    with suppress(OSError):
        used.shutdown(socket.SHUT_RDWR)
