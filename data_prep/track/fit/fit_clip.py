"""The fit's place in the pipeline: from a clip's landmarks and pictures to one `FrameTrack` a frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from avatar.errors import UserError
from avatar.head.assets import IDENTITY_COEFFICIENTS, HeadAssets
from data_prep.formats.frame_track import FrameTrack
from data_prep.progress import Progress
from data_prep.track.faces.detect import FaceDetector
from data_prep.track.faces.embedding import LandmarkEmbedding, iris_embedding, official_embedding
from data_prep.track.faces.rendered_embedding import cached_embedding, rendered_embedding
from data_prep.track.fit.camera import Pinhole
from data_prep.track.fit.chunks import side_by_side
from data_prep.track.fit.frame_poses import Motion, six_d
from data_prep.track.fit.landmark_fit import LandmarkFit, fit_landmarks
from data_prep.track.fit.occlusion import COVERED_SHARE
from data_prep.track.fit.photometric_fit import fit_pictures
from data_prep.track.fit.result import Clip, Fit
from data_prep.track.quality import landmark_figures


def fit_tracks(
    clip: Clip,
    head: HeadAssets,
    head_path: Path,
    progress: Progress,
) -> Fit:
    embedding = find_embedding(head_path, head)
    camera = Pinhole(*clip.intrinsics)
    with side_by_side():
        by_landmarks = fit_landmarks(head, embedding, clip.landmarks, camera)
        by_pictures = fit_pictures(head, by_landmarks, camera, clip.images, clip.mattes, progress)

    def judged(motion: Motion) -> tuple[dict[int, FrameTrack], dict[str, Any]]:
        tracks = as_tracks(by_landmarks, motion, clip.intrinsics, clip.landmarks.size, head.num_expressions)
        with_irises = embedding.with_others(iris_embedding(head))
        return tracks, landmark_figures(head, Fit(tracks, {}), clip.landmarks, with_irises)

    tracks, own = judged(by_pictures.motion)
    own["photometric"] = [
        ["face on its mean texture, by landmarks", by_pictures.before, "dB"],
        ["  fitted to the pictures", by_pictures.after, "dB"],
    ]
    if by_pictures.is_taken:
        # The pictures' fit leaves the landmarks' noise behind, so their error grades the fit to them alone.
        own["photometric"].append(["  landmark error after that", own["errors"]["all"], "% eyes"])
        own["covered"] = by_landmarks.frames[by_pictures.covered > COVERED_SHARE].tolist()
        own["errors"] = judged(by_landmarks.motion)[1]["errors"]
    return Fit(tracks, own)


def as_tracks(
    fit: LandmarkFit, motion: Motion, intrinsics: Sequence[float], size: tuple[int, int], expressions: int
) -> dict[int, FrameTrack]:
    """By the frames' numbers; all `expressions` of the head model. Raises UserError where a value is not finite."""
    expression = np.zeros((len(motion), expressions))
    expression[:, fit.expressions.numpy()] = motion.expression.numpy()
    shape = np.zeros(IDENTITY_COEFFICIENTS)
    shape[: len(fit.identity)] = fit.identity.numpy()
    columns = {
        "R": motion.R.numpy(),
        "t": motion.t.numpy(),
        "eyelids": motion.eyelids.numpy(),
        "expression": expression,
    } | {name: values.numpy() for name, values in six_d(motion).items()}
    if not all(np.isfinite(values).all() for values in columns.values()):
        raise UserError("the fit did not come to finite values; try another part of the video with --start and --end")
    return {
        int(number): FrameTrack(
            **{name: values[row] for name, values in columns.items()},
            shape=shape,
            intrinsics=np.array(intrinsics),
            size=size,
        )
        for row, number in enumerate(fit.frames.tolist())
    }


def find_embedding(
    head_path: Path, head: HeadAssets, say: Callable[[str], object] = lambda _: None
) -> LandmarkEmbedding:
    """The landmarks' places on the head model: those that lie beside it, else found once by pictures of it."""
    known = official_embedding(head_path, head) or cached_embedding(head)
    if known is not None:
        return known
    with FaceDetector() as detector:

        def landmarker(image: np.ndarray) -> np.ndarray | None:
            face = detector.largest(image)
            return None if face is None else face.points

        return rendered_embedding(head, landmarker, say)
