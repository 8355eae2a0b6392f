"""avatar create: one command from a video to the avatar's page; docs/track.md says where.

What an interrupted command has done is not done again, and the page is the one that it would have made.
"""

from __future__ import annotations

import os
import sys
import time
import webbrowser
from argparse import Namespace
from pathlib import Path

from avatar.commands.arguments import parse
from avatar.commands.held_out_figures import discard, evaluate_or_read, figures_line
from avatar.commands.outputs import check_folder_output
from avatar.commands.train import MAX_ROUNDS, check_rounds, config_overrides, train_as_asked
from avatar.compute.device import free_bytes
from avatar.compute.memory import available_bytes, check_memory, in_words
from avatar.compute.native import thread_count
from avatar.config import Config, load_config
from avatar.data.split import split_frames
from avatar.errors import UserError
from avatar.export.web_page import write_page
from avatar.files.names import RUN_FOLDER, SUBJECT_FOLDER, typed
from avatar.head.assets import HeadAssets, load_head_assets
from avatar.pipeline import OK
from avatar.pipeline.cached_tracking import head_for_video, progress_bar, tracking_lacks
from avatar.pipeline.choose_device import choose_device
from avatar.pipeline.refine_plan import Plan, plan_file, round_steps
from avatar.pipeline.train_refined import is_begun
from avatar.runs.memory_estimate import training_needs
from avatar.runs.run import open_trained
from avatar.train.frame_order import within_epochs
from avatar.train.loss import choose_perceptual
from data_prep.formats.avatar_track import TrackingInfo
from data_prep.track.first_pass import MAX_PICTURES
from data_prep.track.footage.picture_folder import open_footage
from data_prep.track.footage.source import Footage, stride
from data_prep.track.track import track

ROUNDS = 1  # of refinement, by default
STAGES = 4
# Seconds on two cores, and bytes: docs/track.md, docs/train.md and docs/refine.md (158 s of one thread for 1,000 frames).
TRACKING_FRAME, REFINED_FRAME, TRACKING_BYTES = 119 / 600, 0.158 / 2, 1.19e9
STEP = {"cpu": 99 / 4000, "cuda": 16 / 4000}  # docs/gpu.md
FRAME_SIDE = 512  # pixels, at most, of what is tracked


def default_folder(video: Path) -> Path:
    """The video's name; of a folder of pictures, which has that name already, with `-avatar`."""
    return Path(f"{video.resolve().name}-avatar" if video.is_dir() else video.stem)


def run_create(arguments: Namespace) -> int:
    begin, video = time.monotonic(), arguments.video
    out: Path = arguments.out or default_folder(video)
    check_folder_output(out, [video, arguments.head])
    refuse_what_is_missing(arguments)
    subject, run, page = out / SUBJECT_FOLDER, out / RUN_FOLDER, out / "avatar.html"
    if run.exists() and not subject.exists():
        raise UserError(f"{subject}, on which {run} began, is gone: choose another --out, or remove {out}")
    training, head = training_arguments(arguments, subject, run), head_for_video(video, arguments.head)
    training.head, assets = head, load_head_assets(head)
    say_plan(open_footage(video), assets, training)
    print(f"Folder       {out}")
    say_stage(1, "the face is tracked")
    info = track(video, subject, head, assets, progress=progress_bar)
    say_stage(2, "is the tracking good enough?")
    judge_tracking(info, subject, arguments.anyway)
    say_stage(3, "the avatar is trained")
    if (status := train_as_asked(run, training)) != OK:
        print("Start the same command again to go on.")
        return status
    say_stage(4, "the avatar is measured, and its page written")
    results = evaluate_or_read(run, None if plan_file(run).exists() else subject)
    write_page(open_trained(run), page)
    print(f"Held-out frames: {figures_line(results)}")
    print(f"\nDone in {(time.monotonic() - begin) / 60:.1f} minutes. Open {page}, the avatar in a browser.")
    print(f"  {subject / 'overlay'}   the tracked mesh on the video")
    print(f"  {results.parent / 'truth_render_error.mp4'}   held-out frames: truth, render, error")
    print(f"Next         avatar view {typed(run)}")
    print(f"             avatar reenact {typed(run)} ANOTHER.mp4")
    if arguments.open:
        show(page)
    return OK


def say_stage(number: int, what: str) -> None:
    print(f"\nStage {number} of {STAGES}: {what}", flush=True)


def refuse_what_is_missing(arguments: Namespace) -> None:
    """Raise UserError with everything that is missing, so that a person gets it all at once."""
    missing = tracking_lacks(
        lambda: open_footage(arguments.video),
        lambda: load_head_assets(head_for_video(arguments.video, arguments.head)),
    )
    if missing:
        raise UserError("\n  ".join(["this is missing, or of no use, and nothing was begun:", *missing]))


def training_arguments(arguments: Namespace, subject: Path, run: Path) -> Namespace:
    """Those of `avatar train` with the same choices; a run that has begun is resumed.

    Raises UserError for choices that no training takes.
    """
    given = {name: getattr(arguments, name) for name in ("size", "iterations", "device", "refine")}
    begun, has_rounds = is_begun(run), plan_file(run).exists()
    if given["refine"] is not None and not 0 <= given["refine"] <= MAX_ROUNDS:
        raise UserError(f"--refine must be from 0 to {MAX_ROUNDS}, not {given['refine']}")
    if given["refine"] is None:
        given["refine"] = Plan.load(run).rounds if has_rounds else None if begun else ROUNDS
    if given["refine"] == 0 and not has_rounds:
        given["refine"] = None
    words = [f"--{name}={value}" for name, value in given.items() if value is not None]
    training = parse(["train", str(subject.resolve()), *words])
    training.folder, training.out, training.resume = subject, run, begun or has_rounds
    load_config(config_overrides(training))
    if training.refine is not None and not training.resume:
        check_rounds(run, training.refine, None)
    return training


def say_plan(footage: Footage, assets: HeadAssets, training: Namespace) -> None:
    """Print frames, minutes and memory. The minutes are the documentation's, of two free cores and without LPIPS; with one
    thread twice those. Raises UserError where the memory does not suffice or the device is not there."""
    config = load_config(config_overrides(training))
    device = choose_device(training.device or config.device, print)
    frames = count_frames(footage)
    train = len(split_frames(max(frames, 2), config.data.test_frames).train)
    side = config.data.size or min(FRAME_SIDE, footage.width, footage.height)
    term = choose_perceptual(config.trainer, discard, size=(side, side), device=device)
    needs = training_needs(config, assets, frames=train, size=(side, side), perceptual=term.name)
    check_memory("training", needs, free_bytes(device))
    tracking, rest = frames * TRACKING_FRAME, training_seconds(config, training.refine or 0, frames, train, device.type)
    slower = 2 / min(2, thread_count())
    minutes = [f"{seconds * slower / 60:.1f}" for seconds in (tracking + rest, tracking, rest)]
    counted = "about" if footage.duration and footage.rate else "at most"
    print(
        f"Plan         {counted} {frames:,} frames; about {minutes[0]} minutes on this machine, tracking {minutes[1]} and "
        f"training {minutes[2]}; what is done already takes none"
    )
    memory = max(TRACKING_BYTES, sum(need.size for need in needs))
    print(f"Memory       about {in_words(memory)} of {in_words(available_bytes())} that are free")


def count_frames(footage: Footage) -> int:
    """About how many are tracked; as many as there can be where the file says neither rate nor length."""
    if footage.rate is None or footage.duration is None:
        return MAX_PICTURES
    return min(MAX_PICTURES, round(footage.duration * footage.rate / stride(footage.rate)))


def training_seconds(config: Config, rounds: int, frames: int, train: int, device: str) -> float:
    """On two cores, or a GPU; with the rounds of refinement, `train` of the frames being trained on."""
    steps = within_epochs(config.trainer, train).iterations
    return STEP[device] * (steps + rounds * round_steps(steps, train)) + rounds * frames * REFINED_FRAME


def judge_tracking(info: TrackingInfo, subject: Path, anyway: bool) -> None:
    """Say how many figures are good. Raises UserError, with advice, where one is poor and not to be let pass."""
    judged = [figure for figure in info.quality.get("figures", ()) if "grade" in figure]
    counts = [f"{sum(f['grade'] == grade for f in judged)} {grade}" for grade in ("good", "fair", "poor")]
    print(
        f"{', '.join(counts)} of {len(judged)} figures; look at {subject / 'overlay'}: does the mesh lie on the face?"
    )
    print(f"Frames, masks and light: avatar check {typed(subject)} shows warnings, which do not stop the training")
    figures = [
        f"{figure['name'].replace('  of', 'landmark error of')}: {figure['value']:.4g} {figure['unit']}".rstrip()
        + (f" -> {figure['advice']}" if figure["advice"] else "")
        for figure in judged
        if figure["grade"] == "poor"
    ]
    if figures and not anyway:
        advice = "film again by this advice (its options: avatar track), or add --anyway to go on with this video"
        raise UserError("\n  ".join(["the tracking is poor:", *figures]) + f"\n{advice}")
    for line in figures:
        print(f"  poor: {line}")


def show(page: Path) -> None:
    """In the browser, where there is a desktop."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        print(f"There is no desktop here: open {page} where there is one")
    else:
        webbrowser.open(page.resolve().as_uri())
