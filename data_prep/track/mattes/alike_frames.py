"""What frames of the same pose agree on: what a network is unsure of, as passers-by, is the person in few of them.

Frames of a clip whose faces are alike in place, size and pose are laid over a frame by a similarity of the landmarks. Where
the network is unsure, the person is where most of them show one, and near it: as far from it as those faces are from the
frame's, and a margin. What it is sure of stays: hands and lifted shoulders.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Shaped, UInt8

from data_prep.track.mattes.background_plate import dilated

SIDE = 256  # pixels of the longer side at which frames are compared, those of a network
ALIKE = 9  # frames
APART = 6  # frames between the frame and one that it is compared with: nearer ones show the same passer-by
_MARGIN = 1 / 40  # of the longer side
_HALF, _SURE = 127, 229  # of 255
_EDGE = 4  # pixels of soft edge that belong to what the network is sure of


class ClipFrame(NamedTuple):
    number: int
    matte: UInt8[np.ndarray, "h w"]  # of a network, with `SIDE` pixels at most
    points: Float[np.ndarray, "L 2"]  # landmarks, in its pixels


def clip_frame(number: int, matte: UInt8[np.ndarray, "H W"], points: Float[np.ndarray, "L 2"]) -> ClipFrame:
    """`points` are in pixels of the matte."""
    scale = min(1.0, SIDE / max(matte.shape))
    width, height = (max(1, round(side * scale)) for side in matte.shape[::-1])
    return ClipFrame(number, cv2.resize(matte, (width, height), interpolation=cv2.INTER_AREA), points * scale)


def person_alone(
    number: int, matte: UInt8[np.ndarray, "H W"], points: Float[np.ndarray, "L 2"], clip: list[ClipFrame]
) -> UInt8[np.ndarray, "H W"]:
    """The matte without unsure parts that the frames of the most alike pose in `clip` do not show.

    It stays as it is where the clip has too few frames.
    """
    frame = clip_frame(number, matte, points)
    others = [one for one in clip if abs(one.number - number) >= APART and np.isfinite(one.points).all()]
    if len(others) < ALIKE or not np.isfinite(points).all():
        return matte
    away = [float(np.sqrt(np.square(one.points - frame.points).sum(axis=1).mean())) for one in others]
    alike = np.argsort(away, kind="stable")[:ALIKE]
    height, width = frame.matte.shape
    laid = [laid_over(others[i].matte, others[i].points, frame.points) for i in alike]
    agreed = np.median(laid, axis=0).astype(np.uint8)
    reach = round(_MARGIN * max(height, width) + float(np.median(np.array(away)[alike])))
    kept = dilated(agreed > _HALF, reach) | dilated(frame.matte > _SURE, _EDGE)
    most = np.where(kept, 255, agreed).astype(np.uint8)
    return np.minimum(matte, cv2.resize(most, matte.shape[::-1], interpolation=cv2.INTER_LINEAR))


def laid_over(
    matte: Shaped[np.ndarray, "h w"], source: Float[np.ndarray, "L 2"], target: Float[np.ndarray, "L 2"]
) -> Shaped[np.ndarray, "h w"]:
    """A matte by the similarity that brings points of it nearest to those of another of its size."""
    size = matte.shape[1], matte.shape[0]
    return cv2.warpAffine(
        matte, similarity(source, target), size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )


def similarity(source: Float[np.ndarray, "L 2"], target: Float[np.ndarray, "L 2"]) -> Float[np.ndarray, "2 3"]:
    """Turn, scale and shift that bring `source` nearest to `target`, for pixels counted from their centres.

    Points are complex numbers: target = a source + b, with a and b by least squares.
    """
    start, end = ((points - 0.5) @ np.array([1.0, 1.0j]) for points in (source, target))
    a = np.vdot(start - start.mean(), end - end.mean()) / np.vdot(start - start.mean(), start - start.mean())
    b = end.mean() - a * start.mean()
    return np.array([[a.real, -a.imag, b.real], [a.imag, a.real, b.imag]])
