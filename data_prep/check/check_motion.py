"""Findings about the tracked head over the clip: parts that stand still, a head that lies, what is cut off."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from data_prep.check.clip import Clip
from data_prep.check.findings import Finding, Severity
from data_prep.check.head_angles import head_angles
from data_prep.prepare.check_alignment import CUT_OFF, MAX_OUTSIDE
from data_prep.prepare.constant_parameters import ConstantParameter, constant_parameters

MAX_ROLL = 60.0  # degrees; people tilt their heads by 40
MAX_CUT = 0.03  # of the upper edge; a mask that ends there is rounded


def check_motion(clip: Clip) -> list[Finding]:
    return [*_flaws(clip), *_still(clip), *_repeated_expression(clip), *_roll(clip), *_cut_off(clip)]


def _flaws(clip: Clip) -> Iterator[Finding]:
    advice = "track it again with one camera and one identity for the whole clip"
    yield from (Finding("warning", "tracking-changes", flaw, advice) for flaw in clip.tracking.flaws)


def _parts(clip: Clip) -> list[ConstantParameter]:
    return [] if clip.head is None else constant_parameters([track for _, track in clip.tracked()], clip.head.assets)


def _still(clip: Clip) -> Iterator[Finding]:
    for part in _parts(clip):
        advice = (
            "nothing, if the tracker has no place for it" if part.is_absent else "track the clip again, with it free"
        )
        yield Finding("note" if part.is_absent else "warning", "still-part", part.sentence, advice)


def _repeated_expression(clip: Clip) -> Iterator[Finding]:
    """Frames whose expression is the one before's to the bit, although the picture is another and the pose moves on."""
    tracked = dict(clip.tracked())
    if any(part.part == "expression" for part in _parts(clip)):
        return  # it never moves
    repeated = [
        n
        for n, track in tracked.items()
        if n - 1 in tracked
        and np.array_equal(track.expression, tracked[n - 1].expression)
        and not np.array_equal(track.moving_values(), tracked[n - 1].moving_values())
        and clip.views[n].digest != clip.views[n - 1].digest
    ]
    if not repeated:
        return
    yield Finding(
        "warning",
        "expression-repeats",
        "the tracked expression repeats that of the frame before, while image and pose do not, in "
        + clip.phrase(repeated),
        "the tracker lost the expression there: track these frames again, or remove them",
        clip.names(repeated),
    )


def _roll(clip: Clip) -> Iterator[Finding]:
    tracked = dict(clip.tracked()) or dict(clip.tracking.frames)
    if not tracked:
        return
    roll = head_angles(np.stack([track.R for track in tracked.values()])).roll
    lying = [n for n, angle in zip(tracked, roll, strict=True) if abs(angle) >= MAX_ROLL]
    if not lying:
        return
    most = float(roll[np.abs(roll).argmax()])
    yield Finding(
        "warning",
        "head-roll",
        f"the head lies on its side or stands on its crown in {clip.phrase(lying)}: a roll of up to {most:.0f} degrees",
        "turn the video upright and track it again (avatar track --rotate 90, 180 or 270)",
        clip.names(lying),
    )


def _cut_off(clip: Clip) -> Iterator[Finding]:
    """A head that is not wholly in the picture. Hair that touches its edge now and then is a note."""
    outside = {n: fit.outside for n, fit in clip.fits.items() if fit.outside > MAX_OUTSIDE}
    cut = {n: view.cut for n, view in clip.views.items() if view.cut > MAX_CUT}
    usually: Severity = "warning" if 2 * len(cut) > len(clip.views) else "note"
    kinds: list[tuple[dict[int, float], Severity, str]] = [
        (outside, "warning", "of the tracked head (without neck) lies outside the picture"),
        (cut, usually, "of the upper edge is covered by the head mask"),
    ]
    for shares, severity, sentence in kinds:
        if shares:
            worst = max(shares, key=lambda n: shares[n])
            yield Finding(
                severity,
                "cut-off",
                f"up to {shares[worst]:.0%} {sentence} ({clip.name(worst)}), in {clip.phrase(list(shares))}",
                f"leave more room around the head when you record or crop the video: {CUT_OFF}",
                clip.names(shares),
            )
