"""`--webcam`: a person's face in pictures that come now, as the avatar's.

`LiveFaceTracker` says what face is in the newest picture. Here its motion becomes the avatar's, relative to both neutral
faces, and so does the movement of its head.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from avatar.errors import UserError
from avatar.head.model import HeadModel, matrix_from_6d
from avatar.motion.controls import joint_ranges
from avatar.motion.neutral_pose import RestPose, find_neutral
from avatar.motion.transfer import retargeted
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.types import Camera
from avatar.view.live import LiveFrame
from avatar.view.player import WEBCAM
from data_prep.live.face_tracker import NO_FACE, Calibration, LiveFaceTracker, TrackedFace


class Webcam:
    """Follows from `start` until `close`, in a thread of its own; the face stays as it was when pictures end."""

    name = WEBCAM

    def __init__(self, trained: TrainedAvatar, tracker: LiveFaceTracker, say: Callable[[str], object] = print) -> None:
        """`say` hears, once each, what happens; `status` says it too."""
        self._trained, self._tracker, self._say = trained, tracker, say
        self._goal = RestPose(trained.neutral.expression, trained.neutral.jaw, None)
        self._own = trained.rest_camera()
        recording = trained.recording
        self._has_torso = not {"lean", "turn"}.isdisjoint(joint_ranges(recording.motion(recording.split.train)))
        self._lock = threading.Lock()
        self._newest: LiveFrame | None = None
        self._face: TrackedFace | None = None
        self._rest: RestPose | None = None
        self._rest_face: TrackedFace | None = None
        self._words, self._is_open = "Waiting for the first picture.", True
        self._on_frame: Callable[[], object] = lambda: None
        self._thread = threading.Thread(target=self._run, daemon=True, name="webcam")

    def start(self, on_frame: Callable[[], object]) -> None:
        """`on_frame` is called, from another thread, when there is a new one."""
        self._on_frame = on_frame
        self._thread.start()

    def close(self) -> None:
        self._is_open = False
        self._tracker.close()
        if self._thread.is_alive():
            self._thread.join(5)

    def newest(self) -> LiveFrame | None:
        """The newest frame as the avatar's; None until calibration is done."""
        return self._newest

    def status(self) -> str:
        """A sentence or two for the page."""
        if self._words:
            return self._words
        parts = ", ".join(f"{name} {value:.0f} ms" for name, value in self._tracker.milliseconds.items())
        dropped, count = self._tracker.dropped()
        return f"Webcam: {parts}; {dropped} of {count} pictures dropped"

    def calibrate(self) -> None:
        """Take the newest face for the person's neutral one, and where it is for its place."""
        with self._lock:
            if (face := self._face) is not None:
                self._rest = RestPose(face.params.expression, matrix_from_6d(face.params.jaw[None])[0], None)
                self._rest_face = face

    def _run(self) -> None:
        try:
            calibration = self._tracker.calibrate(self._set_status)
            self._learn(calibration)
            self._say("Calibrated: the avatar follows.")
            while self._is_open:
                self._take(self._tracker.follow())
        except UserError as error:
            if self._is_open:
                self._set_status(str(error))
        except Exception as error:
            if self._is_open:
                self._set_status(f"Following the face has failed ({type(error).__name__}: {error}); start anew.")
                raise

    def _set_status(self, words: str) -> None:
        self._words = words
        self._say(words)

    def _learn(self, calibration: Calibration) -> None:
        head = HeadModel(self._trained.assets, calibration.identity)
        rest = find_neutral([face.params for face in calibration.faces], head)
        self._rest, self._rest_face = rest, calibration.faces[rest.frame or 0]

    def _take(self, face: TrackedFace | None) -> None:
        if face is None:
            self._words = NO_FACE
            return
        self._words = ""
        with self._lock:
            self._face, rest, rest_face = face, self._rest, self._rest_face
        assert rest is not None and rest_face is not None
        params = retargeted([face.params], rest, self._goal, 1.0)[0]
        camera = moved_camera(self._own, rest_face, face)
        if self._has_torso:
            params = replace(params, neck=still_torso(self._trained.rest_params().neck, self._own, camera))
        number = 0 if self._newest is None else self._newest.number + 1
        self._newest = LiveFrame(number, params, camera, face.taken)
        self._on_frame()


def moved_camera(own: Camera, rest: TrackedFace, face: TrackedFace) -> Camera:
    """`own` with the head turned and moved as from `rest` to `face`; its depth scales the movement, not the lens."""
    turn = face.R_cam_head @ rest.R_cam_head.T
    scale = own.t_cam_world[2] / rest.t_cam_head[2]
    shift = scale * (face.t_cam_head - rest.t_cam_head)
    return replace(own, R_cam_world=turn @ own.R_cam_world, t_cam_world=own.t_cam_world + shift)


def still_torso(neck: Float[Tensor, " 6"], own: Camera, moved: Camera) -> Float[Tensor, " 6"]:
    """The neck with which the torso stays as with `neck` before `own` while the head moves."""
    turn = own.R_cam_world.T @ moved.R_cam_world
    return (matrix_from_6d(neck) @ turn.to(neck))[:2].reshape(6)
