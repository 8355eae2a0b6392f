"""Which image belongs to which tracking frame: found from how masks and projected mesh move together.

Extraction tools number images from 0 or 1 and some drop the first frame, so image = tracking + offset with an offset
that has to be found. The mesh never fits the masks exactly (hair, clothes, mask conventions), so the overlap at one
instant says little; what it misses depends on the pose, though, and is fitted and taken out. What remains is large
when the two clocks differ. Where the masks do not decide, the motion in the images does (`image_motion`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from avatar.compute.processors import processor_count
from avatar.errors import UserError
from avatar.head.model import HeadModel
from data_prep.formats.frame_files import FrameFiles
from data_prep.formats.frame_track import FrameTrack
from data_prep.prepare.check_alignment import check_sample
from data_prep.prepare.image_motion import motion_residuals
from data_prep.prepare.masks import read_masks
from data_prep.prepare.projection import filled_lips, lip_faces, project_head, silhouette

RADIUS = 4  # offsets tried on each side; the outermost ones only serve to see that the best is a minimum
SAMPLED_FRAMES = 120
RASTER_WIDTH = 256  # pixels; the features are sub-pixel, more resolution does not help
MIN_COMMON_FRAMES = 6
MIN_FRAMES = MIN_COMMON_FRAMES + 1  # so that a neighbouring offset can be compared
MIN_T = 3.0  # paired differences, best against every other offset
LEAST_PART = 10  # sampled frames at an end of the clip that are asked for an offset of their own
MIN_CHANGE_T = 2.5  # standard errors; in 20 clips without a gap it was 0.7 at most, in four with one 2.8 to 5.3
GIVE_OFFSET = "give --frame-offset (1 where images are numbered from 1 and tracking from 0)"
_RIDGE = 4.0  # pseudo-frames that say "no pose-dependent misfit"
_CLIP = 9.0  # squared, in units of the best offset's own misfit: one bad mask must not decide
_MASK_ON = 127
_CERTAIN = 100.0  # standard errors; noise-free data would print astronomical ones

Residuals = dict[int, dict[int, np.ndarray]]  # offset -> tracking frame -> one value per feature


@dataclass(frozen=True)
class OffsetEstimate:
    offset: int  # image number - tracking number
    t: float  # by how many standard errors the best offset beats the next best
    runner_up: int
    frames: int
    used_images: bool  # whether the images' motion had to decide

    def sentence(self) -> str:
        witness = " from the motion in the images" if self.used_images else ""
        return (
            f"image offset {self.offset} (image number = tracking number {self.offset:+d}){witness}, "
            f"better than offset {self.runner_up} by {self.t:.1f} standard errors over {self.frames} frames"
        )

    def against(self, given: int) -> str:
        """A sentence where another offset is given; empty where it is this one."""
        return "" if given == self.offset else f"--frame-offset {given} is used, but the frames fit {self.sentence()}"


def detect_offset(
    head: HeadModel,
    tracks: Mapping[int, FrameTrack],
    files: FrameFiles,
    without: Collection[int] = (),
    ignore_misfit: bool = False,
) -> OffsetEstimate:
    """Find the offset, or raise UserError asking for --frame-offset when the evidence does not single one out.

    without        numbers of images that cannot be read
    ignore_misfit  do not blame head model or video where the offset is not clear
    """
    images = {number: path for number, path in files.images.items() if number not in without}
    if min(len(tracks), len(images)) < MIN_FRAMES:
        raise UserError(
            f"there are too few frames to find the offset between images and tracking ({len(images)} images, {len(tracks)} "
            f"tracking frames; {MIN_FRAMES} of each are needed); {GIVE_OFFSET}"
        )
    lips = lip_faces(head)
    use_head, use_mouth = bool(files.head_masks or files.alphas), bool(files.mouth_masks) and len(lips) > 0
    candidates = _candidates(list(images), list(tracks))
    sampled = _frames_with_motion(tracks, use_mouth or not use_head)
    first = next(iter(tracks.values()))
    width = min(RASTER_WIDTH, first.size[0])
    height = max(1, round(first.size[1] * width / first.size[0]))

    bodies, mouths = {}, {}
    for number in sampled:
        screen = project_head(head, tracks[number], first.intrinsics, width, height)
        bodies[number] = silhouette(screen, head.faces.numpy(), width, height)
        mouths[number] = filled_lips(screen, lips, width, height) if use_mouth else None
    # A fixed line through the middle of the head: below it are neck and shoulders, which the mesh does not follow.
    centres = [cv2.moments(body, True) for body in bodies.values()]
    cut = float(np.median([m["m01"] / m["m00"] for m in centres if m["m00"]] or [height])) / height

    needed = sorted({number + offset for number in sampled for offset in candidates} & images.keys())
    observed = _observed_features(needed, files, use_head, use_mouth, cut)
    predicted = {
        n: np.concatenate((_head_features(bodies[n], cut) if use_head else [], _mouth_features(mouths[n])))
        for n in sampled
    }
    residuals = _mask_residuals(predicted, observed, candidates)
    misfits = _misfits(residuals)
    best, runner_up, t = _decide(misfits)
    moving: Residuals = {}
    if t < MIN_T:
        found = motion_residuals(head, tracks, first.intrinsics, images, candidates, sampled, (width, height))
        moving = {offset: rows for offset, rows in found.items() if len(rows) >= MIN_COMMON_FRAMES}
        misfits = _misfits(_joined(residuals, moving))
        best, runner_up, t = _decide(misfits)
    estimate = OffsetEstimate(best, t, runner_up, len(sampled), bool(moving))
    is_edge = not {best - 1, best + 1} <= set(candidates)
    is_clear = t >= MIN_T and not is_edge
    if not is_clear and not ignore_misfit:
        pairs = [(n + best, n) for n in tracks if n + best in images]
        check_sample(head, tracks, files, pairs).refuse()  # the likelier reason
    if not ignore_misfit:
        _refuse_change(misfits, best)
    if not is_clear:
        raise UserError(
            f"the offset between images and tracking is not clear (best is {estimate.sentence()}); look at the frames and "
            f"{GIVE_OFFSET}"
        )
    return estimate


def _candidates(images: Sequence[int], tracking: Sequence[int]) -> list[int]:
    """Around "same number", and around "both start together"."""
    aligned = min(images) - min(tracking)
    return sorted({centre + k for centre in (0, 1, aligned) for k in range(-RADIUS, RADIUS + 1)})


def _frames_with_motion(tracks: Mapping[int, FrameTrack], use_mouth: bool) -> list[int]:
    """Frames in which the head (and the mouth) moves most: where nothing moves, every offset fits alike."""
    numbers = [n for n in tracks if n + 1 in tracks]
    if len(numbers) <= SAMPLED_FRAMES:
        return list(tracks)
    steps = [(tracks[n], tracks[n + 1]) for n in numbers]
    motions = np.array(
        [
            (
                np.abs(b.R - a.R).max() + np.abs(b.t - a.t).max() / max(abs(a.t[2]), 1e-6),
                np.abs(b.jaw - a.jaw).max(),
                np.linalg.norm(b.expression - a.expression),
            )
            for a, b in steps
        ]
    )
    weights = np.array([1.0, 1.0, 1.0] if use_mouth else [1.0, 0.0, 0.0]) / (motions.std(axis=0) + 1e-12)
    order = np.argsort(-(motions @ weights), kind="stable")
    chosen: set[int] = set()
    for i in order:
        if not any(numbers[i] + k in chosen for k in (-1, 1)):
            chosen.add(numbers[i])
        if len(chosen) == SAMPLED_FRAMES:
            break
    return sorted(chosen)


def _observed_features(
    numbers: Sequence[int], files: FrameFiles, use_head: bool, use_mouth: bool, cut: float
) -> dict[int, np.ndarray]:
    """Features of the masks of images that have all kinds of mask."""

    def features(number: int) -> np.ndarray | None:
        head, mouth = read_masks(files, number)
        if (use_head and head is None) or (use_mouth and mouth is None):
            return None
        parts = [_head_features(head > _MASK_ON, cut)] if use_head and head is not None else []
        parts += [_mouth_features(mouth > _MASK_ON)] if use_mouth and mouth is not None else []
        return np.concatenate(parts) if parts else None

    with ThreadPoolExecutor(processor_count()) as pool:
        found = dict(zip(numbers, pool.map(features, numbers), strict=True))
    return {number: values for number, values in found.items() if values is not None}


def _head_features(mask: np.ndarray, cut: float) -> np.ndarray:
    """Centre and area above the cut line, in units of the image width; NaN where nothing is there."""
    height, width = mask.shape
    m = cv2.moments(mask[: round(cut * height)].astype(np.uint8), True)
    if m["m00"] == 0:
        return np.full(3, np.nan)
    return np.array([m["m10"] / m["m00"], m["m01"] / m["m00"], m["m00"] / width]) / width


def _mouth_features(mask: np.ndarray | None) -> np.ndarray:
    """Centre and extent, in units of the image width; NaN where nothing is there."""
    if mask is None:
        return np.zeros(0)
    m = cv2.moments(mask.astype(np.uint8), True)
    if m["m00"] == 0:
        return np.full(4, np.nan)
    spread = np.sqrt(np.array([m["mu20"], m["mu02"]]) / m["m00"])
    return np.array([m["m10"] / m["m00"], m["m01"] / m["m00"], *spread]) / mask.shape[1]


def _mask_residuals(
    predicted: Mapping[int, np.ndarray], observed: Mapping[int, np.ndarray], candidates: Sequence[int]
) -> Residuals:
    """What is left of observed minus predicted features when the part that depends on the pose is taken out."""
    residuals: Residuals = {}
    for offset in candidates:
        common = [
            n
            for n in predicted
            if n + offset in observed and np.isfinite(predicted[n]).all() and np.isfinite(observed[n + offset]).all()
        ]
        if len(common) < MIN_COMMON_FRAMES:
            continue
        p = np.stack([predicted[n] for n in common])
        difference = np.stack([observed[n + offset] for n in common]) - p
        difference -= difference.mean(axis=0)
        pose = (p - p.mean(axis=0)) / (p.std(axis=0) + 1e-9)
        slope = np.linalg.solve(pose.T @ pose + _RIDGE * np.eye(pose.shape[1]), pose.T @ difference)
        residuals[offset] = dict(zip(common, difference - pose @ slope, strict=True))
    return residuals


def _joined(first: Residuals, second: Residuals) -> Residuals:
    """Both kinds of residual of the frames that have both; one kind where there is no other."""
    if not first or not second:
        return first or second
    return {
        offset: {n: np.concatenate((rows[n], second[offset][n])) for n in rows if n in second[offset]}
        for offset, rows in first.items()
        if offset in second
    }


def _misfits(residuals: Residuals) -> dict[int, dict[int, float]]:
    """Offset -> tracking frame -> mean squared residual, in units of the best offset's own residuals."""
    stacks = {k: np.stack(list(rows.values())) for k, rows in residuals.items() if len(rows) >= MIN_COMMON_FRAMES}
    if not stacks:
        return {}
    unit = np.min([np.median(np.abs(r), axis=0) for r in stacks.values()], axis=0) * 1.4826 + 1e-5
    return {
        offset: dict(zip(residuals[offset], np.minimum((r / unit) ** 2, _CLIP).mean(axis=1).tolist(), strict=True))
        for offset, r in stacks.items()
    }


def _decide(misfit: Mapping[int, Mapping[int, float]]) -> tuple[int, int, float]:
    """Best offset, the one nearest to it in misfit, and the standard errors between them, over the frames both have."""
    if not misfit:
        return 0, 0, 0.0
    best = min(misfit, key=lambda offset: float(np.mean(list(misfit[offset].values()))))
    runner_up, smallest = best, np.inf
    for offset in misfit:
        if offset == best:
            continue
        common = sorted(misfit[best].keys() & misfit[offset].keys())
        if len(common) < MIN_COMMON_FRAMES:
            continue
        t = _standard_errors(np.array([misfit[offset][n] - misfit[best][n] for n in common]))
        if t < smallest:
            runner_up, smallest = offset, t
    return best, runner_up, min(smallest, _CERTAIN) if np.isfinite(smallest) else 0.0


def _refuse_change(misfit: Mapping[int, Mapping[int, float]], best: int) -> None:
    """Raise UserError where another offset than the best fits one end of the clip better."""
    most, found = MIN_CHANGE_T, ""
    for offset in misfit.keys() - {best}:
        common = sorted(misfit[best].keys() & misfit[offset].keys())
        gain = np.array([misfit[best][n] - misfit[offset][n] for n in common])
        for at in range(LEAST_PART, len(common) - LEAST_PART + 1):
            for part, where in (
                (gain[:at], f"up to frame {common[at - 1]}"),
                (gain[at:], f"from frame {common[at]} on"),
            ):
                if (t := _standard_errors(part)) > most:
                    most, found = t, f"{offset} {where} of the tracking, by {t:.1f} standard errors"
    if found:
        raise UserError(
            f"the offset between images and tracking changes within the clip: {best} fits all in all, but {found}; one of "
            "them lacks frames: extract the images and track them again, or give --frame-offset to go on regardless"
        )


def _standard_errors(gain: np.ndarray) -> float:
    """Mean of a time series in units of its standard error; tracking errors drift, so neighbours are not independent.

    The number of independent values is n (1 - r) / (1 + r) with the lag-1 autocorrelation r.
    """
    centred = gain - gain.mean()
    variance = float(centred @ centred) / (len(gain) - 1)
    r = float(centred[1:] @ centred[:-1]) / (float(centred @ centred) + 1e-12)
    r = min(max(r, 0.0), 0.9)
    independent = len(gain) * (1 - r) / (1 + r)
    return float(gain.mean() / np.sqrt(variance / independent + 1e-12))
