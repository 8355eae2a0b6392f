"""What a plain video costs against the true tracking: a subject's pictures as a video, tracked, and made into avatars.

A subject's own folder is the truth. Of demo subjects the pictures in a room, with noise and compression, are the video
that `avatar track` gets, with no choice made; of a SUBJECT the pictures as they are.

Avatars of one recipe: trained on the true folder, on the video's frames and masks with the true tracking, on what `avatar
track` made, and on that as `avatar train --refine 1` and `--refine 2` refine it. Each is driven by its own tracking and
measured on held-out frames, against the true pictures in the true head masks.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch

from avatar.bench import Request
from avatar.bench.figures import Figures
from avatar.bench.refine import MEASURED_EVERY, Trial, driven_figures, planned_steps
from avatar.bench.reprojection import Placement, placement
from avatar.bench.results import write_report
from avatar.config import Config, load_config
from avatar.data.recording import TRACK_SHAPES, Recording
from avatar.data.source import Source
from avatar.data.subject import Subject
from avatar.demo.raw_video import in_room
from avatar.demo.subject import make_subject
from avatar.errors import UserError
from avatar.files.video import video_writer
from avatar.head.assets import HeadAssets
from avatar.pipeline.cached_tracking import progress_bar
from data_prep.formats.avatar_track import LANDMARKS_FILE
from data_prep.prepare.open_subject import find_head, open_subject
from data_prep.track.faces.landmarks import load_landmarks
from data_prep.track.fit.camera import Pinhole
from data_prep.track.fit.fit_clip import as_tracks, find_embedding
from data_prep.track.fit.landmark_fit import fit_landmarks
from data_prep.track.track import Choices, track

SEEDS, ALL_SEEDS = (1,), (1, 2, 3)
TRUE, PICTURES, AUTOMATIC = "true", "true, video's pictures", "automatic"
REFINED, AGAIN = "refined once", "refined twice"
COMPARED_EVERY = 5  # frames whose masks are compared


@dataclass(frozen=True)
class Scale:
    frames: int
    filmed: int  # pixels of the video, a side
    size: int  # pixels that avatars are trained and measured at
    iterations: int


USUAL, QUICK = Scale(120, 512, 160, 1000), Scale(14, 192, 48, 8)


@dataclass(frozen=True)
class Result:
    """Of one subject."""

    name: str
    size: tuple[int, int]  # of the video, pixels
    frames: int  # of the video
    first_vertices: Placement  # of the fit to landmarks alone
    vertices: Placement
    refined_vertices: Placement
    head: float  # intersection over union of the head masks
    avatars: dict[str, Figures]

    def gap(self, name: str) -> float:
        """dB that an avatar is below that of the true tracking."""
        return self.avatars[TRUE].psnr - self.avatars[name].psnr


def run(request: Request) -> None:
    scale = QUICK if request.quick else USUAL
    of_demo = (f"data.size={scale.size}", f"trainer.iterations={scale.iterations}")
    config = load_config(
        [
            *(() if request.inputs and not request.quick else of_demo),
            "trainer.checkpoint_every=1000000",
            *(("model.uv_size=24", "model.mlp_width=24") if request.quick else ()),
            *request.overrides,
        ]
    )
    results = []
    for person in request.inputs or (ALL_SEEDS if request.full else SEEDS):
        with tempfile.TemporaryDirectory(dir=request.out) as scratch:
            if isinstance(person, Path):
                filmed = as_filmed(person, request, config)
            else:
                filmed = film(person, scale, config, Path(scratch) / f"demo-{person}")
            results.append(measure(filmed, config, Path(scratch)))
    content = {"config": config.to_dict(), "subjects": [asdict(result) for result in results]}
    name = "_".join(["bench_track", *(folder.resolve().name for folder in request.inputs)])
    write_report(request.out, name, report(results, config), content)


@dataclass(frozen=True)
class Filmed:
    """A subject whose tracking counts as the truth, and what its video shows: a picture for each of its frames."""

    truth: Subject
    assets: HeadAssets
    head: Path
    pictures: Iterable[np.ndarray]  # uint8 [H, W, 3]


def film(seed: int, scale: Scale, config: Config, folder: Path) -> Filmed:
    """A demo person, written to `folder`."""
    make_subject(folder, scale.frames, scale.filmed, seed)
    head = folder / "head_model"
    truth, assets = open_subject(Source(folder, head, frame_offset=1), config.data.test_frames)
    frames = (truth.pixels(index) for index in range(len(truth)))
    shown = in_room(((pixels.image, pixels.alpha) for pixels in frames), scale.filmed, seed)
    return Filmed(truth, assets, head, shown)


def as_filmed(folder: Path, request: Request, config: Config) -> Filmed:
    """A tracked folder. Raises UserError where its frames have an odd size, which a video's cannot be."""
    head = find_head(folder, request.head)
    source = Source(folder, head, request.tracking, request.frame_offset)
    truth, assets = open_subject(source, config.data.test_frames)
    if truth.recording.width % 2 or truth.recording.height % 2:
        raise UserError(
            f"{folder} has frames of {truth.recording.width}x{truth.recording.height} pixels; a video's are even both ways"
        )
    return Filmed(truth, assets, head, (truth.pixels(index).image for index in range(len(truth))))


def measure(filmed: Filmed, config: Config, scratch: Path) -> Result:
    """Everything about one subject; what is written on the way lies in `scratch`."""
    truth, assets = filmed.truth, filmed.assets
    video, tracked = scratch / "video.mp4", scratch / "tracked"
    with video_writer(video, truth.recording.fps) as add:
        for picture in filmed.pictures:
            add(picture)
    # The whole picture: it is then the true one's, pixel for pixel.
    track(video, tracked, filmed.head, assets, Choices(crop="none"), progress=progress_bar)
    own, _ = open_subject(Source(tracked, filmed.head), config.data.test_frames, assets=assets)
    pairs = paired(own.recording, len(truth))
    held_out = set(own.split.test) & {mine for mine, true in pairs if true in truth.split.test}
    shown = [pair for pair in pairs if pair[0] in held_out][::MEASURED_EVERY]
    of_truth, of_own = (Trial(subject, assets, config, scratch) for subject in (truth, own))
    better = of_own.refined(own.recording, "first")
    avatars = {}
    for name, trial, recording in (
        (TRUE, of_truth, truth.recording),
        (PICTURES, of_own, with_true_tracking(own.recording, truth.recording, pairs)),
        (AUTOMATIC, of_own, own.recording),
        (REFINED, of_own, better),
        (AGAIN, of_own, of_own.refined(better, "second")),
    ):
        frames = shown if trial is of_own else [(true, true) for _, true in shown]
        avatars[name] = driven_figures(trial.trained(recording, name), recording, truth, frames, config)
    first = tracked_by_landmarks(tracked, filmed.head, own.recording, assets)
    return Result(
        name=truth.name,
        size=(truth.recording.width, truth.recording.height),
        frames=len(truth),
        first_vertices=placement(assets, first, truth.recording, pairs),
        vertices=placement(assets, own.recording, truth.recording, pairs),
        refined_vertices=placement(assets, better, truth.recording, pairs),
        head=mask_overlap(own, truth, pairs[::COMPARED_EVERY]),
        avatars=avatars,
    )


def tracked_by_landmarks(tracked: Path, head: Path, own: Recording, assets: HeadAssets) -> Recording:
    """The fit to the stored landmarks of a tracked folder alone, without its pictures."""
    seen = load_landmarks(tracked / LANDMARKS_FILE)
    fit = fit_landmarks(assets, find_embedding(head, assets), seen, Pinhole(*own.intrinsics))
    rows = as_tracks(fit, fit.motion, own.intrinsics, seen.size, assets.num_expressions)
    tracks = {
        name: torch.from_numpy(np.stack([getattr(rows[int(number)], name) for number in own.names])).float()
        for name in TRACK_SHAPES
        if name != "shape"
    }
    return replace(own, tracks=tracks | {"shape": torch.from_numpy(next(iter(rows.values())).shape).float()})


def paired(own: Recording, count: int) -> list[tuple[int, int]]:
    """Indices of the same pictures in both: the video's numbers are the places of the true folder's `count` frames."""
    return [(index, int(name)) for index, name in enumerate(own.names) if int(name) < count]


def with_true_tracking(own: Recording, truth: Recording, pairs: Sequence[tuple[int, int]]) -> Recording:
    """The video's frames with the true tracking. Every frame must have a true one."""
    true_rows = torch.tensor([true for _, true in pairs])
    tracks = {name: values if name == "shape" else values[true_rows] for name, values in truth.tracks.items()}
    return replace(own, tracks=tracks, intrinsics=truth.intrinsics)


def mask_overlap(own: Subject, truth: Subject, pairs: Sequence[tuple[int, int]]) -> float:
    """Intersection over union of head masks, mean over frames of the video's size."""
    found = []
    for mine, true in pairs:
        ours, theirs = own.pixels(mine).head_mask > 127, truth.pixels(true).head_mask > 127
        found.append((ours & theirs).sum() / max((ours | theirs).sum(), 1))
    return float(np.mean(found))


def report(results: Sequence[Result], config: Config) -> list[str]:
    size = "the size of the video" if config.data.size is None else f"{config.data.size} px"
    lines = [
        f"Held-out frames at {size}, head alone, {planned_steps(config.trainer)}, against the true pictures; held-out "
        "frames of a refined tracking were fitted to their own pictures",
        "Errors of the face's vertices in % of the distance between the irises: all, and without what is the same in all "
        "frames",
    ]
    for result in results:
        lines += [
            "",
            f"{result.name}: {result.frames} frames of {result.size[0]}x{result.size[1]}; IoU of the head mask "
            f"{result.head:.3f}",
            f"vertices by landmarks {_parts(result.first_vertices)}, tracked {_parts(result.vertices)}, refined "
            f"{_parts(result.refined_vertices)}",
            f"{'avatar of the tracking':>26}{'PSNR':>8}{'gap':>7}{'SSIM':>8}",
        ]
        lines += [
            f"{name:>26}{own.psnr:8.2f}{result.gap(name):7.2f}{own.ssim:8.4f}" for name, own in result.avatars.items()
        ]
    return lines


def _parts(error: Placement) -> str:
    return f"{error.all:.2f} ({error.moving:.2f})"
