"""Findings about how the tracked head lies on the masks: over the clip, and in single frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from data_prep.check.clip import Clip
from data_prep.check.findings import Finding, from_sentence
from data_prep.prepare.check_alignment import ADVICE
from data_prep.prepare.mask_polarity import polarity_problems

# Of the size of the projected head. On clips whose tracking error is known (0.15 degrees, 0.4 mm, 2%) lips are off by less
# than 0.018 and the mesh sticks out of the mask by less than 0.01.
MAX_MOUTH, MAX_OVERHANG = 0.05, 0.05
MIN_INSIDE = 0.9  # of the mesh without neck; the same clips have 0.99
# On the same clips, lips overlap by more than 0.8, or are off by less than 0.005 where masks are drawn otherwise.
USUAL_LIPS, USUAL_AWAY, MIN_PIXELS = 0.8, 0.012, 1.0  # overlap; of the head's size; pixels
MIN_DROP = 0.3  # of the overlap of lips in a frame, below the clip's own median
_ROBUST_SD = 1.4826  # times the median absolute deviation: the standard deviation of a normal distribution
_OUTLIER = 6.0  # robust standard deviations
IGNORED = "nothing, if you are sure: --ignore-misfit lets training start; compare mesh and masks on the page of --out"


def check_fit(clip: Clip) -> list[Finding]:
    return (
        list(_polarity(clip))  # no mesh lies on inverted masks
        or list(_misfit(clip))
        or [*_lips(clip), *_distances(clip)]
        or list(_inside(clip))
    )


def _polarity(clip: Clip) -> Iterator[Finding]:
    if clip.head is None:
        return
    unread = [number for number in clip.files.images if not clip.is_whole(number)]
    problems = polarity_problems(clip.head, clip.tracking.frames, clip.files, clip.given.max_left_out, unread)
    for finding in (from_sentence("inverted-mask", problem) for problem in problems):
        yield replace(finding, severity="warning", advice=IGNORED) if clip.given.ignore_misfit else finding


def _misfit(clip: Clip) -> Iterator[Finding]:
    if clip.alignment is not None and clip.alignment.problem is not None:
        severity, advice = ("warning", IGNORED) if clip.given.ignore_misfit else ("error", ADVICE)
        yield Finding(severity, "residual", clip.alignment.problem, advice)


def _distances(clip: Clip) -> Iterator[Finding]:
    numbers, fits = list(clip.fits), list(clip.fits.values())
    size = np.array([fit.size for fit in fits])
    overhang, mouth = np.array([f.overhang for f in fits]) / size, np.array([f.mouth for f in fits]) / size
    for what, values, limit, region in (
        ("the tracked head sticks out of the head mask", overhang, MAX_OVERHANG, "head"),
        ("the tracked lips are away from the mouth mask", mouth, MAX_MOUTH, "mouth"),
    ):
        if not np.isfinite(values).any():
            continue
        pixels = values * size
        usual = float(np.nanmedian(values))
        if usual > limit:
            yield Finding(
                "warning",
                "residual",
                f"{what} by {np.nanmedian(pixels):.1f} pixels in the median over the clip ({usual:.1%} of the head's "
                f"size)",
                f"compare mesh and {region} mask on the page of --out; the tracking or its camera is off",
            )
            continue
        spread = _ROBUST_SD * float(np.nanmedian(np.abs(values - usual)))
        off = [n for n, value in zip(numbers, values, strict=True) if value > max(limit, usual + _OUTLIER * spread)]
        if off:
            worst = int(np.nanargmax(values))
            yield Finding(
                "warning",
                "residual",
                f"{what} in {clip.phrase(off)}: {pixels[worst]:.1f} pixels in {clip.name(numbers[worst])}, where "
                f"{np.nanmedian(pixels):.1f} is usual",
                "look at these frames: is the mask wrong or the tracking? Redo it, or remove the frames",
                clip.names(off),
            )


def _inside(clip: Clip) -> Iterator[Finding]:
    inside = np.array([fit.inside for fit in clip.fits.values()])
    if np.isfinite(inside).any() and np.nanmedian(inside) < MIN_INSIDE:
        yield Finding(
            "warning",
            "residual",
            f"only {np.nanmedian(inside):.0%} of the tracked head (without neck) lies on the head mask, in the median",
            "is the mask of the whole head with hair, or of the face alone? The rest is trained to be background",
        )


def _lips(clip: Clip) -> Iterator[Finding]:
    """Lips that do not follow the mouth in the pictures: over the clip, and in single frames."""
    fits = {n: fit for n, fit in clip.fits.items() if np.isfinite(fit.lips) and np.isfinite(fit.mouth / fit.size)}
    if not fits:
        return
    overlap = np.array([fit.lips for fit in fits.values()])
    usual = float(np.median(overlap))
    pixels = float(np.median([fit.mouth for fit in fits.values()]))
    away = float(np.median([fit.mouth / fit.size for fit in fits.values()]))
    if usual < USUAL_LIPS and away > USUAL_AWAY and pixels >= MIN_PIXELS:
        yield Finding(
            "warning",
            "lips",
            f"in the median, the tracked lips overlap the mouth masks by only {usual:.2f} and lie {pixels:.1f} pixels "
            f"away ({away:.1%} of the head's size)",
            "does the tracked mouth open and close with the video's? Compare them on the page of --out",
        )
        return
    spread = _ROBUST_SD * float(np.median(np.abs(overlap - usual)))
    least = usual - max(MIN_DROP, _OUTLIER * spread)
    low = [n for n, f in fits.items() if f.lips < least and MIN_PIXELS < f.mouth <= MAX_MOUTH * f.size]  # not far away
    if not low:
        return
    worst = min(low, key=lambda n: fits[n].lips)
    yield Finding(
        "warning",
        "lips",
        f"the tracked lips hardly overlap the mouth mask in {clip.phrase(low)}: {fits[worst].lips:.2f} in "
        f"{clip.name(worst)}, where {usual:.2f} is usual",
        "look at these frames: is the mask wrong or the tracking? Redo it, or remove the frames",
        clip.names(low),
    )
