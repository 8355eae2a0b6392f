"""Whether this tracking, on this head model, is of this video at all: head and lips against their masks, each by itself.

A head model of another topology takes the tracking's coefficients for other directions. Its outline lies on the head masks
all the same, because heads are alike; its lips are away from where they are seen. Medians of 24 frames of four rendered
clips whose tracking error is known (0.15 degrees, 0.4 mm, 2%), at 192 to 256 pixels:

                                             IoU of head     IoU of lips     lips away, of the head's size
    the right head model                     0.82 to 0.94    0.81 to 0.97    0.1% to 0.5%
    and 1 degree, 2 mm, 20% more error       0.81 to 0.92    0.69 to 0.79    1.7% to 2.0%
    and mouth masks 2 pixels larger around   0.82 to 0.94    0.56 to 0.59    0.2% to 0.5%
    FLAME 2023 Open instead                  0.62 to 0.81    0.17 to 0.50    3.5% to 11.5%
    a third topology instead                 0.71 to 0.87    0.36 to 0.66    2.2% to 5.4%
    the right one, 1 cm aside                0.76 to 0.83    0.50 to 0.60    6.0% to 6.4%

Masks that are drawn otherwise cost overlap, a bad tracking costs distance; another head costs both.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from avatar.data.split import evenly_spread
from avatar.errors import UserError
from avatar.head.model import HeadModel
from data_prep.formats.frame_files import FrameFiles
from data_prep.formats.frame_track import FrameTrack
from data_prep.formats.tracked_folder import Shot
from data_prep.prepare.mask_overlap import Fit, MeshProjector, fit_of_masks
from data_prep.prepare.masks import read_masks

MIN_HEAD = 0.3  # IoU with the head mask; a head that is moved by half its width has 0.33
MIN_ON_MATTE = 0.5  # of the head; a matte holds clothes too, so that there is no telling its IoU
MIN_LIPS = 0.6  # IoU with the mouth mask ...
MAX_LIPS_AWAY = 0.025  # ... and between their centres, of the size of the projected head without neck
MIN_PIXELS_AWAY = 1.5  # masks of tiny pictures are no better than that
MAX_OUTSIDE = 0.01  # of the head's vertices
CUT_OFF = "what is cut off cannot be learned"
SAMPLED_FRAMES = 24
SAMPLED_OF_A_CAMERA = 6  # of several
NO_MASKS = "there are no masks to confirm it with"
ADVICE = (
    "is the head model the one that the tracking was made with, and the tracking of this video? Give the right one "
    "(--head, --tracking), or --ignore-misfit to go on regardless"
)


@dataclass(frozen=True)
class Alignment:
    """What head and lips say, for people."""

    evidence: str  # `head overlap 0.940, lips overlap 0.820, 0.4% of the head's size away`, or that there are no masks
    problem: str | None  # which of the two does not lie where, None where both do
    notes: tuple[str, ...] = ()  # what else should be known

    def refuse(self) -> None:
        """Raises UserError where there is a problem."""
        if self.problem is not None:
            raise UserError(f"{self.problem}; {ADVICE}")


def check_sample(
    head: HeadModel, tracks: Mapping[int, FrameTrack], files: FrameFiles, pairs: Sequence[tuple[int, int]]
) -> Alignment:
    """The alignment in a few frames spread over `pairs` of image number and tracking number, all of which can be read."""
    project = MeshProjector(head)
    chosen = evenly_spread(pairs, SAMPLED_FRAMES)
    fits = [fit_of_masks(project, tracks[number], *read_masks(files, image)) for image, number in chosen]
    return measure_alignment([fit for fit in fits if fit is not None], files)


def refuse_misplaced_cameras(
    head: HeadModel,
    tracks: Mapping[int, FrameTrack],
    files: FrameFiles,
    pairs: Sequence[tuple[int, int]],
    shots: Mapping[int, Shot],
) -> None:
    """Raise UserError for a camera of several in whose pictures the head is not where its pose puts it."""
    for camera in dict.fromkeys(shot.camera for shot in shots.values()):
        seen = [pair for pair in pairs if shots[pair[0]].camera == camera]
        problem = check_sample(head, tracks, files, evenly_spread(seen, SAMPLED_OF_A_CAMERA)).problem
        if problem is not None:
            raise UserError(
                f"camera {camera}: {problem}; is its calibration right? Leave it out with --cameras, or say "
                "--ignore-misfit to go on regardless"
            )


def measure_alignment(fits: Sequence[Fit], files: FrameFiles) -> Alignment:
    """From how each frame's mesh lies on the masks of `files`."""
    head, inside, lips, pixels = (
        _median([getattr(f, name) for f in fits]) for name in ("overlap", "inside", "lips", "mouth")
    )
    away = _median([fit.mouth / fit.size for fit in fits])
    by_matte = not files.head_masks and not files.parsing
    seen = {}
    if np.isfinite(head):
        seen["head"] = f"overlap {head:.3f}" + (f", {inside:.0%} of it on the matte" if by_matte else "")
    if np.isfinite(lips):
        seen["lips"] = f"overlap {lips:.3f}" + (f", {away:.1%} of the head's size away" if np.isfinite(away) else "")
    head_is_off = "head" in seen and (inside < MIN_ON_MATTE if by_matte else head < MIN_HEAD)
    lips_are_off = "lips" in seen and lips < MIN_LIPS and not (away <= MAX_LIPS_AWAY or pixels <= MIN_PIXELS_AWAY)
    problem = None
    if head_is_off and lips_are_off:
        problem = f"neither the tracked head ({seen['head']}) nor its lips ({seen['lips']}) lie on the masks"
    elif head_is_off:
        problem = f"the tracked head does not lie on the masks ({seen['head']})"
    elif lips_are_off:
        but = f", although the head lies on its masks ({seen['head']})" if "head" in seen else ""
        problem = f"the tracked lips do not lie on the mouth masks ({seen['lips']}){but}"
    outside = _median([fit.outside for fit in fits])
    notes = (
        (f"{outside:.0%} of the tracked head lies outside the pictures: {CUT_OFF}",) if outside > MAX_OUTSIDE else ()
    )
    return Alignment(", ".join(f"{what} {how}" for what, how in seen.items()) or NO_MASKS, problem, notes)


def _median(values: Sequence[float]) -> float:
    """Of the finite values; NaN where there are none."""
    finite = [value for value in values if np.isfinite(value)]
    return float(np.median(finite)) if finite else np.nan
