"""Held-out frames do not reach training: noise in their place changes no bit of what is trained or stored."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch
from poison import poisoned
from small_runs import new_avatar, open_small, small_config

from avatar.data.split import Split
from avatar.data.subject import FramePixels, Subject
from avatar.gaussians.head_rotation import learned_turning
from avatar.head.assets import HeadAssets
from avatar.motion.neutral_pose import find_neutral
from avatar.runs.avatar_file import AVATAR_FILE
from avatar.runs.checkpoint import newest_checkpoint
from avatar.runs.trained_avatar import TrainedAvatar, load_avatar
from avatar.train.loss import choose_perceptual
from avatar.train.trainer import train
from avatar.types import IDENTITY_6D

PAPER = ("experiment=paper", "trainer.perceptual=dssim")


def trained(assets: HeadAssets, subject: Subject, run: Path, *overrides: str) -> TrainedAvatar:
    config = small_config("data.size=32", *overrides)
    avatar = new_avatar(assets, subject, config)
    train(avatar, subject, config, run, choose_perceptual(config.trainer, lambda _: None))
    return load_avatar(run / AVATAR_FILE, Path(subject.manifest.head_path))


# The default recipe corrects poses; it starts from the frames' colours and adds noise.
@pytest.mark.parametrize("recipe", [(), PAPER], ids=["default", "paper"])
def test_noise_in_held_out_frames_changes_no_bit_of_a_trained_avatar(
    tracked_folder: Path, tmp_path: Path, recipe: tuple[str, ...]
) -> None:
    _, subject, assets = open_small(tracked_folder, small_config())
    noisy = poisoned(subject)
    train_frames, test_frames = list(subject.split.train), list(subject.split.test)
    assert not torch.equal(noisy.frame(test_frames[0]).image, subject.frame(test_frames[0]).image)
    clean = trained(assets, subject, tmp_path / "clean", *recipe)
    other = trained(assets, noisy, tmp_path / "noise", *recipe)

    checkpoints = [newest_checkpoint(tmp_path / run).tensors for run in ("clean", "noise")]
    assert checkpoints[0].keys() == checkpoints[1].keys()
    if not recipe:
        assert checkpoints[0]["pose_corrections.moves"].any() and checkpoints[0]["model.turning"].any()
    assert not [name for name in checkpoints[0] if not torch.equal(checkpoints[0][name], checkpoints[1][name])]

    for name, values in clean.avatar.state_dict().items():
        assert torch.equal(values, other.avatar.state_dict()[name]), name
    for name, values in clean.recording.tracks.items():
        known = other.recording.tracks[name]
        if name == "shape":
            assert torch.equal(values, known)
            continue
        assert torch.equal(values[train_frames], known[train_frames])
        assert not torch.equal(values[test_frames], known[test_frames]), f"{name} is not poisoned"
    same_rest(clean, other)


def test_training_opens_training_frames_and_one_preview(tracked_folder: Path, tmp_path: Path) -> None:
    """For first colours and steps, which pass over all frames."""
    _, subject, assets = open_small(tracked_folder, small_config())
    opened: list[int] = []

    class Listening(Subject):
        def pixels(self, index: int, size: int | None = None) -> FramePixels:
            opened.append(index)
            return super().pixels(index, size)

    listening = Listening(**{field.name: getattr(subject, field.name) for field in fields(Subject)})
    # Without pose corrections, which have no row for other frames.
    steps = f"trainer.iterations={len(subject)}", "trainer.checkpoint_every=1000", "trainer.pose_rate=0"
    trained(assets, listening, tmp_path / "run", *steps)
    assert {*subject.split.train} <= {*opened}
    assert {*opened} - {*subject.split.train} == {subject.split.test[0]}


def test_the_facing_is_measured_from_the_training_frames_mean(tracked_folder: Path, tmp_path: Path) -> None:
    _, subject, assets = open_small(tracked_folder, small_config())
    turning = trained(assets, subject, tmp_path / "run", "trainer.iterations=1").avatar.turning
    rotations = subject.recording.tracks["R"]
    assert turning is not None and torch.equal(turning, learned_turning(rotations[list(subject.split.train)]))
    assert not torch.equal(turning, learned_turning(rotations))


def test_the_neutral_face_is_a_training_frames(tracked_folder: Path, tmp_path: Path) -> None:
    """Although the held-out ones, here the first, are calmer and all alike."""
    _, subject, assets = open_small(tracked_folder, small_config())
    tracks = {name: values.clone() for name, values in subject.recording.tracks.items()}
    tracks["expression"][:6], tracks["jaw"][:6] = 0.0, torch.tensor(IDENTITY_6D)
    split = Split(tuple(range(6, len(subject))), tuple(range(6)))
    calm = replace(subject, recording=replace(subject.recording, tracks=tracks, split=split))
    found = trained(assets, calm, tmp_path / "run", "trainer.iterations=1")
    training = find_neutral(calm.recording.motion(split.train), found.avatar.head)
    assert found.neutral.frame == training.frame and torch.equal(found.neutral.expression, training.expression)
    assert found.neutral.expression.any()


def same_rest(a: TrainedAvatar, b: TrainedAvatar) -> None:
    """Neutral face, mean and range of the expressions, by which other people's motion is measured."""
    for one, two in ((a.neutral, b.neutral), (a.statistics.mean, b.statistics.mean)):
        assert one.frame == two.frame
        assert torch.equal(one.expression, two.expression) and torch.equal(one.jaw, two.jaw)
    for name in ("mean", "components", "deviations", "lowest", "highest"):
        one, two = (getattr(which.statistics.expressions, name) for which in (a, b))
        assert torch.equal(one, two), name
