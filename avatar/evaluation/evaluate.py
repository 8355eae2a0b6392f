"""Evaluation of a run on frames that it has not seen: figures, the pictures they come from, and a video.

docs/evaluation.md lists the files. results.json and the curves have the figures by the protocols of earlier evaluations
too, where they are of the same avatar and frames; worst frames and video are by one protocol. Where the subject's tracking
was refined, curves, worst frames and video show the tracker's.

Renders and truths are measured as the pictures that the PNG files hold, so that anyone can recompute a figure.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from avatar.data.colours import colour_name
from avatar.data.loader import FrameLoader
from avatar.data.subject import Subject
from avatar.errors import MissingPackage, UserError
from avatar.evaluation.draw import contact_sheet, draw, panel
from avatar.evaluation.find_lpips import find_networks
from avatar.evaluation.frame_curves import curves
from avatar.evaluation.held_out import views
from avatar.evaluation.jitter import JitterMeter
from avatar.evaluation.measure import FrameMeasurer
from avatar.evaluation.pictures import clear_pictures, write_pictures
from avatar.evaluation.previous_results import in_order, protocol_of, read_earlier, read_frames, remove_others
from avatar.evaluation.protocol import HELD_OUT, SHARED_CHOICES, Protocol, choose_protocols
from avatar.evaluation.regions import OF_EYES, has_eyeballs, region_masks
from avatar.evaluation.report import frames_csv, table
from avatar.evaluation.results import FrameResult, summarise
from avatar.evaluation.tracking_source import Drive, describe_tracking, drives, parts, renders_of, tracking_notes
from avatar.evaluation.training_coverage import conditions
from avatar.files.atomic import write_atomically
from avatar.files.names import typed
from avatar.files.video import SHARP, video_writer
from avatar.losses.lpips_network import Lpips, Net
from avatar.render import Renderer
from avatar.runs.run import Run, versions
from avatar.train.loss import opposite_background

RESULTS_FORMAT = 3
Measured = dict[Drive, dict[str, list[FrameResult]]]  # by protocol, in the order of the video


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
    subject = run.subject
    asked = choose_protocols(protocols)
    times = [subject.recording.time(i) for i in range(len(subject))]
    indices = {protocol.name: protocol.select(times, subject.split) for protocol in asked}
    left_out = without_frames(asked, indices, subject.name)
    for sentence in left_out.values():
        say(f"Note: {sentence}")
    chosen = [protocol for protocol in asked if protocol.name not in left_out]
    folder = run.path / "eval"
    video, sheet = folder / "truth_render_error.mp4", folder / "worst.png"
    facts = facts_of(run)
    before = read_earlier(folder, facts, {protocol.name for protocol in asked})
    shown = chosen[0].name if before.shown is None or not video.exists() else before.shown
    renderer = Renderer(run.avatar, torch.tensor(chosen[0].background))
    networks = find_networks((protocol.lpips_net for protocol in chosen), renderer.background.device)
    lpips: dict[Net, Lpips | None] = {net: found.network for net, found in networks.items()}
    for protocol in chosen:
        clear_pictures(folder / protocol.name)
    is_shown = any(protocol.name == shown for protocol in chosen)
    film = video_writer(video, subject.recording.fps, "veryfast", crf=20) if is_shown else nullcontext()
    with film as add_to_video:
        results = measure(run, renderer, chosen, indices, lpips, write_frames, {shown: add_to_video})

    entries: dict[str, Any] = {}
    seen = views(subject.recording, numbers_of(subject), sorted(set().union(*indices.values())))
    for protocol in chosen:
        by_drive: dict[Drive, list[FrameResult]] = {drive: found[protocol.name] for drive, found in results.items()}
        entry = summarise(protocol, by_drive, networks[protocol.lpips_net], subject.recording.fps, seen)
        for drive, part in parts(entry).items():
            rows = frames_csv(protocol.columns, by_drive[drive], seen).encode(errors="backslashreplace")
            write_atomically(folder / protocol.name / part.table, rows)
            part.figures["frames_sha256"] = hashlib.sha256(rows).hexdigest()
        entries[protocol.name] = entry
    whole = in_order({**before.entries, **entries})
    measured = [protocol_of(name, entry) for name, entry in whole.items()]
    tracking = describe_tracking(run, sorted({i for p in measured for i in p.select(times, subject.split)}))
    notes = [*left_out.values(), *notes_of(measured, run), *tracking_notes(tracking)]
    summary: dict[str, Any] = {
        **facts,
        "tracking": tracking,
        "notes": notes,
        "left_out": left_out,
        "shown": shown,
        "protocols": whole,
    }
    worst = next(iter(parts(whole[shown]).values())).figures["worst"]
    if is_shown:
        sheet.unlink(missing_ok=True)
        if worst:  # none where every frame is drawn without an error
            write_atomically(sheet, worst_sheet(run, renderer, protocol_of(shown, whole[shown]), worst))
    kept = {name: read_frames(folder / name, entry) for name, entry in before.entries.items()}
    plotted: Measured = {
        drive: {**found, **{n: own[drive] for n, own in kept.items()}} for drive, found in results.items()
    }
    (folder / "curves.png").unlink(missing_ok=True)
    try:
        picture = curves(measured, plotted, shown, [entry["frame"] for entry in worst])
        write_atomically(folder / "curves.png", picture)
    except MissingPackage as missing:
        say(f"Note: {missing}")
    path = folder / "results.json"
    write_atomically(path, json.dumps(summary, indent=2, allow_nan=False).encode())
    removed = remove_others(folder, whole)
    own = [*left_out.values(), *notes_of(chosen, run), *tracking_notes(tracking)]
    say(table({**summary, "protocols": entries, "notes": own}))
    of = "" if is_shown else f" ({shown})"
    places = {"Results": path, "Curves": folder / "curves.png", f"Worst{of}": sheet, f"Video{of}": video}
    said = [f"{name:8} {place}" for name, place in places.items() if place.exists()]
    if before.entries:
        said.append(f"Kept     {', '.join(before.entries)}: measured before, of the same avatar and frames")
    if removed:
        said.append(
            f"Removed  {', '.join(removed)}: measured before, of another step, other data or by another program"
        )
    say("\n".join([*said, f"Next     avatar report {typed(run.path)}"]))
    return path


def facts_of(run: Run) -> dict[str, Any]:
    """What is evaluated and how, for results.json: where these agree, figures may stand side by side."""
    return {
        "format": RESULTS_FORMAT,
        "subject": run.subject.name,
        "data_hash": run.subject.data_hash,
        "image_size": run.subject.image_size(run.config.data.size),
        "head_fingerprint": run.avatar.head.assets.fingerprint,
        "step": run.step,
        "perceptual": run.trained.perceptual,
        "config": run.config.to_dict(),
        "versions": versions(),
        "shared_choices": SHARED_CHOICES,
    }


def measure(
    run: Run,
    renderer: Renderer,
    protocols: Sequence[Protocol],
    indices: Mapping[str, Sequence[int]],
    networks: Mapping[Net, Lpips | None],
    write_frames: bool,
    films: Mapping[str, Callable[[np.ndarray], None] | None],
) -> Measured:
    """The figures of every frame by every protocol, driven by each of the subject's trackings.

    Truths, masks and regions are the same for all trackings. `films` takes, by protocol, the panels of the first tracking.
    """
    subject, data = run.subject, run.config.data
    order = sorted(set().union(*indices.values()))
    recordings = drives(subject)
    first = next(iter(recordings))
    known = {drive: conditions(run.avatar.head, recording, order) for drive, recording in recordings.items()}
    results: Measured = {drive: {protocol.name: [] for protocol in protocols} for drive in recordings}
    numbers, own = numbers_of(subject), subject.recording
    jitter = {(drive, protocol.image_format): JitterMeter() for drive in recordings for protocol in protocols}
    filmed = {name: min((own.view(i) for i in found), default=0) for name, found in indices.items()}  # one camera's
    with FrameLoader(subject, data.size) as loader:
        for frame in tqdm(loader.frames(order), total=len(order), desc="eval", unit="frame", disable=None):
            wanted = [protocol for protocol in protocols if frame.index in indices[protocol.name]]
            masks = region_masks(frame, run.avatar.head, {"head", *(r for p in wanted for r in p.regions)})
            for drive, recording in recordings.items():
                camera, params = recording.camera(frame.index, data.size), recording.params(frame.index)
                pairs = draw(renderer, replace(frame, camera=camera, params=params), [p.image_format for p in wanted])
                for image_format, pair in pairs.items():
                    jitter[drive, image_format].add(own.view(frame.index), numbers[frame.index], pair, masks["head"])
                measurer = FrameMeasurer(pairs, masks, networks)
                for protocol in wanted:
                    figures, pair = measurer.measure(protocol), pairs[protocol.image_format]
                    row = FrameResult(frame.index, frame.name, figures, known[drive][frame.index])
                    results[drive][protocol.name].append(row)
                    add_to_film = films.get(protocol.name) if own.view(frame.index) == filmed[protocol.name] else None
                    if drive == first and add_to_film is not None:
                        add_to_film(panel(pair, rows=SHARP))
                    if write_frames:
                        regions = {region: masks[region] for region in masks if region in ("head", *protocol.regions)}
                        folder, renders = run.path / "eval" / protocol.name, renders_of(drive, subject)
                        write_pictures(folder, frame.index, pair, regions, renders)
    for drive, found in results.items():
        for protocol in protocols:
            add_jitter(found[protocol.name], jitter[drive, protocol.image_format], run)
    return results


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


def numbers_of(subject: Subject) -> dict[int, int]:
    """The number of each frame's tracking, in which successive frames follow each other."""
    return {index: record.tracking for index, record in enumerate(subject.manifest.frames)}


def add_jitter(results: Sequence[FrameResult], meter: JitterMeter, run: Run) -> None:
    """Give each frame whose neighbours belong to the protocol too its jitter, the others NaN."""
    numbers, recording = numbers_of(run.subject), run.subject.recording
    own = {(recording.view(result.index), numbers[result.index]) for result in results}
    for result in results:
        camera, number = recording.view(result.index), numbers[result.index]
        is_between = {(camera, number - 1), (camera, number + 1)} <= own
        result.figures["jitter"] = meter.of.get((camera, number), float("nan")) if is_between else float("nan")


def worst_sheet(run: Run, renderer: Renderer, protocol: Protocol, worst: Sequence[Mapping[str, Any]]) -> bytes:
    """The contact sheet of a protocol's worst frames, drawn again by the tracker's tracking."""
    subject, panels = run.subject.as_tracked(), []
    for entry in worst:
        frame = subject.frame(entry["frame"], run.config.data.size)
        pair = draw(renderer, frame, [protocol.image_format])[protocol.image_format]
        panels.append(panel(pair, (f"truth of {entry['name']}", f"render, {entry['psnr']:.2f} dB")))
    return contact_sheet(panels)


def notes_of(protocols: Sequence[Protocol], run: Run) -> list[str]:
    return [*background_notes(protocols, run), *region_notes(protocols, run)]


def background_notes(protocols: Sequence[Protocol], run: Run) -> list[str]:
    """A warning for each background that the avatar was not trained over."""
    trained, notes = run.config.data.background, []
    over = {tuple(trained)}
    if run.config.trainer.opposite_background_every and run.avatar.has_colours:
        over.add(tuple(opposite_background(torch.tensor(trained)).tolist()))
    for background in dict.fromkeys(protocol.background for protocol in protocols):
        if background not in over:
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
