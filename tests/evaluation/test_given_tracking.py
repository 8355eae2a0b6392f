"""Figures of a refined subject: by the tracker's own tracking beside the refined one, and which frames were trained on."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from disc import TEST, make_run

from avatar.data.refinement_history import Refinement, Round
from avatar.data.subject import Subject
from avatar.evaluation.evaluate import evaluate
from avatar.evaluation.tracking_source import OF_MARK, describe_tracking, tracking_notes


def refined(subject: Subject, trained_on: tuple[int, ...], first: int = 0) -> Subject:
    """The tracker found half of each expression, and another place. Frames are numbered from `first` on."""
    refinement = Refinement("metrical-tracker", (Round("runs/first", 100, "0" * 64, trained_on),))
    frames = tuple(replace(record, tracking=first + record.tracking) for record in subject.manifest.frames)
    manifest = replace(subject.manifest, refinement=refinement, frames=frames, frame_offset=0)
    own = subject.recording.tracks
    tracks = {**own, "expression": 0.5 * own["expression"], "t": own["t"] + torch.tensor([0.05, 0.0, 0.0])}
    return replace(subject, manifest=manifest, given=replace(subject.recording, tracks=tracks))


def test_tracked_figures_are_those_of_the_trackers_expression_and_pose(tmp_path: Path, subject: Subject) -> None:
    """The same as of a subject that was never refined. The avatar's colour follows the expression."""
    one = refined(subject, ())
    assert one.given is not None
    found, given = (
        json.loads(evaluate(make_run(tmp_path / name, which), ["strict"], say=lambda _: None).read_text())
        for name, which in (("refined", one), ("given", replace(subject, recording=one.given)))
    )
    entry, expected = (results["protocols"]["strict"] for results in (found, given))
    for name in (
        "psnr",
        "ssim",
        "psnr_head",
        "ssim_head",
    ):  # the eyes are looked for where the refined tracking has them
        assert entry["tracked"]["means"][name] == pytest.approx(expected["means"][name]), name
        assert entry["means"][name] != pytest.approx(expected["means"][name]), name


def test_frames_that_an_avatar_was_trained_on_are_counted_by_their_numbers(tmp_path: Path, subject: Subject) -> None:
    """Not by their positions: the first frames of this video were left out."""
    one = refined(subject, trained_on=(7, 8, 9, 107, 109), first=100)
    tracking = describe_tracking(make_run(tmp_path / "run", one), TEST)
    (found,) = tracking["rounds"]
    assert (found["frames_trained_on"], found["measured_frames_trained_on"]) == (5, 2)
    note, warning = tracking_notes(tracking)
    assert "2 of them measured" in note and "runs/first" in note and warning == OF_MARK
    clean = describe_tracking(make_run(tmp_path / "clean", refined(subject, (7, 8, 9), first=100)), TEST)
    assert clean["rounds"][0]["measured_frames_trained_on"] == 0 and len(tracking_notes(clean)) == 1
