"""Findings about the tracking: unusable frames, the offset, the camera, jumps, and how it lies on the masks."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from avatar.errors import UserError
from avatar.files.pickles import load_torch_pickle
from data_prep.check.clip import GIVEN, NOT_SOUGHT, Clip
from data_prep.check.findings import Finding, from_sentence
from data_prep.check.head_angles import measure_jumps
from data_prep.formats.frame_files import TRACKING
from data_prep.prepare.pairing import BEHIND_CAMERA, REPEATS, grouped

# A head that turns as fast as people can (about 3,700 degrees/s^2 at its peak) lies 3 degrees from half-way between its
# neighbours at 25 frames per second; 10 mm is the same motion of a point 20 cm from the axis.
MIN_ROTATION, MIN_TRANSLATION = 3.0, 10.0  # degrees, mm
# A jump has to stand out of the clip itself, too: a restless clip has large values everywhere.
TIMES_USUAL = 8.0  # the clip's median
# Speech goes from open to closed and back within three frames, which is about the spread of the clip's expressions.
EXPRESSION_SPREADS = 2.0  # root mean square distance from the mean expression
FOV_RANGE = 4.0, 90.0  # degrees; a head that fills the image from 4 m away; a wide-angle lens that nobody cropped
MAX_ASPECT = 0.02  # fx against fy; cameras have square pixels
MAX_OFF_CENTRE = 0.1  # of the image; cropping moves the principal point


def check_tracking(clip: Clip) -> list[Finding]:
    return [
        *_unusable(clip),
        *_left_out(clip),
        *_offset(clip),
        *_camera(clip),
        *_jumps(clip),
    ]


def _unusable(clip: Clip) -> Iterator[Finding]:
    # One finding where the reasons differ only in the name of the frame's own file.
    paths = clip.tracking.paths
    reasons = {number: reason.replace(paths[number].name, "\0") for number, reason in clip.tracking.bad.items()}
    for reason, numbers in grouped(reasons).items():
        first = paths[numbers[0]]
        keys = [f"{key} ({what})" for key, what in non_finite_values(first).items()]
        detail = f"not finite: {', '.join(keys)} in {first.name}" if keys else reason.replace("\0", first.name)
        yield Finding(
            clip.loss_severity(len(numbers), len(clip.files.tracking)),
            "non-finite" if keys or "is not finite" in reason else "no-face" if "no face" in reason else "tracking",
            f"the tracking cannot be used in {clip.phrase(numbers)} of {clip.files.title(TRACKING)}: {detail}",
            "track these frames again, or accept that they are left out of training",
            clip.names(numbers),
        )


def non_finite_values(path: Path) -> dict[str, str]:
    """Key -> `3 of 100 values` for every array of a `.frame` file that holds NaN or infinity."""
    try:
        content = load_torch_pickle(path)
    except UserError:
        return {}
    found: dict[str, str] = {}

    def visit(value: Any, key: str) -> None:
        if isinstance(value, dict):
            for name, inner in value.items():
                visit(inner, f"{key}.{name}" if key else str(name))
        elif isinstance(value, np.ndarray) and value.dtype.kind == "f" and not np.isfinite(value).all():
            found[key] = f"{int((~np.isfinite(value)).sum())} of {value.size} values"

    visit(content, "")
    return found


def _left_out(clip: Clip) -> Iterator[Finding]:
    """Frames whose tracking can be read and not be used."""
    for check, reason, problem, cause in (
        (
            "tracking-repeats",
            REPEATS,
            "the tracking repeats that of the frame before while the image does not, in",
            "the tracker lost the face there: track again",
        ),
        ("behind-camera", BEHIND_CAMERA, "the tracked head is behind the camera in", "track these frames again"),
    ):
        numbers = grouped(clip.left_out).get(reason, [])
        if numbers:
            yield Finding(
                clip.loss_severity(len(numbers), len(clip.pairs())),
                check,
                f"{problem} {clip.phrase(numbers)}",
                f"{cause}, or accept that they are left out of training",
                clip.names(numbers),
            )


def _offset(clip: Clip) -> Iterator[Finding]:
    if clip.offset is None and clip.offset_evidence != NOT_SOUGHT:
        yield from_sentence("frame-offset", clip.offset_evidence)
    is_given = clip.given.frame_offset is not None and not clip.source.is_paired
    if is_given and clip.offset_evidence != GIVEN:
        yield Finding("warning", "frame-offset", clip.offset_evidence, "leave --frame-offset out to use that one")
    if clip.part_offsets is not None and clip.part_offsets[0] != clip.part_offsets[1]:
        first, last = clip.part_offsets
        yield Finding(
            "error",
            "dropped-frames",
            f"the image offset is {first} in the first third of the clip and {last} in the last: frames were dropped "
            "or doubled in between on one side",
            "extract the frames again without changing the frame rate (ffmpeg -fps_mode passthrough), and track those",
        )


def _camera(clip: Clip) -> Iterator[Finding]:
    first = next(iter(clip.tracking.frames.values()), None)
    if first is None:
        return
    fx, fy, cx, cy = first.intrinsics
    width, height = first.size
    fov = float(np.degrees(2 * np.arctan(0.5 * width / fx)))
    if not FOV_RANGE[0] <= fov <= FOV_RANGE[1]:
        yield Finding(
            "warning",
            "focal-length",
            f"a focal length of {fx:.0f} pixels in an image {width} wide is a field of view of {fov:.1f} degrees, "
            f"outside {FOV_RANGE[0]:.0f} to {FOV_RANGE[1]:.0f}",
            "give the tracker the camera's focal length, or let it optimise it from a plausible start",
        )
    if abs(fy / fx - 1) > MAX_ASPECT:
        yield Finding(
            "warning",
            "focal-length",
            f"fx = {fx:.1f} and fy = {fy:.1f} differ by {abs(fy / fx - 1):.0%}: the pixels would not be square",
            "were the frames stretched after tracking? Resize both sides by one factor",
        )
    off = float(max(abs(cx / width - 0.5), abs(cy / height - 0.5)))
    if off > MAX_OFF_CENTRE:
        yield Finding(
            "warning" if off > 0.5 else "note",
            "principal-point",
            f"the principal point ({cx:.1f}, {cy:.1f}) is {off:.0%} of the image away from the centre of "
            f"{width}x{height}",
            "was the tracking made before the frames were cropped? Track the cropped frames"
            if off > 0.5
            else "nothing, if the frames were cropped off-centre: it is used as it is",
        )


def _jumps(clip: Clip) -> Iterator[Finding]:
    tracked = dict(clip.tracked()) or dict(clip.tracking.frames)
    numbers = list(tracked)
    if not numbers:
        return
    sudden = measure_jumps(numbers, list(tracked.values()))
    expressions = np.stack([track.expression for track in tracked.values()])
    spread = float(np.sqrt(((expressions - expressions.mean(axis=0)) ** 2).sum(axis=1).mean()))
    for what, values, floor, unit in (
        ("rotation", sudden.rotation, MIN_ROTATION, "degrees"),
        ("position", sudden.translation, MIN_TRANSLATION, "mm"),
        ("expression", sudden.expression, EXPRESSION_SPREADS * spread, ""),
    ):
        if not np.isfinite(values).any():
            continue
        limit = max(floor, TIMES_USUAL * float(np.nanmedian(values)))
        jumping = [n for n, value in zip(numbers, values, strict=True) if value > limit]
        if not jumping:
            continue
        worst = numbers[int(np.nanargmax(values))]
        largest = float(np.nanmax(values))
        size = f"{largest:{'.1f' if largest < 1e5 else '.1e'}} {unit}".strip()
        yield Finding(
            "warning",
            "jumps",
            f"the tracked {what} jumps at {clip.phrase(jumping)}: {clip.name(worst)} lies {size} from half-way between "
            f"its neighbours, where {np.nanmedian(values):.2g} is usual",
            "look at these frames in the tracker's output; track them again or remove them",
            clip.names(jumping),
        )
