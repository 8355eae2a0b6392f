"""The paper's cross-reenactment sheet: frames of each driver beside every avatar that they drive, system by system.

    python scripts/paper/cross_reenactment.py FOLDER... --out runs/paper [--drivers FOLDER...] [--head HEAD] [key=value ...]

Avatars of the tracked folders are trained through `avatar sweep` in --out, as the tables do, and share their runs; they are
driven by `avatar reenact`'s default, relative transfer and the driver's camera. Drivers are the same folders where none are
named; a person's own frames stand for self-reenactment.
Leaves cross_reenactment.md, .csv and .png in --out.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from systems import Request, add_arguments, is_measured, request_of, run_of, systems, train
from torch import Tensor
from write_report import run, table, write_report

from avatar.bench.results import new_figure
from avatar.data.source import Source
from avatar.data.subject import Subject
from avatar.head.model import HeadModel
from avatar.motion.drive import choose_cameras, subject_drive
from avatar.motion.transfer import transfer_motion
from avatar.pipeline.reenact import DEFAULT_CHOICES, check_same_head
from avatar.runs.run import open_trained
from avatar.runs.trained_avatar import TrainedAvatar
from data_prep.prepare.open_subject import find_head, open_subject

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SYSTEMS = ("FlashAvatar", "HyperGaussians n=8")


@dataclass(frozen=True)
class Driven:
    """One avatar with one driver's motion."""

    driver: str
    avatar: str  # subject, and the system
    frames: list[str]  # those that are shown
    distances: np.ndarray  # of all frames, from the training expressions: above 1 the avatar guesses
    shown: list[int]
    pictures: list[np.ndarray]


def main(words: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_arguments(parser)
    parser.add_argument("--drivers", type=Path, nargs="+", metavar="FOLDER")
    parser.add_argument("--systems", nargs="+", default=SYSTEMS, metavar="NAME", help="of any of the tables")
    parser.add_argument("--frames", type=int, default=3, help="of each driver")
    given = parser.parse_intermixed_args(words)
    request = request_of(given)
    status, spec = train(request, "cross_reenactment.to_train", systems(given.systems))
    done = [job for job in spec.jobs if is_measured(given.out, job) and job.seed == spec.jobs[0].seed]
    if not done:
        return status or 1
    avatars = {f"{job.subject}, {job.variant}": open_trained(run_of(given.out, job), request.head) for job in done}
    found: list[Driven] = []
    pictures: dict[str, list[np.ndarray]] = {}
    for folder in given.drivers or request.folders:
        driver = open_driver(folder, request, next(iter(avatars.values())))
        chosen = farthest(torch.stack([driver.params(i).expression for i in range(len(driver))]), given.frames)
        own = [driver.frame(i, next(iter(avatars.values())).config.data.size).image for i in chosen]
        label = driver.name if driver.name not in pictures else str(folder)
        pictures[label] = [as_bytes(image) for image in own]
        found += [replace(drive(trained, name, driver, chosen), driver=label) for name, trained in avatars.items()]
    rows = [["driver", "avatar", "frame", "distance"]]
    rows += [
        [f.driver, f.avatar, n, float(f.distances[i])] for f in found for n, i in zip(f.frames, f.shown, strict=True)
    ]
    write_report(given.out, "cross_reenactment", page(found), rows, draw(found, pictures))
    return status


def open_driver(folder: Path, request: Request, trained: TrainedAvatar) -> Subject:
    """Raises UserError for a driver that was tracked with another head model."""
    source = Source(folder, find_head(folder, request.head), frame_offset=request.frame_offset)
    driver, _ = open_subject(source, None)
    check_same_head(driver, trained)
    return driver


def farthest(expressions: Tensor, count: int) -> list[int]:
    """Frames that differ most: the farthest from the mean, then each the farthest from those chosen; in order of time."""
    chosen = [int((expressions - expressions.mean(dim=0)).norm(dim=1).argmax())]
    while len(chosen) < min(count, len(expressions)):
        chosen.append(int(torch.cdist(expressions, expressions[chosen]).amin(dim=1).argmax()))
    return sorted(chosen)


def drive(trained: TrainedAvatar, name: str, driver: Subject, chosen: Sequence[int]) -> Driven:
    motion = subject_drive(driver, trained.config.data.size)
    head = HeadModel(trained.assets, motion.identity)
    moved, _, _ = transfer_motion(motion.params, trained.statistics, DEFAULT_CHOICES.transfer, head)
    cameras = choose_cameras(motion, trained.rest_camera(), DEFAULT_CHOICES.camera, DEFAULT_CHOICES.intrinsics)
    renders = [as_bytes(trained.render(moved[i], cameras[i]).image) for i in chosen]
    distances = trained.statistics.expressions.distances(moved).numpy()
    return Driven(driver.name, name, [motion.names[i] for i in chosen], distances, list(chosen), renders)


def as_bytes(image: Tensor) -> np.ndarray:
    return (image.clamp(0, 1) * 255).round().byte().numpy()


def page(found: Sequence[Driven]) -> list[str]:
    rows = [
        [
            f.driver,
            f.avatar,
            f"{np.mean(f.distances > 1):.0%}",
            f"{np.median(f.distances):.2f}",
            f"{f.distances.max():.2f}",
        ]
        for f in found
    ]
    return [
        "# Cross-reenactment",
        "",
        *table(["driver", "avatar", "frames beyond training", "median distance", "largest"], rows),
        "",
        "Distance of a frame's expression from those of the avatar's training, as `avatar reenact` has it: above 1 it is",
        "farther than 99 % of those, and the avatar guesses.",
    ]


def draw(found: Sequence[Driven], pictures: dict[str, list[np.ndarray]]) -> Figure:
    """A row for each frame of each driver: his picture, then every avatar."""
    avatars = list(dict.fromkeys(f.avatar for f in found))
    rows = [(driver, k) for driver, own in pictures.items() for k in range(len(own))]
    figure = new_figure(2.2 * (1 + len(avatars)), 2.3 * len(rows))
    for axes, (driver, k) in zip(figure.subplots(len(rows), 1 + len(avatars), squeeze=False), rows, strict=True):
        shown = [pictures[driver][k], *(f.pictures[k] for f in found if f.driver == driver)]
        for place, title, image in zip(axes, [f"driver {driver}", *avatars], shown, strict=True):
            place.imshow(image)
            place.set(xticks=[], yticks=[])
            place.set_title(title, fontsize=8)
    return figure


if __name__ == "__main__":
    run(main)
