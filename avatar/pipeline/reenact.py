"""Driving one person's avatar with another person's motion; docs/reenact.md says what is written."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor
from tqdm import tqdm

from avatar.data.loader import FrameLoader
from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.files.atomic import write_atomically
from avatar.files.names import shortened
from avatar.files.numbered import numbered, remove_longer
from avatar.files.video import Sound, fitted, side_by_side, write_video
from avatar.files.write_image import encode_image
from avatar.head.model import HeadModel
from avatar.motion.drive import Drive, Whose, all_moments, choose_cameras, smoothed, subject_drive
from avatar.motion.neutral_pose import LIPS_OPEN, RestPose, chosen_frame, frame_rest, lips_apart
from avatar.motion.training_distance import DistanceStrip, distances_csv
from avatar.motion.transfer import NEUTRAL_MODES, Transfer, transfer_motion
from avatar.pipeline.backdrop import Backdrop
from avatar.runs.run import versions
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.types import Camera

FOCAL_TOLERANCE = 0.1  # relative difference of the field of view from which a warning is worth its line
SIDECAR_FORMAT = 1
PICTURES = ".png"  # of the name of pictures that are numbered


@dataclass(frozen=True)
class Choices:
    """How a driver's motion becomes the avatar's."""

    transfer: Transfer = "relative"
    strength: float = 1.0  # scales the departure from rest
    smoothing: float = 0.0  # standard deviation in frames; 0 is off
    camera: Whose = "driver"  # whose head pose is shown
    intrinsics: Whose = "driver"  # through whose lens, where the driver's head pose is shown
    neutral: str | None = None  # the training frame that shows the avatar's neutral face; None finds one
    driver_neutral: str | None = None  # the driver's frame that shows his


DEFAULT_CHOICES = Choices()


def reenact(
    trained: TrainedAvatar,
    driver: Subject | Drive,
    out: Path,
    choices: Choices = DEFAULT_CHOICES,
    *,
    backdrop: Backdrop | None = None,
    sound: tuple[Path, float, float] | None = None,
    say: Callable[[str], None] = print,
) -> Path:
    """Render the avatar with the driver's motion, as many frames as the driver has, beside the driver's own picture, or
    alone over a backdrop. `sound` is the driver's video, whose sound goes along, the second of it at which the driver's
    frames begin, and their rate.

    Returns the video's path. Raises UserError for choices out of range and for a driver tracked with another head model.
    """
    check_choices(choices)
    data = trained.config.data
    if isinstance(driver, Subject):
        check_same_head(driver, trained)
    drive = smoothed(subject_drive(driver, data.size) if isinstance(driver, Subject) else driver, choices.smoothing)
    trained, rest = choose_neutrals(trained, drive, choices)
    driver_head = HeadModel(trained.assets, drive.identity)
    moved, source, goal = transfer_motion(
        drive.params, trained.statistics, choices.transfer, driver_head, strength=choices.strength, rest=rest
    )
    neutral = {"driver": frame_name(source, drive.names), "avatar": frame_name(goal, training_names(trained))}
    if all(neutral.values()):
        say(
            f"Neutral expression: frame {neutral['driver']} of {drive.name}, frame {neutral['avatar']} of {trained.name}"
        )
    if choices.driver_neutral is None:
        say_open_lips(source, driver_head, drive.name, "--driver-neutral", say)
    if choices.neutral is None:
        say_open_lips(goal, trained.avatar.head, trained.name, "--neutral", say)

    distances = trained.statistics.expressions.distances(moved)
    say_distances(distances, say)
    own = trained.rest_camera()
    cameras = choose_cameras(drive, own, choices.camera, choices.intrinsics)
    if choices.camera == "target" or drive.cameras is None:  # the torso turns against a head that does not
        if choices.intrinsics == "target":
            say("Note: --intrinsics target changes nothing: the avatar's own camera sees all frames")
        neck = trained.rest_params().neck
        moved = [replace(params, neck=neck) for params in moved]
    if choices.camera == "driver" and choices.intrinsics == "driver":
        warn_of_other_intrinsics(cameras[0], own, say)
    first = first_file(out)
    heard = None if sound is None or first != out else drive_sound(*sound, drive, say)
    renderings = trained.stream(zip(moved, cameras, strict=True))
    loader = FrameLoader(driver) if backdrop is None and isinstance(driver, Subject) else None
    with loader or nullcontext():
        pictures = driver_pictures(loader, data.size) if loader else None
        if backdrop is None:
            frames = panels((each.image for each in renderings), pictures, trained.name, distances.tolist())
        else:
            frames = (backdrop.pixels(each, trained.background) for each in renderings)
        shown = tqdm(frames, total=len(drive), desc="reenact", unit="frame", dynamic_ncols=True)
        if first != out:
            write_pictures(out, shown)
            remove_longer(out, len(drive), say)
        else:
            write_video(out, shown, drive.fps, heard)
    table, record = sidecars(out)
    content = distances_csv(drive.names, distances.tolist())
    write_atomically(table, content.encode(errors="backslashreplace"))
    described = describe(trained, drive, choices, neutral, cameras, own, distances)
    described |= {
        "background": None if backdrop is None else backdrop.name,
        "sound": None if heard is None else str(heard.source),
    }
    write_atomically(record, json.dumps(described, indent=2, allow_nan=False).encode())
    say(f"{len(drive)} frames written to {first}; its choices in {record.name}, each frame's distance in {table.name}")
    return out


def drive_sound(video: Path, begins: float, fps: float, drive: Drive, say: Callable[[str], None]) -> Sound | None:
    """That of the frames of a tracked video, which are numbered in units of 1 / fps from `begins`, seconds, on; None where
    they are shown at another rate or frames are missing between them."""
    if drive.fps != fps:
        say(f"Note: {drive.name} has {fps:g} frames a second and is shown at {drive.fps:g}, so the sound is left out")
        return None
    first, last = int(drive.names[0]), int(drive.names[-1])
    if last - first + 1 != len(drive):
        say(f"Note: {drive.name} lacks {last - first + 1 - len(drive)} frames, so the sound is left out")
        return None
    return Sound(video, begins + first / drive.fps, len(drive) / drive.fps)


def write_pictures(out: Path, frames: Iterable[UInt8[np.ndarray, "H W C"]]) -> None:
    for number, frame in enumerate(frames):
        write_atomically(numbered(out, number), encode_image(frame, PICTURES))


def first_file(out: Path) -> Path:
    """What is written first: `out`, or the first picture for one that ends in .png."""
    return numbered(out, 0) if out.suffix.lower() == PICTURES else out


def sidecars(video: Path) -> tuple[Path, Path]:
    """The table of distances and the record of choices that go with a video."""
    stem = shortened(video.stem)
    return video.with_name(f"{stem}.distances.csv"), video.with_name(f"{stem}.choices.json")


def check_choices(choices: Choices) -> None:
    for name, value, high in (("strength", choices.strength, 10.0), ("smoothing", choices.smoothing, 1000.0)):
        if not 0.0 <= value <= high:  # a NaN is refused too
            raise UserError(f"--{name} must be from 0 to {high:g}, not {value}")
    for option, frame in (("--neutral", choices.neutral), ("--driver-neutral", choices.driver_neutral)):
        if frame is not None and choices.transfer not in NEUTRAL_MODES:
            raise UserError(
                f"{option} chooses what --transfer {' or '.join(NEUTRAL_MODES)} measures from; {choices.transfer} does not "
                "look at it"
            )


def choose_neutrals(trained: TrainedAvatar, drive: Drive, choices: Choices) -> tuple[TrainedAvatar, RestPose | None]:
    """The avatar with the neutral face that was chosen, and the driver's, where one was. Raises UserError for a frame that
    there is not."""
    if choices.neutral is not None:
        recording = trained.recording
        frame = chosen_frame(choices.neutral, training_names(trained), f"the training of {trained.name}")
        trained = replace(trained, neutral=frame_rest(recording.motion(recording.split.train), frame))
    if choices.driver_neutral is None:
        return trained, None
    return trained, frame_rest(drive.params, chosen_frame(choices.driver_neutral, drive.names, drive.name))


def training_names(trained: TrainedAvatar) -> list[str]:
    return [trained.recording.names[i] for i in trained.recording.moments(trained.recording.split.train)]


def say_open_lips(rest: RestPose | None, head: HeadModel, name: str, option: str, say: Callable[[str], None]) -> None:
    """Say when the neutral face that was found has open lips: expressions are measured from it as if they were closed."""
    apart = None if rest is None or rest.frame is None else lips_apart(rest, head)
    if apart is not None and apart > LIPS_OPEN:
        say(
            f"The lips of {name} are {1000 * apart:.1f} mm apart in the neutral face, for want of a frame with closed "
            f"ones, and that passes for a closed mouth; {option} N takes frame N instead"
        )


def check_same_head(driver: Subject, trained: TrainedAvatar) -> None:
    if driver.head_fingerprint != trained.recording.head_fingerprint:
        raise UserError(
            f"the driver {driver.name} was tracked with another head model than the avatar {trained.name} "
            f"({driver.head_fingerprint[:12]} and {trained.recording.head_fingerprint[:12]}): the same coefficients mean "
            "other expressions there; track the driver again with the avatar's head model"
        )


def frame_name(rest: RestPose | None, names: Sequence[str]) -> str | None:
    return names[rest.frame] if rest is not None and rest.frame is not None else None


def say_distances(distances: Float[Tensor, " T"], say: Callable[[str], None]) -> None:
    far = int((distances > 1.0).sum())
    if far:
        say(
            f"{far} of {len(distances)} frames are farther from the training expressions than 99% of those are (at most "
            f"{float(distances.max()):.1f} times as far): the avatar extrapolates there; --transfer pca stays within them"
        )


def panels(
    renders: Iterator[Float[Tensor, "H W 3"]],
    pictures: Iterator[Float[Tensor, "H W 3"]] | None,
    name: str,
    distances: Sequence[float],
) -> Iterator[UInt8[np.ndarray, "H_panel W_panel 3"]]:
    """The driver's picture, if any, beside the render, over the strip of distances."""
    strip: DistanceStrip | None = None
    for index, render in enumerate(renders):
        images, captions = ([render], [name]) if pictures is None else ([next(pictures), render], ["driver", name])
        panel = side_by_side(images, captions)
        strip = strip or DistanceStrip(distances, panel.shape[1], panel.shape[0])
        yield np.concatenate((panel, strip.frame(index)))


def driver_pictures(loader: FrameLoader, size: int | None) -> Iterator[Float[Tensor, "H W 3"]]:
    """As large as the first at a width of `size` pixels; of full frames, for outlines of resized ones lack a background."""
    moments = all_moments(loader.subject)
    width, height = loader.subject.image_size(size, moments[0])
    return (fitted(frame.image, height, width) for frame in loader.frames(moments))


def describe(
    trained: TrainedAvatar,
    drive: Drive,
    choices: Choices,
    neutral: dict[str, str | None],
    cameras: Sequence[Camera],
    own: Camera,
    distances: Float[Tensor, " T"],
) -> dict[str, Any]:
    """What the sidecar holds."""
    return {
        "format": SIDECAR_FORMAT,
        "avatar": {"file": str(trained.source.resolve()), "subject": trained.name, "step": trained.step},
        "driver": {
            "name": drive.name,
            "frames": len(drive),
            "fps": drive.fps,
            "has_cameras": drive.cameras is not None,
        },
        "choices": asdict(choices),
        "neutral_frames": neutral,
        "intrinsics": {"shown": intrinsics(cameras[0]), "avatar": intrinsics(own)},
        "distance": {
            "measured": "Mahalanobis distance of the moved expression and jaw in the principal components of the training "
            "frames, divided by the 99th percentile of their own",
            "frames_above_1": int((distances > 1.0).sum()),
            "median": round(float(distances.median()), 4),
            "largest": round(float(distances.max()), 4),
        },
        "versions": versions(),
    }


def intrinsics(camera: Camera) -> dict[str, float]:
    return {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}


def warn_of_other_intrinsics(driver: Camera, target: Camera, say: Callable[[str], None]) -> None:
    """Say when the two videos were taken through lenses that differ: the perspective of the face is then another."""
    fields = [2 * np.degrees(np.arctan(c.height / (2 * c.fy))) for c in (driver, target)]
    if abs(driver.fy / driver.height - target.fy / target.height) > FOCAL_TOLERANCE * target.fy / target.height:
        say(
            f"Warning: the driver's camera sees {fields[0]:.1f} degrees, the avatar's {fields[1]:.1f}: shown from the "
            "driver's camera the head has another perspective than in training; --intrinsics target keeps its own lens"
        )
