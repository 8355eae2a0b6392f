"""Findings about what the images and masks show: repeated frames, light that changes, mattes that leak."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np

from data_prep.check.clip import Clip
from data_prep.check.findings import Finding
from data_prep.prepare.inspect_images import composited_background

# Neighbours differ by at least half of the clip's median difference in clips without repeats; an encoder that repeats a
# frame leaves far less.
REPEAT = 0.15  # of the median difference
MIN_REPEATS_FOR_PERIOD = 4
EXPOSURE = 0.15  # stops, 11%; an untouched camera stays within 0.02 on the background
HEAD_EXPOSURE = 0.3  # stops; a turning head alone changes by up to 0.15
_STEADY = 25  # frames (one second) that are averaged before comparing
MAX_HAZE, MAX_HOLES, MAX_SPECKS = 0.02, 0.02, 0.02  # good mattes have 0.000
MASK_CHANGE = 1.25  # the head mask's area against the projected head's varies by 7% in good clips
MAX_COVERED = 0.95  # of the image
MAX_MASK_RATIO = 4.0  # head masks with hair have 1.2 to 1.4 times the projected head's area


def check_images(clip: Clip) -> list[Finding]:
    return [*_repeated(clip), *_composited(clip), *_matte(clip), *_mask_area(clip), *_exposure(clip)]


def repeated_images(clip: Clip) -> list[int]:
    """Images that show what the one before shows: the same file, or a difference far below the usual one."""
    usual = float(np.median(list(clip.steps.values()))) if clip.steps else 0.0
    return [
        n for n, step in clip.steps.items() if clip.views[n].digest == clip.views[n - 1].digest or step < REPEAT * usual
    ]


def _repeated(clip: Clip) -> Iterator[Finding]:
    repeated = repeated_images(clip)
    if not repeated:
        return
    spacing, times = Counter(np.diff(repeated).tolist()).most_common(1)[0] if len(repeated) > 1 else (0, 0)
    every = ""
    if spacing > 1 and times >= max(MIN_REPEATS_FOR_PERIOD - 1, 0.8 * (len(repeated) - 1)):
        every = f", every {spacing}th: the frame rate was changed when they were extracted"
    yield Finding(
        "warning",
        "repeated-images",
        f"the image repeats the one before in {clip.phrase(repeated)}{every}",
        "extract the frames at the video's own rate (ffmpeg -fps_mode passthrough) and track those",
        clip.names(repeated),
    )


def _flat_background(clip: Clip) -> str | None:
    bad = {n: "" for n in clip.files.images if not clip.is_whole(n)}
    return composited_background(clip.files, bad) if clip.files.alphas else None


def _composited(clip: Clip) -> Iterator[Finding]:
    colour = _flat_background(clip)
    if colour is None or clip.files.is_transparent:  # a PNG keeps its colours whole beside its transparency
        return
    yield Finding(
        "warning",
        "composited",
        f"the images seem to be composited on {colour} already: compositing them again with their matte squares "
        "it at the edges (hair gets a rim of that colour)",
        f"use the frames as the camera recorded them; or train with this background colour ({colour})",
    )


_MATTE_LIMITS = (  # check, measure of `Matte`, limit, problem, advice
    (
        "background-leak",
        "haze",
        MAX_HAZE,
        "the background shines through far from the person (mean weight up to {worst:.0%})",
        "make the matte again, or add head masks where the format has them: they cut the background off",
    ),
    (
        "background-leak",
        "specks",
        MAX_SPECKS,
        "pieces apart from the person count as head (up to {worst:.0%} of its area)",
        "remove all but the largest piece from the masks, or make them again",
    ),
    (
        "matte-holes",
        "holes",
        MAX_HOLES,
        "the matte is transparent inside the head mask (up to {worst:.0%} of it)",
        "make the matte again: training sees the background colour in the face there",
    ),
)


def _matte(clip: Clip) -> Iterator[Finding]:
    mattes = {n: view.matte for n, view in clip.views.items() if view.matte is not None}
    for check, measure, limit, problem, advice in _MATTE_LIMITS:
        values = {n: getattr(matte, measure) for n, matte in mattes.items()}
        over = [n for n, value in values.items() if value > limit]
        if over:
            sentence = problem.format(worst=max(values.values()))
            yield Finding("warning", check, f"{sentence} in {clip.phrase(over)}", advice, clip.names(over))
    whole = [n for n, matte in mattes.items() if matte.covered > MAX_COVERED]
    if whole:
        yield Finding(
            "warning",
            "background-leak",
            f"matte and head mask cover the whole image in {clip.phrase(whole)}: the background is trained as head",
            "make masks of the head alone",
            clip.names(whole),
        )


def _mask_area(clip: Clip) -> Iterator[Finding]:
    ratios = {n: fit.mask_ratio for n, fit in clip.fits.items() if np.isfinite(fit.mask_ratio)}
    if not ratios or clip.alignment is None or clip.alignment.problem is not None:
        return  # the mesh lies elsewhere: its area says nothing about the mask's
    usual = float(np.median(list(ratios.values())))
    if usual > MAX_MASK_RATIO:
        yield Finding(
            "warning",
            "background-leak",
            f"the head masks are {usual:.1f} times as large as the tracked head in the median",
            "leave clothes and background out of the head masks: they do not move with the head",
        )
        return
    for is_odd, what, advice in (
        (lambda r: r > MASK_CHANGE * usual, "larger", "background is taken for head"),
        (lambda r: r * MASK_CHANGE < usual, "smaller", "parts of the head are missing"),
    ):
        odd = [n for n, ratio in ratios.items() if is_odd(ratio)]
        if odd:
            worst = max(odd, key=lambda n: abs(np.log(ratios[n] / usual)))
            yield Finding(
                "warning",
                "mask-area",
                f"the head mask is much {what} than usual against the tracked head in {clip.phrase(odd)} "
                f"({ratios[worst] / usual:.2f} times in {clip.name(worst)})",
                f"make these masks again: {advice}",
                clip.names(odd),
            )


def exposure(clip: Clip) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Image numbers and, in stops against the clip's median, the light of head and of background [n].

    Both are NaN where they are black; the background where there is none to see.
    """
    numbers = [n for n, view in clip.views.items() if view.head_colour is not None]
    if not numbers:
        return None

    def stops(colours: list[np.ndarray | None]) -> np.ndarray:
        level = np.array([np.nan if c is None else c.mean() for c in colours])
        if np.isnan(level).mean() > 0.5 or np.nanmedian(level) < 4:
            return np.full(len(level), np.nan)
        return np.log2(np.maximum(level, 1) / np.nanmedian(level))

    head = stops([clip.views[n].head_colour for n in numbers])
    background = stops([clip.views[n].background_colour for n in numbers])
    return np.array(numbers), head, background


def _exposure(clip: Clip) -> Iterator[Finding]:
    """The camera's exposure changes what head and background show alike; a lamp or a turning head does not."""
    measured = exposure(clip)
    if measured is None:
        return
    numbers, head, background = measured
    if np.isnan(head).all():
        return
    has_background = bool(np.isfinite(background).all()) and _flat_background(clip) is None
    both = np.where(np.sign(head) == np.sign(background), np.sign(head), 0) * np.minimum(abs(head), abs(background))
    change = moving_median(both if has_background else head)
    low, high = int(np.argmin(change)), int(np.argmax(change))
    span = float(change[high] - change[low])
    if span <= (EXPOSURE if has_background else HEAD_EXPOSURE):
        return
    where = "head and background together" if has_background else "the head"
    yield Finding(
        "warning",
        "exposure",
        f"the brightness of {where} changes by {span:.2f} stops ({2**span - 1:.0%}) over the clip: darkest about "
        f"{clip.name(numbers[low])}, brightest about {clip.name(numbers[high])}",
        "record with exposure and white balance locked; the avatar has one colour and averages the two",
        clip.names((int(numbers[low]), int(numbers[high]))),
    )


def moving_median(values: np.ndarray) -> np.ndarray:
    """Moving median over a second, so that one frame does not count as a change of light."""
    half = min(_STEADY, len(values)) // 2
    return np.array([np.nanmedian(values[max(0, i - half) : i + half + 1]) for i in range(len(values))])
