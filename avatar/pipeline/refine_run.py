"""Tracking refined through a trained avatar."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import torch

from avatar.data.refinement_history import Refinement, Round
from avatar.files.names import shortened
from avatar.pipeline import INTERRUPTED, OK
from avatar.pipeline.choose_device import choose_device
from avatar.pipeline.refine_plan import FIRST_PASSES, round_steps
from avatar.pose_refinement.refine_subject import fingerprint, refine_subject
from avatar.pose_refinement.write_results import frames_csv, sheet, summary
from avatar.runs.model_registry import refuse_features
from avatar.runs.run import Run
from data_prep.formats.refined_folder import check_target, write_folder

REFINED_FOLDER = "refined"
MANY_PASSES = 2 * FIRST_PASSES


def refine_run(run: Run, target: Path, device: str | None = None) -> int:
    """Write the run's subject with refined tracking to `target`; `device` stands in for the configuration's."""
    check_target(target)
    refuse_features(run.config.model, "the refinement of a tracking")
    run.avatar.to(choose_device(device or run.config.device, print))
    subject, config = run.subject, run.config
    background = torch.tensor(config.data.background)
    recording = subject.recording
    by = "" if recording.rig is None else f", pictures of {len(recording.times(range(len(subject))))} times,"
    print(
        f"Refining {len(subject)} frames{by} of {subject.name} through the avatar of {run.path}, trained on "
        f"{len(subject.split.train)} of them"
    )
    begin = time.monotonic()
    progress = target.with_name(f".{shortened(target.name)}.progress.safetensors")
    refined = refine_subject(run.avatar, subject, config.data.size, background, progress)
    if refined is None:
        print(f"\nInterrupted; what is done is saved in {progress}. The same command goes on from there.")
        return INTERRUPTED
    seconds = time.monotonic() - begin
    centre = run.avatar.head.neutral_vertices().mean(dim=0)
    after = replace(subject.recording, tracks=refined.tracks)
    extras = {
        "refinement.csv": frames_csv(subject, refined, centre).encode(),
        "refinement.png": sheet(run.avatar, subject, refined, after, config.data.size, background),
    }
    write_folder(target, subject, refined.tracks, next_refinement(run), extras)
    with suppress(OSError):
        progress.unlink()
    print(f"Refined in {seconds:.0f} s ({seconds / len(subject):.3f} s per frame).")
    print("\n".join(summary(subject, refined, centre)))
    print(f"Subject      {target}")
    print(f"Frames       {target / 'refinement.csv'}")
    print(f"Pictures     {target / 'refinement.png'}")
    frames = len(subject.split.train)
    passes, usual = run.step / frames, round_steps(run.step, frames) / frames
    if passes > max(MANY_PASSES, usual):
        print(
            f"Note: this avatar was trained for {passes:.0f} passes over the frames and may overfit the tracking's errors; "
            f"avatar train --refine 1 refines through one trained for {usual:.0f} passes, often better"
        )
    return OK


def next_refinement(run: Run) -> Refinement:
    """What the subject's refinement becomes by one more round through the run's avatar."""
    subject = run.subject
    trained_on = tuple(sorted(subject.manifest.number(index) for index in subject.split.train))
    this = Round(str(run.path.resolve()), run.step, fingerprint(run.avatar), trained_on)
    before = subject.manifest.refinement
    if before is None:
        return Refinement(subject.manifest.format, (this,))
    return replace(before, rounds=(*before.rounds, this))
