"""One person's face in pictures that come now: a few seconds of calibration, then the motion of every picture."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avatar.data.split import evenly_spread
from avatar.errors import UserError
from avatar.head.assets import IDENTITY_COEFFICIENTS, HeadAssets
from avatar.types import HeadParams
from data_prep.live.frame_fit import FrameFit
from data_prep.live.picture_sources import LivePicture, Newest, Source
from data_prep.track.faces.detect import Face, FaceDetector, overlap
from data_prep.track.faces.landmarks import Landmarks
from data_prep.track.fit.camera import Pinhole
from data_prep.track.fit.fit_clip import find_embedding
from data_prep.track.fit.focal import choose_focal
from data_prep.track.fit.frame_poses import Motion, six_d
from data_prep.track.fit.landmark_fit import LandmarkFit, fit_landmarks

CALIBRATION_SECONDS = 4.0
FEWEST, MOST = 20, 60  # pictures with the face that calibration is made from
NO_FACE = "There is no face in the picture."
_NO_FACES = np.zeros((0, 478, 3), np.float32)
_SAME_PERSON = 0.1  # overlap (IoU) with the last place of the face


@dataclass(frozen=True)
class TrackedFace:
    """The face in one picture."""

    params: HeadParams
    R_cam_head: Float[Tensor, "3 3"]  # the head's pose: p_cam = R p_head + t
    t_cam_head: Float[Tensor, " 3"]  # metres
    taken: float  # seconds of `time.monotonic`


@dataclass(frozen=True)
class Calibration:
    identity: Float[Tensor, " S"]
    faces: list[TrackedFace]  # that it was made from


class LiveFaceTracker:
    """A face in the newest pictures of a source. Use from one thread, but for `close`."""

    def __init__(
        self,
        source: Source,
        assets: HeadAssets,
        head_path: Path,
        say: Callable[[str], object],
        field_of_view: float | None = None,
    ) -> None:
        """`field_of_view` in degrees across the pictures' width, where it is known.

        Raises UserError where MediaPipe or its model is missing, or no camera has that field of view. The head model's
        landmarks may take 30 s, once.
        """
        choose_focal(*source.size, _NO_FACES, field_of_view=field_of_view)
        self._field_of_view = field_of_view
        self._assets, self._embedding = assets, find_embedding(head_path, assets, say)
        self._detector = FaceDetector()
        self.pictures = Newest(source)
        self._looking, self._is_closed = threading.Lock(), False
        self._last: Face | None = None
        self._fit: FrameFit | None = None
        self.milliseconds: dict[str, float] = {}  # of the last picture, by part

    def close(self) -> None:
        """From any thread; calls that wait end with UserError."""
        self.pictures.close()
        with self._looking:
            if not self._is_closed:
                self._is_closed = True
                self._detector.close()

    def dropped(self) -> tuple[int, int]:
        """Pictures that a newer one overtook before they were looked at, and all."""
        return self.pictures.dropped, self.pictures.read

    def calibrate(self, say: Callable[[str], object]) -> Calibration:
        """Look for `CALIBRATION_SECONDS` at the face, and fit the identity. `say` hears what goes on.

        Raises UserError when the pictures end before.
        """
        found: list[tuple[Face, float]] = []
        last = ""

        def tell(words: str) -> None:
            nonlocal last
            if words != last:
                say(last := words)

        self.pictures.start()
        try:
            while len(found) < FEWEST or found[-1][1] - found[0][1] < CALIBRATION_SECONDS:
                picture = self.pictures.take()
                face = self._find(picture)
                tell("Look into the camera, calmly, lips closed." if face else NO_FACE)
                if face is not None:
                    found.append((face, picture.taken))
        except UserError as error:
            raise UserError(
                f"{error}; {len(found)} pictures showed the face, calibration takes {FEWEST} and {CALIBRATION_SECONDS:g} s"
            ) from None
        tell("Fitting the face.")
        return self._calibrated(evenly_spread(found, MOST))

    def follow(self) -> TrackedFace | None:
        """The face in the newest picture, waited for; None without a face. Raises UserError when the pictures end.

        Raises RuntimeError before `calibrate`.
        """
        if self._fit is None:
            raise RuntimeError("follow() comes after calibrate()")
        picture = self.pictures.take()
        begin = time.perf_counter()
        face = self._find(picture)
        found = time.perf_counter()
        self.milliseconds["landmarks"] = 1000 * (found - begin)
        if face is None:
            return None
        motion = self._fit.next(face, picture.taken)
        if motion is None:
            return None
        followed = _as_faces(motion, [picture.taken], self._expressions, self._assets)[0]
        self.milliseconds["fit"] = 1000 * (time.perf_counter() - found)
        return followed

    def _find(self, picture: LivePicture) -> Face | None:
        """The same person's face as before where there are several, else the largest."""
        with self._looking:
            if self._is_closed:
                raise UserError(f"{self.pictures.source.name} is closed")
            faces = self._detector.find(picture.image)
        if not faces:
            return None
        last = self._last
        same = [] if last is None else [f for f in faces if overlap(f.box, last.box) > _SAME_PERSON]
        self._last = max(same, key=lambda face: overlap(face.box, last.box)) if same and last else faces[0]
        return self._last

    def _calibrated(self, found: list[tuple[Face, float]]) -> Calibration:
        # A frame's matrices are small: threads wait for each other, on a busy machine ten times as long as they work.
        # Drawing keeps its own number, which it has had since before.
        torch.get_num_threads()
        torch.set_num_threads(1)
        times = [taken for _, taken in found]
        points = np.stack([face.points for face, _ in found])
        size = self.pictures.source.size
        landmarks = Landmarks(
            points,
            np.stack([face.scores for face, _ in found]),
            np.ones(len(found), bool),
            size,
            (len(found) - 1) / (times[-1] - times[0]),
        )
        equivalent = self.pictures.source.equivalent_focal
        focal = choose_focal(*size, points, field_of_view=self._field_of_view, equivalent=equivalent).pixels
        camera = Pinhole(focal, focal, size[0] / 2, size[1] / 2)
        fit = fit_landmarks(self._assets, self._embedding, landmarks, camera)
        self._fit = FrameFit(self._assets, self._embedding, fit, camera, size)
        self._expressions = fit.expressions
        return Calibration(_identity(fit), _as_faces(fit.motion, times, fit.expressions, self._assets))


def _identity(fit: LandmarkFit) -> Float[Tensor, " S"]:
    identity = torch.zeros(IDENTITY_COEFFICIENTS)
    identity[: len(fit.identity)] = fit.identity.float()
    return identity


def _as_faces(motion: Motion, times: list[float], expressions: Tensor, assets: HeadAssets) -> list[TrackedFace]:
    T = len(motion)
    expression = torch.zeros(T, assets.num_expressions)
    expression[:, expressions] = motion.expression.float()
    jaw, eyes, neck = (values.float() for values in six_d(motion).values())
    lids, R, t = motion.eyelids.float(), motion.R.float(), motion.t.float()
    return [
        TrackedFace(HeadParams(expression[n], jaw[n], eyes[n], lids[n], neck[n]), R[n], t[n], times[n])
        for n in range(T)
    ]
