"""Evaluation of a run on frames that it has not seen: figures, the pictures they come from, and a video.

    RUN/eval/results.json                  every choice, what was evaluated, means
    RUN/eval/truth_render_error.mp4        over the background of the first protocol
    RUN/eval/<protocol>/frames.csv         the figures of each frame
    RUN/eval/<protocol>/{renders,gt,masks,mouth_masks}/%05d.png    with --frames; numbers are those of frames.csv

Renders and truths are measured as the 8-bit pictures that the PNG files hold, so that anyone can recompute a figure.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor
from tqdm import tqdm

from avatar.checkpoint import write_atomically
from avatar.data.loader import FrameLoader
from avatar.errors import UserError
from avatar.lpips import MissingWeights, load_lpips
from avatar.lpips_network import NETS, Lpips, Net
from avatar.protocols import (
    BACKGROUNDS,
    MEASURES,
    REGIONS,
    SHARED_CHOICES,
    Figures,
    Protocol,
    choose_protocols,
    measure,
    to_8_bit,
)
from avatar.report import frames_csv, table
from avatar.run import Run, versions
from avatar.splat import splat
from avatar.types import Frame, Gaussians
from avatar.video import error_map, side_by_side, video_writer

RESULTS_FORMAT = 1
COLUMNS = tuple(measure + region for region in REGIONS for measure in MEASURES)
ERROR_SCALE = 0.25  # mean absolute error at which the map in the video is brightest


class FrameResult(NamedTuple):
    index: int
    name: str
    figures: Figures


class Pictures(NamedTuple):
    """What a protocol measures and the PNG files hold; field names are folder names."""

    renders: UInt8[Tensor, "H W 3"]
    gt: UInt8[Tensor, "H W 3"]
    masks: UInt8[Tensor, "H W"]
    mouth_masks: UInt8[Tensor, "H W"]


class ChosenLpips(NamedTuple):
    network: Lpips | None
    note: str  # for people: which network, or why none


@torch.no_grad()
def evaluate(
    run: Run,
    protocols: Sequence[str] | None = None,
    *,
    write_frames: bool = False,
    say: Callable[[str], None] = print,
) -> Path:
    """Render the held-out frames, measure them by each protocol (None: all), write RUN/eval, say the table and where it is.

    Every frame is rendered once per background. Returns the path of results.json, which is written last. Raises
    UserError for an unknown protocol, a frame that cannot be read, damaged LPIPS weights, or a disk that refuses.
    """
    chosen = choose_protocols(protocols)
    folder = run.path / "eval"
    subject, data = run.subject, run.config.data
    indices = {protocol.name: protocol.frames(len(subject), subject.split) for protocol in chosen}
    results: dict[str, list[FrameResult]] = {protocol.name: [] for protocol in chosen}
    networks = find_networks(chosen)
    for protocol in chosen:
        clear_pictures(folder / protocol.name)

    video = folder / "truth_render_error.mp4"
    order = sorted(set().union(*indices.values()))
    with (
        FrameLoader(subject, data.size, data.cache_mb << 20, data.workers) as loader,
        video_writer(video, subject.fps) as add_to_video,
    ):
        for frame in tqdm(loader.frames(order), total=len(order), desc="eval", unit="frame", disable=None):
            gaussians = run.avatar(frame.params)
            drawn = {name: draw(gaussians, frame, name) for name in {protocol.background for protocol in chosen}}
            for protocol in chosen:
                if frame.index not in indices[protocol.name]:
                    continue
                pictures = drawn[protocol.background]
                figures = measure(protocol, *pictures, networks[protocol.lpips_net].network)
                results[protocol.name].append(FrameResult(frame.index, frame.name, figures))
                if write_frames:
                    write_pictures(folder / protocol.name, frame.index, pictures)
            add_to_video(panel(drawn[chosen[0].background]))

    summary = {
        "format": RESULTS_FORMAT,
        "subject": subject.name,
        "data_hash": subject.data_hash,
        "head_fingerprint": run.avatar.head.assets.fingerprint,
        "step": run.step,
        "config": run.config.to_dict(),
        "versions": versions(),
        "shared_choices": SHARED_CHOICES,
        "notes": background_notes(chosen, data.background),
        "protocols": {
            protocol.name: summarise(protocol, results[protocol.name], networks[protocol.lpips_net])
            for protocol in chosen
        },
    }
    for protocol in chosen:
        write_atomically(folder / protocol.name / "frames.csv", frames_csv(COLUMNS, results[protocol.name]).encode())
    path = folder / "results.json"
    write_atomically(path, json.dumps(summary, indent=2, allow_nan=False).encode())
    say(table(summary))
    say(f"Results  {path}\nVideo    {video}")
    return path


def background_notes(protocols: Sequence[Protocol], trained: Sequence[float]) -> list[str]:
    """A warning for each protocol that shows the avatar over another background than its training did."""
    return [
        f"{protocol.name} draws over {protocol.background}, the avatar was trained over {tuple(trained)}: where it has "
        "learned to let its background through, the other colour shines through and counts as error; train with "
        f"'data.background={list(BACKGROUNDS[protocol.background])}' to compare by this protocol"
        for protocol in protocols
        if tuple(trained) != BACKGROUNDS[protocol.background]
    ]


def find_networks(protocols: Sequence[Protocol]) -> dict[Net, ChosenLpips]:
    """The LPIPS network of each backbone that a protocol asks for, loaded once."""
    networks: dict[Net, ChosenLpips] = {}
    for protocol in protocols:
        if protocol.lpips_net not in networks:
            networks[protocol.lpips_net] = find_lpips(protocol.lpips_net)
    return networks


def find_lpips(net: Net) -> ChosenLpips:
    """The protocol's network if its weights are on this machine, else another one, else none, and a note that says so."""
    try:
        return ChosenLpips(load_lpips(net), net)
    except MissingWeights as error:
        missing = error
    for other in NETS:
        try:
            lpips = load_lpips(other)
        except MissingWeights:
            continue
        return ChosenLpips(lpips, f"{other}, not to be compared with figures of {net}: {missing}")
    return ChosenLpips(None, f"not measured ({missing})")


def draw(gaussians: Gaussians, frame: Frame, background: str) -> Pictures:
    """Render and truth of a frame over a background of `BACKGROUNDS`, with the masks."""
    colour = torch.tensor(BACKGROUNDS[background])
    render = splat(gaussians, frame.camera, colour).image
    images = (render, frame.composite(colour), frame.head_mask, frame.mouth_mask)
    return Pictures(*(to_8_bit(image) for image in images))


def panel(pictures: Pictures) -> UInt8[np.ndarray, "H_panel W_panel 3"]:
    """Truth, render and error map under captions, for the video."""
    render, truth = pictures.renders / 255.0, pictures.gt / 255.0
    images = (truth, render, error_map(render, truth, ERROR_SCALE))
    return side_by_side(images, ("truth", "render", f"error, 0 to {ERROR_SCALE:g}"))


def summarise(protocol: Protocol, results: Sequence[FrameResult], lpips: ChosenLpips) -> dict[str, Any]:
    """One protocol's entry of results.json: its choices, its frames, and means over the frames that have a figure."""
    means: dict[str, float | None] = {}
    counts: dict[str, int] = {}
    for column in COLUMNS:
        values = [result.figures[column] for result in results if math.isfinite(result.figures[column])]
        counts[column] = len(values)
        means[column] = math.fsum(values) / len(values) if values else None
    return {
        "choices": protocol.choices(),
        "lpips": {
            "network": lpips.network.net if lpips.network else None,
            "weights_sha256": lpips.network.fingerprint() if lpips.network else None,
            "note": lpips.note,
        },
        "means": means,
        "frames_with_a_figure": counts,
        "frames": [result.name for result in results],
    }


def write_pictures(folder: Path, index: int, pictures: Pictures) -> None:
    """folder/{renders,gt,masks,mouth_masks}/<index>.png; UserError when the disk refuses."""
    for name, picture in pictures._asdict().items():
        path = folder / name / f"{index:05d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        pixels = picture.numpy()
        encoded = cv2.imencode(".png", pixels[..., ::-1] if pixels.ndim == 3 else pixels)[1]
        try:
            path.write_bytes(encoded.tobytes())
        except OSError as error:
            raise UserError(f"{path} cannot be written ({error.strerror})") from error


def clear_pictures(folder: Path) -> None:
    """Remove the pictures of an earlier evaluation, so that the folders hold one evaluation's frames."""
    for name in Pictures._fields:
        shutil.rmtree(folder / name, ignore_errors=True)
