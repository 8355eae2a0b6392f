"""What of poses and expressions the training frames show, and how far the held-out frames lie outside of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from avatar.data.split import Split, check_divided
from avatar.errors import UserError
from data_prep.check.clip import Clip
from data_prep.check.findings import Finding, from_sentence
from data_prep.check.head_angles import HeadAngles, head_angles
from data_prep.formats.train_test_split import split_frames_of

SHORT_CLIP = 10.0  # seconds; published clips have 40 to 120
NARROW_YAW = 20.0  # degrees; with less, ears and the sides of the nose are never seen
FAR_ANGLE = 5.0  # degrees to the nearest training frame
FAR_EXPRESSION = 1.5  # times the training frames' own range along a principal direction
COMPONENTS = 5
OUTSIDE_SHARE = 0.05  # of the test frames
SMALL_HEAD = 64.0  # pixels; the UV map has 128 texels over a head, a smaller picture cannot fill them


@dataclass(frozen=True)
class Coverage:
    """Of the usable frames, in time order."""

    images: tuple[int, ...]  # image numbers
    split: Split  # positions in `images`
    angles: HeadAngles
    expressions: np.ndarray  # [n, 2], along the first principal directions of the training frames, in their deviations
    far_pose: tuple[int, ...]  # image numbers of test frames that lie far from all training frames
    far_expression: tuple[int, ...]


def measure_coverage(clip: Clip, usable: list[int]) -> Coverage | Finding:
    """`usable` are image numbers. A Finding where they cannot be split."""
    try:
        split, _ = split_frames_of(clip.source, usable)
        check_divided(split)
    except UserError as error:
        return from_sentence("too-few-frames", str(error))
    tracks = dict(clip.tracked())
    angles = head_angles(np.stack([tracks[n].R for n in usable]))
    expressions = np.stack([tracks[n].expression for n in usable])
    train, test = list(split.train), list(split.test)
    pose = np.stack((angles.yaw, angles.pitch), axis=1)
    distance = np.array([np.hypot(*(pose[train] - pose[i]).T).min() for i in test])
    mean = expressions[train].mean(axis=0)
    _, _, directions = np.linalg.svd(expressions[train] - mean, full_matrices=False)
    scores = (expressions - mean) @ directions[:COMPONENTS].T
    deviation = scores[train].std(axis=0)
    scores = scores / np.where(deviation > 1e-9, deviation, 1.0)
    low, high = scores[train].min(axis=0), scores[train].max(axis=0)
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, 1e-9)
    beyond = (abs(scores[test] - middle) > FAR_EXPRESSION * half).any(axis=1)
    plane = np.zeros((len(usable), 2))
    plane[:, : scores.shape[1]] = scores[:, :2]
    return Coverage(
        tuple(usable),
        split,
        angles,
        plane,
        tuple(usable[i] for i, d in zip(test, distance, strict=True) if d > FAR_ANGLE),
        tuple(usable[i] for i, is_far in zip(test, beyond, strict=True) if is_far),
    )


def check_coverage(clip: Clip, coverage: Coverage) -> Iterator[Finding]:
    """Notes: nothing is wrong with the files, but the avatar cannot know what the video does not show."""
    count = len(coverage.images)
    seconds = count / clip.fps
    if seconds < SHORT_CLIP:
        yield Finding(
            "note",
            "short-clip",
            f"there are {count} usable frames, {seconds:.0f} seconds at {clip.fps:g} per second",
            "record half a minute to two minutes with speech, smiles, closed eyes and head turns",
        )
    train = list(coverage.split.train)
    low, high = np.percentile(coverage.angles.yaw[train], [1, 99])
    if high - low < NARROW_YAW and clip.cameras == 1:  # several see the sides
        yield Finding(
            "note",
            "narrow-views",
            f"the head turns only from {low:.0f} to {high:.0f} degrees of yaw in the training frames",
            "expect the avatar to hold in front views only, or record slow turns to both sides",
        )
    sizes = [fit.size for fit in clip.fits.values() if np.isfinite(fit.size)]
    if sizes and np.median(sizes) < SMALL_HEAD:
        yield Finding(
            "note",
            "small-head",
            f"the head is {np.median(sizes):.0f} pixels large in the images",
            "crop the video closer around the head before tracking, if it has more pixels",
        )
    tests = len(coverage.split.test)
    for what, far in (("poses", coverage.far_pose), ("expressions", coverage.far_expression)):
        if len(far) > OUTSIDE_SHARE * tests:
            yield Finding(
                "note",
                "test-coverage",
                f"{clip.phrase(far)} of the {tests} held-out frames show {what} that no training frame shows",
                "expect lower figures there; they measure extrapolation",
                clip.names(far),
            )
