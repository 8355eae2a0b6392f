"""Findings about files: missing, extra, unreadable, of the wrong size, without partner."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from avatar.data.read_image import IMAGE_SUFFIXES
from data_prep.check.clip import Clip
from data_prep.check.findings import Finding, from_sentence
from data_prep.formats.frame_files import ALPHA, HEAD, IMAGE, describe_numbers, gaps
from data_prep.prepare.frame_offset import RADIUS
from data_prep.prepare.mask_values import judge_values, mask_kinds
from data_prep.prepare.pairing import describe_reasons

_SHOWN = 6  # file names in a sentence


def check_files(clip: Clip) -> list[Finding]:
    return [
        *(from_sentence(check, sentence) for check, sentence in clip.complaints),
        *_unreadable(clip),
        *_sizes(clip),
        *_mask_values(clip),
        *_missing_masks(clip),
        *_partners(clip),
        *_extra(clip),
    ]


def _unreadable(clip: Clip) -> Iterator[Finding]:
    for kind in clip.files.of_kind():
        reasons = {n: view.problems[kind] for n, view in clip.views.items() if kind in view.problems}
        if not reasons:
            continue
        shown = [reason.partition("; ")[0] for reason in list(reasons.values())[:_SHOWN]]
        advice = next(iter(reasons.values())).partition("; ")[2] or "write or copy it again"
        rest = f" and {len(reasons) - _SHOWN} more" if len(reasons) > _SHOWN else ""
        yield Finding(
            clip.picture_loss_severity(len(reasons), len(clip.views)),
            "unreadable",
            f"{len(reasons)} of {len(clip.views)} files of {clip.files.title(kind)} cannot be read: "
            f"{', '.join(shown)}{rest}",
            f"{advice}; frames without them are left out of training",
            clip.names(reasons),
        )


def _sizes(clip: Clip) -> Iterator[Finding]:
    counts = Counter(view.sizes[IMAGE] for view in clip.views.values() if IMAGE in view.sizes)
    if not counts:
        return
    usual = counts.most_common(1)[0][0]
    for kind, paths in clip.files.of_kind().items():
        odd = [n for n, view in clip.views.items() if view.sizes.get(kind, usual) != usual]
        if odd:
            width, height = clip.views[odd[0]].sizes[kind]
            yield Finding(
                "error",
                "sizes",
                f"{len(odd)} files of {clip.files.title(kind)} are not {usual[0]}x{usual[1]} pixels as most images "
                f"are: {describe_numbers(odd, name=clip.name)} ({paths[odd[0]].name} is {width}x{height})",
                "bring all images and masks of the clip to one size",
                clip.names(odd),
            )
    tracked = next(iter(clip.tracking.frames.values()), None)
    if tracked is not None and tracked.size != usual:
        yield Finding(
            "error",
            "sizes",
            f"the tracking was made on {tracked.size[0]}x{tracked.size[1]} images, but those in "
            f"{clip.files.title(IMAGE)} are {usual[0]}x{usual[1]}",
            "resize the images to the size of the tracking, or track them again",
        )


def _mask_values(clip: Clip) -> Iterator[Finding]:
    yield from (Finding("note", "mask-labels", note, "nothing, if that is meant") for note in clip.label_notes)
    for kind, paths in mask_kinds(clip.files).items():
        seen = [view for view in clip.views.values() if kind in view.brightest]
        if not seen:
            continue
        darkest, brightest = min(view.darkest[kind] for view in seen), max(view.brightest[kind] for view in seen)
        problem, note = judge_values(kind, paths, darkest, brightest)
        if problem:
            yield from_sentence("mask-range", problem)
        if note:
            yield Finding("warning", "mask-range", note, "make these masks again")
    for kind, what in ((HEAD, "head mask"), (ALPHA, "matte")):
        empty = [n for n, view in clip.views.items() if view.brightest.get(kind) == 0]
        if empty:
            yield Finding(
                clip.picture_loss_severity(len(empty), len(clip.views)),
                "empty-mask",
                f"the {what} is empty in {clip.phrase(empty)}: no head was found there",
                "segment them again, or accept that they are left out of training",
                clip.names(empty),
            )


def _missing_masks(clip: Clip) -> Iterator[Finding]:
    for kind, found in clip.files.of_kind().items():
        missing = sorted(clip.files.images.keys() - found.keys())
        if kind in (IMAGE, "checkpoint") or not found or not missing:
            continue
        yield Finding(
            clip.picture_loss_severity(len(missing), len(clip.files.images)),
            "missing",
            f"{clip.files.title(kind)} has no file for {len(missing)} of {len(clip.files.images)} images: "
            f"{describe_numbers(missing, name=clip.name)}",
            "make the masks of these images; without them the frames are left out of training",
            clip.names(missing),
        )


def _partners(clip: Clip) -> Iterator[Finding]:
    """Images without tracking and tracking without images, under the offset; numbers that both skip."""
    if clip.offset is None:
        return
    images, tracking = clip.files.images, {n + clip.offset: path for n, path in clip.files.tracking.items()}
    for what, have, other in (
        ("images have no tracking", images, tracking),
        ("tracking frames have no image", tracking, images),
    ):
        alone = sorted(have.keys() - other.keys())
        if not alone:
            continue
        # An offset leaves a few without partner at the ends; `prepare` refuses more.
        at_ends = not other or all(n < min(other) or n > max(other) for n in alone)
        is_refused = len(alone) > max(clip.given.max_left_out * len(have), RADIUS)
        severity = "error" if is_refused else "note" if at_ends else "warning"
        names = [clip.name(n) if clip.source.is_paired else have[n].name for n in alone[:_SHOWN]]
        shown = ", ".join(names) + (f" and {len(alone) - _SHOWN} more" if len(alone) > _SHOWN else "")
        yield Finding(
            severity,
            "unpaired",
            f"{len(alone)} {what} under the offset {clip.offset}: {shown}",
            "are both of the same video? Track it again, or extract its frames again"
            if severity != "note"
            else "nothing: a few at the ends are usual, and are left out",
            clip.names(alone),
        )
    skipped = sorted(set(gaps(images)) & set(gaps(tracking)))
    if skipped and clip.files.is_numbered_by_names:
        yield Finding(
            "note",
            "gaps",
            f"images and tracking both skip the numbers {describe_numbers(skipped, name=clip.name)}",
            "nothing, if frames were removed on purpose: training does not need them to be consecutive",
            clip.names(skipped),
        )


def _extra(clip: Clip) -> Iterator[Finding]:
    for kind, found in clip.files.of_kind().items():
        extra = sorted(found.keys() - clip.files.images.keys())
        if kind not in (IMAGE, "checkpoint") and extra and clip.files.images:
            yield Finding(
                "note",
                "extra",
                f"{clip.files.title(kind)} has files without an image: {describe_numbers(extra, name=clip.name)}",
                "nothing, if images were removed on purpose: these masks are not used",
                clip.names(extra),
            )
    strangers = [
        path.relative_to(clip.files.folder).as_posix()
        for name, suffixes in (("imgs", IMAGE_SUFFIXES), ("alpha", IMAGE_SUFFIXES), ("checkpoint", (".frame",)))
        for path in sorted((clip.files.folder / name).glob("[!.]*"))
        if not clip.source.is_paired  # a listing names its files, whatever lies beside them
        if path.suffix.lower() not in suffixes
    ]
    if strangers:
        more = f" and {len(strangers) - _SHOWN} more" if len(strangers) > _SHOWN else ""
        yield Finding(
            "note",
            "extra",
            f"files of another kind lie among the frames: {', '.join(strangers[:_SHOWN])}{more}",
            "nothing, unless a frame was meant: they are not read",
            tuple(strangers),
        )


def lost_frames(clip: Clip) -> Iterator[Finding]:
    """An error where many small losses together are more than `prepare` accepts."""
    total, reasons = len(clip.pairs()), clip.left_out
    if clip.picture_loss_severity(clip.lost_pictures, total) == "error":
        yield Finding(
            "error",
            "left-out",
            f"{len(reasons)} of {total} frames cannot be used, more than {clip.given.max_left_out:.0%}: "
            f"{describe_reasons(reasons, clip.name)}",
            "mend what is named, or train without these frames: --max-left-out allows more",
            clip.names(reasons),
        )
