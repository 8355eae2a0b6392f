"""The viewer: pictures that our splatter draws, in the page of viser."""

from __future__ import annotations

import math
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from avatar.errors import UserError
from avatar.files.names import safe_name
from avatar.files.video import write_video
from avatar.files.write_image import encode_image
from avatar.motion.orbit import Angles, seen_from
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.view.auth import LOCAL, AccessCheck
from avatar.view.live import LiveTiming
from avatar.view.messages import MessageCheck
from avatar.view.panel import Panel, notes
from avatar.view.player import Player
from avatar.view.rate_limited_log import RateLimitedLog
from avatar.view.view_renderer import Setting, ViewOffset, ViewRenderer
from avatar.view.viser_server import WebServer

TARGET_MS = (20.0, 33.0)  # of a picture while things move: between them its size stays
LEAST_WIDTH = 96  # pixels
LARGEST = 4096  # pixels of a side of what is sent
STILL_AFTER = 0.3  # seconds without a change after which the picture is drawn in full size
STATUS_EVERY = 0.25  # seconds
AFTER_AN_ERROR = 0.25  # seconds
SAVE_EVERY = 0.5  # seconds
JPEG_QUALITY = 92


class Viewer:
    """Runs until `close`; everything that a browser may set can be set here too. `wake` hurries the next picture."""

    def __init__(
        self,
        renderer: ViewRenderer,
        player: Player,
        width: int,
        host: str,
        port: int,
        token: str,
        url: str | None = None,
        live_status: Callable[[], str] | None = None,
        calibrate: Callable[[], None] | None = None,
    ) -> None:
        """Raises UserError when the address cannot be listened on. Port 0 takes a free one, then in `port`."""
        self.renderer, self.player, self._width = renderer, player, width
        self.setting, self._changed = Setting(), 0.0
        self.progress = ""  # of the training, in the panel
        self._newer: TrainedAvatar | None = None
        self._moving_width = width
        self.lock, self.wake, self._stop = threading.RLock(), threading.Event(), threading.Event()
        self._last: tuple[object, ...] = ()
        self._told = 0.0
        self._live_status = live_status
        self._save_lock = threading.Lock()
        self.picture: np.ndarray | None = None
        self.milliseconds, self.timing = 0.0, LiveTiming()
        self.complaints, self.messages = RateLimitedLog(), MessageCheck()
        camera = renderer.trained.rest_camera()
        self._own: Angles = seen_from(camera)
        x, y, z = (-camera.R_cam_world.T @ camera.t_cam_world).tolist()
        self._distance = math.hypot(x, y, z)
        listening = _listen(host, port)
        self.port: int = listening.getsockname()[1]
        access = AccessCheck(token, host in LOCAL, url)
        self._web = WebServer(listening, access, self.messages, self.complaints, renderer.trained.name)
        self.server = server = self._web.viser
        server.scene.world_axes.visible = False
        server.scene.set_up_direction("+y")
        server.initial_camera.position = (x, y, z)
        server.initial_camera.look_at = (0.0, 0.0, 0.0)
        server.initial_camera.up = (0.0, 1.0, 0.0)
        self.panel = Panel(self, server.gui, None if live_status is None else player.live_name, calibrate)
        server.on_client_connect(self._add_client)
        self._thread = threading.Thread(target=self._loop, daemon=True, name="viewer")
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self.wake.set()
        self._web.close()
        self._thread.join(5)
        self.complaints.close()

    def change(self, **values: Any) -> None:
        """Set fields of the Setting."""
        with self.lock:
            before, self.setting = self.setting, replace(self.setting, **values)
        if self.setting != before:
            self.touch()

    def follow(self, newer: TrainedAvatar) -> None:
        """From the next picture on, show the avatar after more training."""
        self._newer = newer
        self.wake.set()

    def touch(self) -> None:
        self._changed = time.monotonic()
        self.wake.set()

    def look_from(self, offset: np.ndarray) -> ViewOffset:
        """What a camera at this offset from the head means for `orbited`."""
        x, y, z = (float(v) for v in offset)
        distance = max(math.hypot(x, y, z), 1e-6)
        yaw, elevation = math.degrees(math.atan2(x, z)), math.degrees(math.atan2(y, math.hypot(x, z)))
        return ViewOffset(self._own.yaw - yaw, elevation - self._own.elevation, self._distance / distance)

    def _add_client(self, client: Any) -> None:
        @client.camera.on_update
        def _(camera: Any) -> None:
            look, _ = self.renderer.within(self.look_from(np.asarray(camera.position) - np.asarray(camera.look_at)))
            self.change(look=look)

    def _loop(self) -> None:
        while not self._stop.is_set():
            try:
                self._step()
            except Exception as error:
                self.complaints.add(f"a picture could not be drawn ({type(error).__name__})")
                self._stop.wait(AFTER_AN_ERROR)

    def _step(self) -> None:
        """Draw and send what has changed, or wait for that."""
        with self.lock:
            newer, self._newer = self._newer, None
            if newer is not None:
                self.renderer = self.renderer.of(newer)
            renderer, shown, setting, now = self.renderer, self.player.now(), self.setting, time.monotonic()
            newest = max(self._changed, shown.taken or 0.0)
            is_moving = self.player.is_playing or now - newest < STILL_AFTER
        clients = self.server.get_clients()
        windows = tuple((number, client.camera.aspect) for number, client in clients.items())
        width = self._moving_width if is_moving else self._width
        key = (shown.key, setting, width, windows, is_moving, renderer)
        try:
            if key != self._last:
                begin = time.perf_counter()
                picture = renderer.draw((shown.params, shown.camera), setting, width, shown.recorded)
                self._last = key  # one that could not be drawn is tried again
                self.milliseconds = 1000 * (time.perf_counter() - begin)
                self.picture = picture
                for number, aspect in windows:
                    self._send(clients[number], aspect, picture, is_moving)
                if shown.taken is not None:
                    self.timing.add(shown.taken, time.monotonic())
                if is_moving:
                    self._fit(self.milliseconds)
            else:
                self.wake.wait(0.01)
                self.wake.clear()
        finally:
            if now - self._told > STATUS_EVERY:
                self._told = now
                is_recorded = shown.recorded is not None
                self._show_status(renderer.distance(renderer.params(shown.params, setting)), setting, is_recorded)

    def _fit(self, milliseconds: float) -> None:
        low, high = TARGET_MS
        factor = 0.85 if milliseconds > high else 1.15 if milliseconds < low else 1.0
        self._moving_width = round(min(max(self._moving_width * factor, LEAST_WIDTH), self._width))

    def _send(self, client: Any, aspect: float, picture: np.ndarray, is_moving: bool) -> None:
        try:
            image = padded(picture, aspect, self.renderer.trained.config.data.background)
            client.scene.set_background_image(image, "jpeg" if is_moving else "png", jpeg_quality=JPEG_QUALITY)
        except Exception as error:  # the others get theirs
            self.complaints.add(f"a picture could not be sent ({type(error).__name__})")

    def _show_status(self, distance: float, setting: Setting, is_recorded: bool) -> None:
        height, width = (0, 0) if self.picture is None else self.picture.shape[:2]
        _, is_supported = self.renderer.within(setting.look)
        lines = [
            *([self.progress] if self.progress else []),
            f"{width} x {height} pixels, {self.milliseconds:.0f} ms a picture",
            f"Distance from training: {distance:.2f}" + (" (**far**: the avatar guesses)" if distance > 1 else ""),
            *notes(setting, self.renderer.truth is not None, is_recorded),
        ]
        if not is_supported:
            lines.append("**The camera is where the training video never was: the avatar guesses.**")
        if (timing := self.timing.now(time.monotonic())) is not None:
            lines.append(f"Latency {timing[0]:.0f} ms at {timing[1]:.0f} pictures a second")
        self.panel.show_status(lines, "" if self._live_status is None else self._live_status())

    def save_picture(self, event: Any) -> None:
        with self.lock:
            renderer, shown, setting = self.renderer, self.player.now(), self.setting
        with self._saving(event.client) as may_save:
            if may_save:
                picture = renderer.draw((shown.params, shown.camera), setting, self._width, shown.recorded)
                name = f"{self.renderer.trained.name}.png"
                event.client.send_file_download(name, encode_image(picture), save_immediately=True)

    def save_video(self, event: Any) -> None:
        """The whole motion as it is seen now."""
        with self.lock:
            renderer, clip, setting = self.renderer, self.player.clip, self.setting
        if clip is None:
            event.client.add_notification("No motion", "Choose a motion first: a face at rest makes no video.")
            return

        def frames() -> Iterator[np.ndarray]:
            for picture in renderer.film(clip, setting, self._width):
                if self._stop.is_set():
                    raise UserError("the viewer has ended")
                yield picture

        with self._saving(event.client) as may_save, tempfile.TemporaryDirectory() as folder:
            if may_save:
                path = Path(folder) / "video.mp4"
                write_video(path, frames(), clip.fps)
                name = f"{self.renderer.trained.name}-{safe_name(clip.name)}.mp4"
                event.client.send_file_download(name, path.read_bytes(), save_immediately=True)

    @contextmanager
    def _saving(self, client: Any) -> Iterator[bool]:
        """One at a time, and not many a second: what is saved stays in memory until a client has taken it."""
        if not self._save_lock.acquire(blocking=False):
            client.add_notification("Not saved", "Something else is being saved: try again.")
            yield False
            return
        try:
            yield True
            self._stop.wait(SAVE_EVERY)
        finally:
            self._save_lock.release()


def padded(picture: np.ndarray, aspect: float, background: tuple[float, ...]) -> np.ndarray:
    """The picture in the middle of one of another width over height, or at the top of an upright one, where a phone has no
    controls; smaller where that would be larger than LARGEST."""
    height, width = picture.shape[:2]
    factor = min(LARGEST / max(width, height * aspect), LARGEST / max(height, width / aspect), 1.0)
    if factor < 1.0:
        width, height = max(1, round(width * factor)), max(1, round(height * factor))
        picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    wide = min(max(width, round(height * aspect)), LARGEST)
    tall = min(max(height, round(width / aspect)), LARGEST)
    sheet = np.empty((tall, wide, 3), np.uint8)
    sheet[:] = np.round(np.asarray(background) * 255)
    top, left = 0 if aspect < 1 else (tall - height) // 2, (wide - width) // 2
    sheet[top : top + height, left : left + width] = picture
    return sheet


def _listen(host: str, port: int) -> socket.socket:
    both = host == "::" and socket.has_dualstack_ipv6()  # else IPv6 alone, and not under the address that is printed
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server((host, port), family=family, dualstack_ipv6=both)
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"the viewer cannot listen on {host}:{port} ({reason}); give another --port") from None
