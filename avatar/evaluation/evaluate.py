"""Evaluation of a run on frames that it has not seen: figures, the pictures they come from, and a video.

    RUN/eval/results.json                  every choice, what was evaluated, means
    RUN/eval/truth_render_error.mp4        frames and background of the first protocol
    RUN/eval/<protocol>/frames.csv         the figures of each frame
    RUN/eval/<protocol>/{renders,gt,masks,...}/%05d.png    with --frames; numbers are those of frames.csv

Renders and truths are measured as the pictures that the PNG files hold, so that anyone can recompute a figure.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import UInt8
from tqdm import tqdm

from avatar.checkpoint import write_atomically
from avatar.data.loader import FrameLoader
from avatar.evaluation.measure import Figures, FrameMeasurer, Pair, as_seen
from avatar.evaluation.networks import ChosenLpips, find_networks
from avatar.evaluation.pictures import clear_pictures, encode_pictures, write_pictures
from avatar.evaluation.protocol import SHARED_CHOICES, Colour, Look, Protocol, choose_protocols
from avatar.evaluation.regions import OF_EYES, has_eyeballs, region_masks
from avatar.evaluation.report import colour_name, frames_csv, table
from avatar.run import Run, versions
from avatar.splat import splat
from avatar.types import Frame
from avatar.video import error_map, side_by_side, video_writer

RESULTS_FORMAT = 2
ERROR_SCALE = 0.25  # mean absolute error at which the map in the video is brightest


class FrameResult(NamedTuple):
    index: int
    name: str
    figures: Figures


@torch.no_grad()
def evaluate(
    run: Run,
    protocols: Sequence[str] | None = None,
    *,
    write_frames: bool = False,
    say: Callable[[str], None] = print,
) -> Path:
    """Render the held-out frames, measure them by each protocol, write RUN/eval, say the table and where it is.

    protocols  names or paths as `choose_protocols` takes them; None: all that come with the program
    Every frame is rendered once per background, and a figure that protocols share is measured once. Returns the path of
    results.json, which is written last. Raises UserError for an unknown protocol, a frame that cannot be read, damaged
    LPIPS weights, or a disk that refuses.
    """
    chosen = choose_protocols(protocols)
    folder = run.path / "eval"
    subject, data = run.subject, run.config.data
    indices = {protocol.name: protocol.select(len(subject), subject.split) for protocol in chosen}
    results: dict[str, list[FrameResult]] = {protocol.name: [] for protocol in chosen}
    networks = find_networks(protocol.lpips_net for protocol in chosen)
    for protocol in chosen:
        clear_pictures(folder / protocol.name)

    video = folder / "truth_render_error.mp4"
    order = sorted(set().union(*indices.values()))
    with (
        FrameLoader(subject, data.size, data.cache_mb << 20, data.workers) as loader,
        video_writer(video, subject.fps) as add_to_video,
    ):
        for frame in tqdm(loader.frames(order), total=len(order), desc="eval", unit="frame", disable=None):
            wanted = [protocol for protocol in chosen if frame.index in indices[protocol.name]]
            pairs = draw(run, frame, {protocol.look for protocol in wanted})
            masks = region_masks(
                frame, run.avatar.head, {r for protocol in wanted for r in protocol.regions} | {"head"}
            )
            measurer = FrameMeasurer(pairs, masks, {net: found.network for net, found in networks.items()})
            for protocol in wanted:
                results[protocol.name].append(FrameResult(frame.index, frame.name, measurer.measure(protocol)))
                if protocol is chosen[0]:
                    add_to_video(panel(pairs[protocol.look]))
                if write_frames:
                    shown = {region: masks[region] for region in masks if region in ("head", *protocol.regions)}
                    write_pictures(folder / protocol.name, frame.index, encode_pictures(pairs[protocol.look], shown))

    summary = {
        "format": RESULTS_FORMAT,
        "subject": subject.name,
        "data_hash": subject.data_hash,
        "head_fingerprint": run.avatar.head.assets.fingerprint,
        "step": run.step,
        "config": run.config.to_dict(),
        "versions": versions(),
        "shared_choices": SHARED_CHOICES,
        "notes": [*background_notes(chosen, data.background), *region_notes(chosen, run)],
        "protocols": {
            protocol.name: summarise(protocol, results[protocol.name], networks[protocol.lpips_net])
            for protocol in chosen
        },
    }
    for protocol in chosen:
        rows = frames_csv(protocol.columns, results[protocol.name])
        write_atomically(folder / protocol.name / "frames.csv", rows.encode())
    path = folder / "results.json"
    write_atomically(path, json.dumps(summary, indent=2, allow_nan=False).encode())
    say(table(summary))
    say(f"Results  {path}\nVideo    {video}")
    return path


def draw(run: Run, frame: Frame, looks: set[Look]) -> dict[Look, Pair]:
    """Render and truth of a frame for each look; looks of one background share the rendering."""
    gaussians = run.avatar(frame.params)
    images: dict[Colour, Pair] = {}
    for background in {look.background for look in looks}:
        colour = torch.tensor(background)
        images[background] = Pair(splat(gaussians, frame.camera, colour).image, frame.composite(colour))
    return {look: Pair(*(as_seen(image, look) for image in images[look.background])) for look in looks}


def background_notes(protocols: Sequence[Protocol], trained: Sequence[float]) -> list[str]:
    """A warning for each background that the avatar was not trained over."""
    notes = []
    for background in dict.fromkeys(protocol.background for protocol in protocols):
        if tuple(trained) != background:
            names = [protocol.name for protocol in protocols if protocol.background == background]
            notes.append(
                f"{' and '.join(names)}: drawn over {colour_name(background)}, trained over {colour_name(trained)}; where "
                "the avatar has learned to let its background through, the other colour shines through and counts as "
                f"error; train with 'data.background={list(background)}' to compare by this protocol"
            )
    return notes


def region_notes(protocols: Sequence[Protocol], run: Run) -> list[str]:
    names = [protocol.name for protocol in protocols if set(protocol.regions).intersection(OF_EYES)]
    if not names or has_eyeballs(run.avatar.head.assets.regions):
        return []
    return [
        f"{' and '.join(names)}: eyes and rest not measured, because the head model names no left_eyeball and right_eyeball"
    ]


def panel(pair: Pair) -> UInt8[np.ndarray, "H_panel W_panel 3"]:
    """Truth, render and error map under captions, for the video."""
    render, truth = (image / 255.0 if image.dtype == torch.uint8 else image for image in pair)
    images = (truth, render, error_map(render, truth, ERROR_SCALE))
    return side_by_side(images, ("truth", "render", f"error, 0 to {ERROR_SCALE:g}"))


def summarise(protocol: Protocol, results: Sequence[FrameResult], lpips: ChosenLpips) -> dict[str, Any]:
    """One protocol's entry of results.json: its choices, its frames, and means over the frames that have a figure."""
    means: dict[str, float | None] = {}
    counts: dict[str, int] = {}
    for column in protocol.columns:
        values = [result.figures[column] for result in results if math.isfinite(result.figures[column])]
        counts[column] = len(values)
        means[column] = math.fsum(values) / len(values) if values else None
    return {
        "choices": protocol.choices(),
        "lpips": lpips.as_json(),
        "means": means,
        "frames_with_a_figure": counts,
        "frames": [result.name for result in results],
    }
