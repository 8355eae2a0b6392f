"""A tracked folder, read once from end to end; what does not work is gathered instead of raised."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from avatar.compute.processors import processor_count
from avatar.data.source import DEFAULT_FPS, Source
from avatar.data.split import evenly_spread
from avatar.errors import UserError
from avatar.head.assets import HeadAssets
from avatar.head.model import HeadModel
from data_prep.check.examine_image import View, look_at
from data_prep.check.findings import Severity, frames_phrase
from data_prep.formats.detect import METRICAL_TRACKER, open_tracked_folder
from data_prep.formats.frame_files import ALPHA, HEAD, IMAGE, TRACKING, FrameFiles
from data_prep.formats.frame_track import FrameTrack, Tracking, fit_coefficients
from data_prep.formats.metrical_tracker import read_tracking
from data_prep.formats.tracked_folder import TrackedFolder
from data_prep.formats.train_test_split import ALL, FRONT
from data_prep.prepare.check_alignment import SAMPLED_FRAMES, Alignment, measure_alignment
from data_prep.prepare.frame_offset import OffsetEstimate, detect_offset
from data_prep.prepare.mask_overlap import Fit, MeshProjector, fit_of_masks
from data_prep.prepare.mask_values import refuse_colours, with_labels
from data_prep.prepare.masks import read_masks
from data_prep.prepare.pairing import REPEATS, unusable
from data_prep.progress import Progress, silent

MIN_PART = 60  # frames; with fewer in a third of the clip the offset there is not sought
GIVEN, NOT_SOUGHT = "given with --frame-offset", "not looked for: images, tracking or head model are missing"


@dataclass(frozen=True)
class Clip:
    given: Source
    source: TrackedFolder
    tracking: Tracking
    complaints: tuple[tuple[str, str], ...]  # (which check, sentence): what stops `prepare` while reading
    label_notes: tuple[str, ...]  # which masks are label images
    head: HeadModel | None
    offset: int | None  # image number - tracking number; None where it could not be found
    offset_evidence: str  # how it was found, or why it was not
    part_offsets: tuple[int, int] | None  # of the first and the last third, where both are clear
    cameras: int = 1  # that are chosen; the clip has one of them
    views: dict[int, View] = field(default_factory=dict)  # by image number
    fits: dict[int, Fit] = field(default_factory=dict)  # by image number
    steps: dict[int, float] = field(default_factory=dict)  # image number -> mean grey-level change since the one before

    @property
    def files(self) -> FrameFiles:
        return self.source.files

    @property
    def fps(self) -> float:
        """Frames a second."""
        return self.given.fps or self.source.fps or DEFAULT_FPS

    @cached_property
    def alignment(self) -> Alignment | None:
        """What `prepare` says of head and lips against their masks; None where nothing was measured."""
        if not self.fits:
            return None
        measured = [pair for pair in self.pairs() if pair[0] in self.fits]
        return measure_alignment([self.fits[image] for image, _ in evenly_spread(measured, SAMPLED_FRAMES)], self.files)

    @cached_property
    def _listed_names(self) -> dict[int, str]:
        return self.files.frame_names() if self.source.is_paired else {}

    def name(self, number: int) -> str:
        """How the user knows a frame: by its number, or by its image's name where a listing has the frames."""
        return self._listed_names.get(number, f"{number:05d}")

    def image_name(self, number: int) -> str:
        """The name of the image's file; the frame's where the images lie in several folders, which may have equal names."""
        return self.files.images[number].name if self.files.is_one_folder else self.name(number)

    def names(self, numbers: Iterable[int]) -> tuple[str, ...]:
        return tuple(self.name(number) for number in numbers)

    def phrase(self, numbers: Sequence[int]) -> str:
        return frames_phrase(numbers, self.name)

    def loss_severity(self, lost: int, total: int) -> Severity:
        """Frames that cannot be used are left out, up to the share above which `prepare` refuses the folder."""
        return "error" if lost > self.given.max_left_out * total else "warning"

    def picture_loss_severity(self, lost: int, total: int) -> Severity:
        """The same of pictures and masks, of which every camera has as many."""
        return self.loss_severity(lost, total * self.cameras)

    @property
    def lost_pictures(self) -> int:
        """How many cannot be used of the clip's; where it is the tracking's fault, with those of the other cameras."""
        of_tracking = {*self.tracking.bad.values(), REPEATS}
        return sum(self.cameras if reason in of_tracking else 1 for reason in self.left_out.values())

    @cached_property
    def left_out(self) -> dict[int, str]:
        """Image number -> why the frame cannot be used, for the pairs of the clip."""
        kinds = [(kind, found) for kind, found in self.files.of_kind().items() if kind != TRACKING and found]
        bad = {}
        for image, view in self.views.items():
            absent = [self.files.title(kind) for kind, found in kinds if image not in found]
            empty = [what for kind, what in ((HEAD, "head mask"), (ALPHA, "matte")) if view.brightest.get(kind) == 0]
            if view.problems:
                bad[image] = "a file cannot be read"
            elif absent:
                bad[image] = f"it has no file in {', '.join(absent)}"
            elif empty:
                bad[image] = f"its {empty[0]} is empty"
        digests = {image: view.digest for image, view in self.views.items()}
        centre = None if self.head is None else self.head.neutral_vertices().mean(0).numpy()
        return unusable(self.pairs(), self.tracking, bad, digests, centre, self.source.shots)

    def pairs(self) -> list[tuple[int, int]]:
        """(image number, tracking number) of everything that has a partner, usable or not."""
        if self.offset is None:
            return []
        numbers = {*self.tracking.frames, *self.tracking.bad}
        return [(n + self.offset, n) for n in sorted(numbers) if n + self.offset in self.files.images]

    def tracked(self) -> Iterator[tuple[int, FrameTrack]]:
        """(image number, track) of the pairs whose tracking can be read."""
        for image, number in self.pairs():
            if number in self.tracking.frames:
                yield image, self.tracking.frames[number]

    def is_whole(self, image: int) -> bool:
        """Whether the image and its masks can be read and have one size."""
        view = self.views.get(image)
        return view is not None and not view.problems and len(set(view.sizes.values())) == 1

    def size(self) -> tuple[int, int] | None:
        """(width, height) of the first image that can be read."""
        return next((view.sizes[IMAGE] for view in self.views.values() if IMAGE in view.sizes), None)


def read_clip(
    given: Source,
    assets: HeadAssets | None,
    progress: Progress = silent,
) -> Clip:
    """Read everything; `assets` are those of the head model, where there is one. Of several cameras the first of those
    chosen is read, else the front one.

    Raises UserError only when the folder's files cannot be listed.
    """
    complaints: list[tuple[str, str]] = []
    one_camera = given.cameras.split(",")[0] if given.cameras not in (None, ALL) else FRONT
    source = open_tracked_folder(
        given.folder,
        given.tracking,
        given.data_format,
        lambda message: complaints.append(("layout", message)),
        one_camera,
    )
    whole = open_tracked_folder(given.folder, given.tracking, given.data_format, lambda _: None, given.cameras)
    files, label_notes = with_labels(source.files)
    source = replace(source, files=files, notes=whole.notes)  # of all cameras that are chosen
    for check, refuse in (
        ("frame-offset", lambda: source.refuse_offset(given.frame_offset)),
        ("mask-range", lambda: refuse_colours(files)),
    ):
        try:
            refuse()
        except UserError as error:
            complaints.append((check, str(error)))
    views, steps = _read_views(source.files, progress)
    size = next((view.sizes[IMAGE] for view in views.values() if IMAGE in view.sizes), None)
    tracks = _read_tracking(source, assets, size, lambda message: complaints.append(("tracking", message)))
    head = None
    if assets is not None and tracks.frames:
        try:
            tracks = fit_coefficients(tracks, assets, lambda message: complaints.append(("identity", message)))
            head = HeadModel(assets, torch.from_numpy(next(iter(tracks.frames.values())).shape))
        except UserError as error:
            complaints.append(("head-model", str(error)))
    offset, evidence = given.frame_offset, NOT_SOUGHT if given.frame_offset is None else GIVEN
    if source.is_paired:
        offset, evidence = 0, f"images and tracking are paired by {source.files.pairing}"
    clip = Clip(
        given,
        source,
        tracks,
        tuple(complaints),
        tuple(label_notes),
        head,
        offset,
        evidence,
        None,
        max(1, len({shot.camera for shot in whole.shots.values()})),
        views,
        steps=steps,
    )
    if head is None or not clip.files.images:
        return clip
    if not source.is_paired:
        clip = _with_offset(clip, head)
    return replace(clip, fits=_measure_fits(clip, head, progress))


def _read_tracking(
    source: TrackedFolder,
    assets: HeadAssets | None,
    size: tuple[int, int] | None,
    complain: Callable[[str], object],
) -> Tracking:
    if source.format == METRICAL_TRACKER:  # its files say it all
        return read_tracking(source.files.tracking, complain)
    if assets is None or size is None:
        return Tracking({}, {}, [], source.files.tracking)
    return source.read(assets, size, complain)


def _read_views(files: FrameFiles, progress: Progress) -> tuple[dict[int, View], dict[int, float]]:
    views: dict[int, View] = {}
    steps: dict[int, float] = {}
    previous: tuple[int, np.ndarray] | None = None
    numbers = list(files.images)
    with ThreadPoolExecutor(processor_count()) as pool:  # decoding releases the interpreter lock
        looks = pool.map(lambda n: look_at(_files_of(files, n), files.decode), numbers)
        for number, view in zip(numbers, progress(looks, len(numbers), "images"), strict=True):
            views[number] = replace(view, grey=None)
            if view.grey is None:
                continue
            grey = view.grey.astype(np.int16)
            if previous is not None and previous[0] == number - 1 and previous[1].shape == grey.shape:
                steps[number] = float(np.abs(grey - previous[1]).mean())
            previous = number, grey
    return views, steps


def _measure_fits(clip: Clip, head: HeadModel, progress: Progress) -> dict[int, Fit]:
    tracks = {image: track for image, track in clip.tracked() if clip.is_whole(image)}
    project = MeshProjector(head)

    def measure(number: int) -> Fit | None:
        return fit_of_masks(project, tracks[number], *read_masks(clip.files, number))

    with ThreadPoolExecutor(max_workers=2) as pool:  # matrix products do, and have threads of their own
        fits = pool.map(measure, tracks)
        found = dict(zip(tracks, progress(fits, len(tracks), "mesh against masks"), strict=True))
    return {number: fit for number, fit in found.items() if fit is not None}


def _with_offset(clip: Clip, head: HeadModel) -> Clip:
    """Find the offset of the whole clip, and of its first and last third: they differ where frames were dropped."""
    numbers = list(clip.tracking.frames)
    third = len(numbers) // 3
    parts: tuple[int, int] | None = None
    if third >= MIN_PART:
        first, last = (_estimate(clip, head, part) for part in (numbers[:third], numbers[-third:]))
        if isinstance(first, OffsetEstimate) and isinstance(last, OffsetEstimate):
            parts = first.offset, last.offset
    estimate, given = _estimate(clip, head, numbers), clip.given.frame_offset
    if given is not None:
        against = estimate.against(given) if isinstance(estimate, OffsetEstimate) else ""
        return replace(clip, offset_evidence=against or GIVEN, part_offsets=parts)
    if isinstance(estimate, OffsetEstimate):
        return replace(clip, offset=estimate.offset, offset_evidence=estimate.sentence(), part_offsets=parts)
    return replace(clip, offset=None, offset_evidence=estimate, part_offsets=parts)


def _estimate(clip: Clip, head: HeadModel, numbers: list[int]) -> OffsetEstimate | str:
    """The offset of these tracking frames, or the sentence that says why it is not clear."""
    tracks = {n: clip.tracking.frames[n] for n in numbers}
    without = {n for n in clip.files.images if not clip.is_whole(n)}
    try:
        return detect_offset(head, tracks, clip.files, without, clip.given.ignore_misfit)
    except UserError as error:
        return str(error)


def _files_of(files: FrameFiles, number: int) -> Mapping[str, Path]:
    kinds = {kind: found for kind, found in files.of_kind().items() if kind != TRACKING}
    return {kind: found[number] for kind, found in kinds.items() if number in found}
