"""What a plain video costs against the true tracking: a subject's pictures as a video, tracked, and made into avatars.

A subject's own folder is the truth. Of demo subjects the pictures in a room, with noise and compression, are the video
that `avatar track` gets, with no choice made; of a FOLDER the pictures as they are.

Avatars of one recipe: trained on the true folder, on the video's frames and masks with the true tracking, on what `avatar
track` made, and on that as `avatar train --refine 1` and `--refine 2` refine it. All are measured on held-out frames
against the true pictures in the true head masks.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch

from avatar.bench import Request
from avatar.bench.placement import Placement, corners_distance, placement
from avatar.bench.refine import MEASURED_EVERY, Figures, Trial, figures
from avatar.bench.results import write_report
from avatar.config import Config, load_config
from avatar.data.recording import TRACK_SHAPES, Recording
from avatar.data.source import Source
from avatar.data.subject import Subject
from avatar.demo.raw_video import in_room
from avatar.demo.subject import make_subject
from avatar.errors import UserError
from avatar.evaluation.lpips_networks import find_lpips
from avatar.files.video import video_writer
from avatar.head.assets import HeadAssets
from avatar.pipeline.open import split_sizes
from avatar.pipeline.refine_plan import WITH_REFINEMENT
from avatar.pipeline.track import bar
from avatar.train.order import planned_steps
from data_prep.formats.avatar_track import LANDMARKS_FILE, TrackingInfo
from data_prep.prepare.open import find_head, open_subject
from data_prep.track.faces.landmarks import load_landmarks
from data_prep.track.fit.camera import Pinhole
from data_prep.track.fit.fitting import as_tracks, find_embedding
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


USUAL, QUICK = Scale(120, 512, 160, 1000), Scale(20, 192, 48, 20)


@dataclass(frozen=True)
class Result:
    """Of one subject."""

    name: str
    size: tuple[int, int]  # of the video, pixels
    frames: int  # of the video
    detected: float  # share of the frames
    landmarks: float  # error of the quality report, per cent of the distance between the irises
    corners: float  # distance between the outer corners of the eyes, as a multiple of that between the irises
    first_vertices: Placement  # of the fit to landmarks alone
    vertices: Placement
    refined_vertices: Placement
    matte: float  # intersection over union with the true one
    head: float
    track_seconds: float
    refine_seconds: float
    avatars: dict[str, Figures]

    def gap(self, name: str) -> float:
        """dB that an avatar is below that of the true tracking."""
        return self.avatars[TRUE].psnr - self.avatars[name].psnr


def run(request: Request) -> None:
    scale = QUICK if request.quick else USUAL
    of_demo = (f"data.size={scale.size}", f"trainer.iterations={scale.iterations}")
    config = load_config(
        [
            *WITH_REFINEMENT,
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
    truth, assets = open_subject(Source(folder, head, frame_offset=1), split_sizes(config))
    frames = (truth.pixels(index) for index in range(len(truth)))
    shown = in_room(((pixels.image, pixels.alpha) for pixels in frames), scale.filmed, seed)
    return Filmed(truth, assets, head, shown)


def as_filmed(folder: Path, request: Request, config: Config) -> Filmed:
    """A tracked folder. Raises UserError where its frames have an odd size, which a video's cannot be."""
    head = find_head(folder, request.head)
    source = Source(folder, head, request.tracking, request.frame_offset)
    truth, assets = open_subject(source, split_sizes(config))
    if truth.width % 2 or truth.height % 2:
        raise UserError(f"{folder} has frames of {truth.width}x{truth.height} pixels; a video's are even both ways")
    return Filmed(truth, assets, head, (truth.pixels(index).image for index in range(len(truth))))


def measure(filmed: Filmed, config: Config, scratch: Path) -> Result:
    """Everything about one subject; what is written on the way lies in `scratch`."""
    video, tracked = scratch / "video.mp4", scratch / "tracked"
    with video_writer(video, filmed.truth.recording.fps) as add:
        for picture in filmed.pictures:
            add(picture)
    begin = time.perf_counter()
    # The whole picture: it is then the true one's, pixel for pixel.
    info = track(video, tracked, filmed.head, filmed.assets, Choices(crop="none"), progress=bar)
    seconds = time.perf_counter() - begin
    own, _ = open_subject(Source(tracked, filmed.head), split_sizes(config), assets=filmed.assets)
    return compare(filmed, info, seconds, own, config, tracked, scratch)


def compare(
    filmed: Filmed,
    info: TrackingInfo,
    track_seconds: float,
    own: Subject,
    config: Config,
    tracked: Path,
    scratch: Path,
) -> Result:
    truth, assets = filmed.truth, filmed.assets
    network, note = find_lpips("squeeze")
    print(f"LPIPS: {note}")
    pairs = paired(own.recording, len(truth))
    held_out = set(own.split.test) & {mine for mine, true in pairs if true in truth.split.test}
    shown = [pair for pair in pairs if pair[0] in held_out][::MEASURED_EVERY]
    of_truth, of_own = (Trial(subject, assets, config, network, scratch) for subject in (truth, own))

    def measured(avatar, recording: Recording, pairs: Sequence[tuple[int, int]]) -> Figures:
        return figures(avatar, recording, truth, pairs, config, network)

    avatars = {}
    same = [(true, true) for _, true in shown]
    avatars[TRUE] = measured(of_truth.trained(truth.recording, "true"), truth.recording, same)
    given = truly_tracked(own.recording, truth.recording, pairs)
    avatars[PICTURES] = measured(of_own.trained(given, "pictures"), given, shown)
    avatar = of_own.trained(own.recording, "automatic")
    avatars[AUTOMATIC] = measured(avatar, own.recording, shown)
    better, refine_seconds = of_own.refined(own.recording, "first")
    best, _ = of_own.refined(better, "second")
    for name, recording in ((REFINED, better), (AGAIN, best)):
        avatar = of_own.trained(recording, name)
        avatars[f"{name}, as tracked"] = measured(avatar, own.recording, shown)
        avatars[f"{name}, fitted"] = measured(avatar, recording, shown)
    first = tracked_by_landmarks(tracked, filmed.head, own.recording, assets)
    landmark_error = next(f["value"] for f in info.quality["figures"] if f["name"] == "landmark error")
    matte_overlap, head_overlap = mask_overlaps(own, truth, pairs[::COMPARED_EVERY])
    return Result(
        name=truth.name,
        size=(truth.width, truth.height),
        frames=len(truth),
        detected=len(own) / len(truth),
        landmarks=landmark_error,
        corners=corners_distance(load_landmarks(tracked / LANDMARKS_FILE)),
        first_vertices=placement(assets, first, truth.recording, pairs),
        vertices=placement(assets, own.recording, truth.recording, pairs),
        refined_vertices=placement(assets, better, truth.recording, pairs),
        matte=matte_overlap,
        head=head_overlap,
        track_seconds=track_seconds,
        refine_seconds=refine_seconds,
        avatars=avatars,
    )


def tracked_by_landmarks(tracked: Path, head: Path, own: Recording, assets: HeadAssets) -> Recording:
    """The fit to the stored landmarks of a tracked folder alone, without its pictures."""
    seen = load_landmarks(tracked / LANDMARKS_FILE)
    fit = fit_landmarks(assets, assets.names, find_embedding(head, assets), seen, Pinhole(*own.intrinsics))
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


def truly_tracked(own: Recording, truth: Recording, pairs: Sequence[tuple[int, int]]) -> Recording:
    """The video's frames with the true tracking. Every frame must have a true one."""
    true_rows = torch.tensor([true for _, true in pairs])
    tracks = {name: values if name == "shape" else values[true_rows] for name, values in truth.tracks.items()}
    return replace(own, tracks=tracks, intrinsics=truth.intrinsics)


def mask_overlaps(own: Subject, truth: Subject, pairs: Sequence[tuple[int, int]]) -> tuple[float, float]:
    """Intersection over union of mattes and of head masks, means over frames of the video's size."""
    found = []
    for mine, true in pairs:
        ours, theirs = own.pixels(mine), truth.pixels(true)
        masks = [(pixels.alpha > 127, pixels.head_mask > 127) for pixels in (ours, theirs)]
        found.append([(a & b).sum() / max((a | b).sum(), 1) for a, b in zip(*masks, strict=True)])
    matte, head = np.mean(found, axis=0).tolist()
    return matte, head


def report(results: Sequence[Result], config: Config) -> list[str]:
    size = "the size of the video" if config.data.size is None else f"{config.data.size} px"
    lines = [
        f"Held-out frames at {size}, head alone, {planned_steps(config.trainer)}, against the true pictures",
        "Errors of the face's vertices in % of the distance between the irises: all, the same in all frames, without "
        "that; and all in % of that between the outer corners of the eyes, as in 300-W",
    ]
    for result in results:
        lines += [
            "",
            f"{result.name}: {result.frames} frames of {result.size[0]}x{result.size[1]}, {100 * result.detected:.1f} % "
            f"detected, landmark error {result.landmarks:.2f} %; IoU: matte {result.matte:.3f}, head {result.head:.3f}; "
            f"tracking {result.track_seconds:.0f} s, refining {result.refine_seconds:.0f} s",
            f"vertices by landmarks {_parts(result.first_vertices)}, tracked {_parts(result.vertices)}, refined "
            f"{_parts(result.refined_vertices)}",
            f"of the outer corners' distance: by landmarks {result.first_vertices.all / result.corners:.2f}, tracked "
            f"{result.vertices.all / result.corners:.2f}, refined {result.refined_vertices.all / result.corners:.2f}",
            f"{'avatar of the tracking':>26}{'PSNR':>8}{'gap':>7}{'SSIM':>8}{'LPIPS':>8}{'mouth':>8}",
        ]
        lines += [
            f"{name:>26}{own.psnr:8.2f}{result.gap(name):7.2f}{own.ssim:8.4f}{own.lpips:8.4f}{own.mouth:8.2f}"
            for name, own in result.avatars.items()
        ]
    return lines


def _parts(error: Placement) -> str:
    return f"{error.all:.2f} ({error.constant:.2f}, {error.moving:.2f})"
