"""The page of `avatar view`: viser's controls and camera around pictures that our splatter draws here."""

from __future__ import annotations

import io
import math
import socket
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from avatar.errors import UserError
from avatar.files.video import write_video
from avatar.motion.orbit import Angles, seen_from
from avatar.view.gate import Gate
from avatar.view.live import Pace
from avatar.view.player import Player
from avatar.view.stage import Look, Setting, Stage

TARGET_MS = (20.0, 33.0)  # of a picture while things move: between them its size stays
LEAST_WIDTH = 96  # pixels
STILL_AFTER = 0.3  # seconds without a change after which the picture is drawn in full size
STATUS_EVERY = 0.25  # seconds
JPEG_QUALITY = 92
LABELS = {"jaw": "jaw open", "look_left": "look to its left", "turn": "turn to its left"}


class Viewer:
    """Runs until `close`; everything that a browser may set can be set here too. `wake` hurries the next picture."""

    def __init__(
        self,
        stage: Stage,
        player: Player,
        width: int,
        host: str,
        port: int,
        token: str | None,
        stream_status: Callable[[], str] | None = None,
        calibrate: Callable[[], None] | None = None,
    ) -> None:
        viser = _viser()
        self.stage, self.player, self._width = stage, player, width
        self._setting, self._changed = Setting(), 0.0
        self._moving_width = width
        self._lock, self.wake, self._stop = threading.RLock(), threading.Event(), threading.Event()
        self._aspects: dict[int, float] = {}
        self._last: tuple[object, ...] = ()
        self._stream_status = stream_status
        self.picture: np.ndarray | None = None
        self.milliseconds, self.pace = 0.0, Pace()
        inner = _free_port()
        with redirect_stdout(io.StringIO()):  # it prints its own address, which is not the one to open
            self._server = viser.ViserServer(host="127.0.0.1", port=inner, label=stage.trained.name, verbose=False)
        try:
            self._gate = Gate(host, port, self._server.get_port(), token)
        except UserError:
            self._server.stop()
            raise
        self.port = self._gate.port
        camera = stage.trained.rest_camera()
        self._own: Angles = seen_from(camera, stage.trained.rest_params())
        position = (-camera.R_cam_world.T @ camera.t_cam_world).tolist()
        self._distance = math.hypot(*position)
        # Sharing would open a tunnel past the gate.
        self._server.gui.configure_theme(show_logo=False, show_share_button=False)
        self._server.scene.world_axes.visible = False
        self._server.scene.set_up_direction("+y")
        self._server.initial_camera.position = position
        self._server.initial_camera.look_at = (0.0, 0.0, 0.0)
        self._server.initial_camera.up = (0.0, 1.0, 0.0)
        self._server.on_client_connect(self._welcome)
        self._make_controls(calibrate)
        self._thread = threading.Thread(target=self._loop, daemon=True, name="viewer")
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self.wake.set()
        self._thread.join(10)
        self._gate.close()
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def change(self, **values: Any) -> None:
        """Set fields of the Setting."""
        with self._lock:
            self._setting = replace(self._setting, **values)
            self._touch()

    def _touch(self) -> None:
        self._changed = time.monotonic()
        self.wake.set()

    def look_from(self, offset: np.ndarray) -> Look:
        """What a camera at this offset from the head means for `orbited`."""
        x, y, z = (float(v) for v in offset)
        distance = max(math.hypot(x, y, z), 1e-6)
        yaw, elevation = math.degrees(math.atan2(x, z)), math.degrees(math.atan2(y, math.hypot(x, z)))
        return Look(self._own.yaw - yaw, elevation - self._own.elevation, self._distance / distance)

    def _welcome(self, client: Any) -> None:
        with self._lock:
            self._last = ()  # drawn again, for the newcomer
            self._touch()

        @client.camera.on_update
        def _(camera: Any) -> None:
            self._aspects[client.client_id] = float(camera.aspect)
            look, _ = self.stage.within(self.look_from(np.asarray(camera.position) - np.asarray(camera.look_at)))
            with self._lock:
                self._last = ()
                self.change(look=look)

    def _make_controls(self, calibrate: Callable[[], None] | None) -> None:
        gui, stage, player = self._server.gui, self.stage, self.player
        self._status = gui.add_markdown("")
        with gui.add_folder("Motion"):
            motion = gui.add_dropdown("Motion", player.names, initial_value=player.name)
            self._play = gui.add_button("Play")
            self._scrub = gui.add_slider("Place", min=0.0, max=1.0, step=0.001, initial_value=0.0)
            if calibrate is not None:
                gui.add_button("Take this face as neutral").on_click(lambda _: calibrate())
        with gui.add_folder("Picture"):
            if stage.truth is not None:
                beside = gui.add_checkbox("Truth beside", initial_value=False)
                beside.on_update(lambda _: self.change(with_truth=beside.value))
            overlay = gui.add_dropdown("Overlay", stage.overlays, initial_value="none")
            overlay.on_update(lambda _: self.change(overlay=overlay.value))
            gui.add_button("Save picture").on_click(self._save_picture)
            gui.add_button("Save video").on_click(self._save_video)
        sliders: list[Any] = []
        folders: dict[str, Any] = {}
        for number, control in enumerate(stage.controls):
            folders.setdefault(control.part, gui.add_folder(control.part, expand_by_default=not folders))
            with folders[control.part]:
                sliders.append(self._slider(control.name, (control.low, control.high), "expressions", number))
        with gui.add_folder("Joints"):
            for name, limits in stage.joints.items():
                sliders.append(self._slider(LABELS.get(name, name.replace("_", " ")), limits, "joints", name))

        def reset(_: Any) -> None:
            for slider in sliders:
                slider.value = 0.0
            self.change(expressions={}, joints={})

        gui.add_button("Reset face").on_click(reset)

        def choose(_: Any) -> None:
            with self._lock:
                player.choose(motion.value)
                self._touch()

        def toggle(_: Any) -> None:
            with self._lock:
                (player.pause if player.is_playing else player.play)()
                self._touch()

        def seek(event: Any) -> None:
            if event.client is not None:  # a person, not the player
                with self._lock:
                    player.seek(self._scrub.value)
                    self._touch()

        motion.on_update(choose)
        self._play.on_click(toggle)
        self._scrub.on_update(seek)

    def _slider(self, label: str, limits: tuple[float, float], part: str, key: int | str) -> Any:
        low, high = (round(limit, 2) for limit in limits)
        if low == high:
            low, high = limits
        slider = self._server.gui.add_slider(label, min=low, max=high, step=(high - low) / 200, initial_value=0.0)

        def moved(_: Any) -> None:
            with self._lock:
                self.change(**{part: {**getattr(self._setting, part), key: float(slider.value)}})

        slider.on_update(moved)
        return slider

    def _loop(self) -> None:
        told = 0.0
        while not self._stop.is_set():
            with self._lock:
                shown, setting, now = self.player.now(), self._setting, time.monotonic()
                newest = max(self._changed, shown.taken or 0.0)
                is_moving = self.player.is_playing or now - newest < STILL_AFTER
            width = self._moving_width if is_moving else self._width
            key = (shown.key, setting, width)
            if key != self._last:
                self._last = key
                begin = time.perf_counter()
                picture = self.stage.draw((shown.params, shown.camera), setting, width, shown.recorded)
                self.milliseconds = 1000 * (time.perf_counter() - begin)
                self.picture = picture
                self._send(picture)
                if shown.taken is not None:
                    self.pace.add(shown.taken, time.monotonic())
                if is_moving:
                    self._fit(self.milliseconds)
            else:
                self.wake.wait(0.01)
                self.wake.clear()
            if now - told > STATUS_EVERY:
                told = now
                self._tell(self.stage.distance(self.stage.params(shown.params, setting)), setting)

    def _fit(self, milliseconds: float) -> None:
        low, high = TARGET_MS
        factor = 0.85 if milliseconds > high else 1.15 if milliseconds < low else 1.0
        self._moving_width = round(min(max(self._moving_width * factor, LEAST_WIDTH), self._width))

    def _send(self, picture: np.ndarray) -> None:
        for number, client in self._server.get_clients().items():
            image = padded(picture, self._aspects.get(number, 1.0), self.stage.trained.config.data.background)
            client.scene.set_background_image(image, format="jpeg", jpeg_quality=JPEG_QUALITY)

    def _tell(self, distance: float, setting: Setting) -> None:
        height, width = (0, 0) if self.picture is None else self.picture.shape[:2]
        _, is_supported = self.stage.within(setting.look)
        lines = [
            f"{width} x {height} pixels, {self.milliseconds:.0f} ms a picture",
            f"Distance from training: {distance:.2f}" + (" (**far**: the avatar guesses)" if distance > 1 else ""),
        ]
        if not is_supported:
            lines.append("**The camera is where the training video never was: the avatar guesses.**")
        if self._stream_status is not None:
            lines.append(self._stream_status())
            if (pace := self.pace.now(time.monotonic())) is not None:
                lines.append(f"Latency {pace[0]:.0f} ms at {pace[1]:.0f} pictures a second")
        self._status.content = "\n\n".join(lines)
        self._play.label = "Pause" if self.player.is_playing else "Play"
        if self.player.is_playing:
            self._scrub.value = round(self.player.share, 3)

    def _save_picture(self, event: Any) -> None:
        with self._lock:
            shown, setting = self.player.now(), self._setting
        picture = self.stage.draw((shown.params, shown.camera), setting, self._width, shown.recorded)
        data = cv2.imencode(".png", picture[..., ::-1])[1].tobytes()
        if event.client is not None:
            event.client.send_file_download(f"{self.stage.trained.name}.png", data, save_immediately=True)

    def _save_video(self, event: Any) -> None:
        """The whole motion as it is seen now."""
        with self._lock:
            clip, setting = self.player.clip, self._setting
        if event.client is None:
            return
        if clip is None:
            event.client.add_notification("No motion", "Choose a motion first: a face at rest makes no video.")
            return
        recorded = clip.recorded or (None,) * len(clip)
        frames = (self.stage.draw(f, setting, self._width, r) for f, r in zip(clip.frames, recorded, strict=True))
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "video.mp4"
            write_video(path, frames, clip.fps)
            name = f"{self.stage.trained.name}-{clip.name}.mp4"
            event.client.send_file_download(name, path.read_bytes(), save_immediately=True)


def padded(picture: np.ndarray, aspect: float, background: tuple[float, ...]) -> np.ndarray:
    """The picture in the middle of one of another width over height."""
    height, width = picture.shape[:2]
    wide, tall = max(width, round(height * aspect)), max(height, round(width / max(aspect, 1e-3)))
    sheet = np.empty((tall, wide, 3), np.uint8)
    sheet[:] = np.round(np.asarray(background) * 255)
    top, left = (tall - height) // 2, (wide - width) // 2
    sheet[top : top + height, left : left + width] = picture
    return sheet


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def _viser() -> Any:
    try:
        import viser
    except ImportError:
        raise UserError(
            "avatar view needs viser, which is not installed: pip install 'hyperavatar[view]' (from a checkout: "
            "pip install -e '.[view]')"
        ) from None
    return viser
