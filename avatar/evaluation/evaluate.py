"""Evaluation of a run on frames that it has not seen: figures, the pictures they come from, and a video.

    RUN/eval/results.json                  every choice, what was evaluated, means, intervals; by the protocols of earlier
                                           evaluations too, where they are of the same avatar and frames
    RUN/eval/curves.png                    the figures along the video, where matplotlib is installed
    RUN/eval/worst.png                     truth, render and error of the first protocol's worst frames
    RUN/eval/truth_render_error.mp4        frames and background of the first protocol
    RUN/eval/<protocol>/frames.csv         the figures of each frame
    RUN/eval/<protocol>/{renders,gt,masks,...}/%05d.png    with --frames; numbers are those of frames.csv

Renders and truths are measured as the pictures that the PNG files hold, so that anyone can recompute a figure.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from avatar.data.background import colour_name
from avatar.data.loader import FrameLoader
from avatar.errors import MissingPackage, UserError
from avatar.evaluation.conditions import conditions
from avatar.evaluation.curves import curves
from avatar.evaluation.draw import contact_sheet, draw, panel, speed
from avatar.evaluation.earlier import FRAMES_FILE, earlier_results, protocol_of, remove_others
from avatar.evaluation.jitter import JitterMeter
from avatar.evaluation.measure import FrameMeasurer
from avatar.evaluation.networks import find_networks
from avatar.evaluation.pictures import clear_pictures, encode_pictures, write_pictures
from avatar.evaluation.protocol import HELD_OUT, SHARED_CHOICES, Protocol, choose_protocols
from avatar.evaluation.regions import OF_EYES, has_eyeballs, region_masks
from avatar.evaluation.report import frames_csv, table
from avatar.evaluation.results import FrameResult, summarise
from avatar.evaluation.tracked import describe_tracking, measure_tracked, tracking_notes
from avatar.files.atomic import write_atomically
from avatar.files.video import video_writer
from avatar.losses.lpips_network import Lpips, Net
from avatar.render import Renderer
from avatar.runs.run import Run, versions

RESULTS_FORMAT = 2


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
    Every frame is rendered once per background, and a figure that protocols share is measured once. A protocol that has no
    frame of this subject is left out, and that is said first. Returns the path of results.json, which is written last.
    Raises UserError for an unknown protocol, where no protocol has a frame, for a frame that cannot be read, damaged LPIPS
    weights, or a disk that refuses.
    """
    subject, data = run.subject, run.config.data
    asked = choose_protocols(protocols)
    indices = {protocol.name: protocol.select(len(subject), subject.split) for protocol in asked}
    left_out = without_frames(asked, indices, subject.name)
    for sentence in left_out.values():
        say(f"Note: {sentence}")
    chosen = [protocol for protocol in asked if protocol.name not in left_out]
    folder = run.path / "eval"
    renderer = Renderer(run.avatar, torch.tensor(chosen[0].background))
    networks = find_networks((protocol.lpips_net for protocol in chosen), renderer.background.device)
    lpips: dict[Net, Lpips | None] = {net: found.network for net, found in networks.items()}
    order = sorted(set().union(*indices.values()))
    known = conditions(run.avatar.head, subject, order)
    results: dict[str, list[FrameResult]] = {protocol.name: [] for protocol in chosen}
    jitter = {protocol.look: JitterMeter() for protocol in chosen}
    for protocol in chosen:
        clear_pictures(folder / protocol.name)

    video = folder / "truth_render_error.mp4"
    with (
        FrameLoader(subject, data.size, data.cache_mb << 20, data.workers) as loader,
        video_writer(video, subject.fps) as add_to_video,
    ):
        for frame in tqdm(loader.frames(order), total=len(order), desc="eval", unit="frame", disable=None):
            wanted = [protocol for protocol in chosen if frame.index in indices[protocol.name]]
            pairs = draw(renderer, frame, [protocol.look for protocol in wanted])
            masks = region_masks(frame, run.avatar.head, {"head", *(r for p in wanted for r in p.regions)})
            for look, pair in pairs.items():
                jitter[look].add(subject.manifest.frames[frame.index].tracking, pair, masks["head"])
            measurer = FrameMeasurer(pairs, masks, lpips)
            for protocol in wanted:
                figures, pair = measurer.measure(protocol), pairs[protocol.look]
                results[protocol.name].append(FrameResult(frame.index, frame.name, figures, known[frame.index]))
                if protocol is chosen[0]:
                    add_to_video(panel(pair))
                if write_frames:
                    shown = {region: masks[region] for region in masks if region in ("head", *protocol.regions)}
                    write_pictures(folder / protocol.name, frame.index, encode_pictures(pair, shown))

    for protocol in chosen:
        add_jitter(results[protocol.name], jitter[protocol.look], run)
    tracking = describe_tracking(run, order)
    summary: dict[str, Any] = {
        "format": RESULTS_FORMAT,
        "subject": subject.name,
        "data_hash": subject.data_hash,
        "image_size": subject.image_size(data.size),
        "head_fingerprint": run.avatar.head.assets.fingerprint,
        "step": run.step,
        "config": run.config.to_dict(),
        "versions": versions(),
        "shared_choices": SHARED_CHOICES,
        "tracking": tracking,
        "notes": [
            *left_out.values(),
            *background_notes(chosen, data.background),
            *region_notes(chosen, run),
            *tracking_notes(tracking),
        ],
        "left_out": left_out,
        "rendering": speed(renderer, subject, order, data.size),
        "protocols": {
            protocol.name: summarise(protocol, results[protocol.name], networks[protocol.lpips_net], subject.fps)
            for protocol in chosen
        },
    }
    if subject.given is not None:
        for name, entry in measure_tracked(run, subject.given, renderer, indices, chosen, lpips).items():
            summary["protocols"][name]["tracked"] = entry
    for protocol in chosen:
        rows = frames_csv(protocol.columns, results[protocol.name]).encode()
        write_atomically(folder / protocol.name / FRAMES_FILE, rows)
        summary["protocols"][protocol.name]["frames_sha256"] = hashlib.sha256(rows).hexdigest()
    worst = summary["protocols"][chosen[0].name]["worst"]
    for name in ("worst.png", "curves.png"):
        (folder / name).unlink(missing_ok=True)
    if worst:  # none where every frame is drawn without an error
        write_atomically(folder / "worst.png", worst_sheet(run, renderer, chosen[0], worst))
    try:
        write_atomically(folder / "curves.png", curves(chosen, results, [entry["frame"] for entry in worst]))
    except MissingPackage as missing:
        say(f"Note: {missing}")
    others = earlier_results(folder, summary)
    measured = [*chosen, *(protocol_of(name, entry) for name, entry in others.items())]
    whole = {
        **summary,
        "notes": [*left_out.values(), *background_notes(measured, data.background), *region_notes(measured, run)],
        "protocols": {**summary["protocols"], **others},
    }
    path = folder / "results.json"
    write_atomically(path, json.dumps(whole, indent=2, allow_nan=False).encode())
    removed = remove_others(folder, whole["protocols"])
    say(table(summary))
    places = {"Results": path, "Curves": folder / "curves.png", "Worst": folder / "worst.png", "Video": video}
    lines = [f"{name:8} {place}" for name, place in places.items() if place.exists()]
    if others:
        lines.append(f"Kept     {', '.join(others)}: measured before, of the same avatar and frames")
    if removed:
        lines.append(
            f"Removed  {', '.join(removed)}: measured before, of another step, other data or by another program"
        )
    say("\n".join(lines))
    return path


def without_frames(protocols: Sequence[Protocol], indices: Mapping[str, Sequence[int]], subject: str) -> dict[str, str]:
    """Why a protocol cannot be measured on a subject, by its name. Raises UserError when none can."""
    reasons = {
        protocol.name: f"{protocol.name} is not measured: "
        + (
            f"no frame of {subject} is held out"
            if protocol.frames == HELD_OUT
            else f"none of the last {protocol.frames} frames of {subject} is held out"
        )
        for protocol in protocols
        if not indices[protocol.name]
    }
    if len(reasons) == len(protocols):
        raise UserError(
            f"there is nothing to measure: {'; '.join(reasons.values())}; choose a protocol of other frames, or train with "
            "data.test_frames so that the end of the video is held out"
        )
    return reasons


def add_jitter(results: Sequence[FrameResult], meter: JitterMeter, run: Run) -> None:
    """Give each frame whose neighbours belong to the protocol too its jitter, the others NaN."""
    own = {result.index for result in results}
    for result in results:
        found = meter.of.get(run.subject.manifest.frames[result.index].tracking, float("nan"))
        result.figures["jitter"] = found if {result.index - 1, result.index + 1} <= own else float("nan")


def worst_sheet(run: Run, renderer: Renderer, protocol: Protocol, worst: Sequence[Mapping[str, Any]]) -> bytes:
    """The contact sheet of a protocol's worst frames, drawn again."""
    panels = []
    for entry in worst:
        frame = run.subject.frame(entry["frame"], run.config.data.size)
        pair = draw(renderer, frame, [protocol.look])[protocol.look]
        panels.append(panel(pair, (f"truth of {entry['name']}", f"render, {entry['psnr']:.2f} dB")))
    return contact_sheet(panels)


def background_notes(protocols: Sequence[Protocol], trained: Sequence[float]) -> list[str]:
    """A warning for each background that the avatar was not trained over."""
    notes = []
    for background in dict.fromkeys(protocol.background for protocol in protocols):
        if tuple(trained) != background:
            names = [protocol.name for protocol in protocols if protocol.background == background]
            notes.append(
                f"{' and '.join(names)}: drawn over {colour_name(background)}, trained over {colour_name(trained)}; where "
                "the avatar has learned to let its background through, the other colour shines through and counts as "
                f"error; train with 'data.background={colour_name(background)}' to compare by this protocol"
            )
    return notes


def region_notes(protocols: Sequence[Protocol], run: Run) -> list[str]:
    names = [protocol.name for protocol in protocols if set(protocol.regions).intersection(OF_EYES)]
    if not names or has_eyeballs(run.avatar.head.assets.regions):
        return []
    return [
        f"{' and '.join(names)}: eyes and rest not measured, because the head model names no left_eyeball and right_eyeball"
    ]
