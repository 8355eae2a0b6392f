from __future__ import annotations

from pathlib import Path

import pytest
import torch
from small_runs import new_avatar, open_small, small_config, train_small

from avatar.data.loader import FrameLoader
from avatar.errors import UserError
from avatar.train import trainer as trainer_module
from avatar.train.prune import HIDDEN, coverage, prune_background_gaussians, prune_step

SIZE = 24


def test_cover_is_the_weight_in_the_pixels(tracked_folder: Path) -> None:
    """All Gaussians together cover what the drawing's alpha says; one of them what it changes when it is white in black."""
    _, subject, assets = open_small(tracked_folder, small_config())
    avatar = new_avatar(assets, subject, small_config())
    frame = subject.frame(0, SIZE)
    head = frame.alpha * frame.head_mask
    found = coverage(avatar, frame, 1)
    with torch.no_grad():
        gaussians = avatar(frame.params, None, frame.camera.R_cam_world)
        alpha = avatar.draw(gaussians, frame.camera, torch.zeros(3)).alpha
    whole = torch.stack(((alpha * head).sum(), (alpha * (1.0 - head)).sum()))
    assert whole.min() > 1.0
    torch.testing.assert_close(found.sum(dim=0), whole, rtol=1e-4, atol=1e-4)

    one = int(found.sum(dim=1).argmax())
    colours = torch.full((len(gaussians.means), 1, 3), -10.0)  # black
    colours[one] = 0.5 / 0.28209479177387814  # white
    image = avatar.draw(gaussians._replace(sh=colours), frame.camera, torch.zeros(3)).image[..., 0]
    expected = torch.stack(((image * head).sum(), (image * (1.0 - head)).sum()))
    torch.testing.assert_close(found[one], expected, rtol=1e-4, atol=1e-4)


def test_only_what_covers_no_head_is_hidden(tracked_folder: Path) -> None:
    _, subject, assets = open_small(tracked_folder, small_config())
    avatar = new_avatar(assets, subject, small_config())
    train = list(subject.split.train)
    before = {name: value.clone() for name, value in avatar.state_dict().items()}
    with FrameLoader(subject, SIZE) as loader:
        covers = torch.stack([coverage(avatar, frame, 1) for frame in loader.frames(train)]).sum(dim=0)
        on_head = covers[:, 0] / covers.sum(dim=1)
        share = float(on_head[covers.sum(dim=1) > 1.0].quantile(0.3))
        expected = (on_head < share) & (covers.sum(dim=1) > 0.01 * len(train))
        assert 0 < expected.sum() < len(avatar) / 2
        assert prune_background_gaussians(avatar, loader, train, share, 1) == int(expected.sum())
        assert prune_background_gaussians(avatar, loader, train, 1e-6, 1) == 0
    assert torch.equal(avatar.opacity_logits == HIDDEN, expected)
    assert torch.equal(avatar.opacity_logits[~expected], before["opacity_logits"][~expected])
    assert all(torch.equal(v, before[name]) for name, v in avatar.state_dict().items() if name != "opacity_logits")
    frame = subject.frame(train[0], SIZE)
    assert not coverage(avatar, frame, 1)[expected].any()  # never drawn


def test_training_frames_judge_strays_once(
    tracked_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []
    monkeypatch.setattr(trainer_module, "prune_background_gaussians", lambda *words: calls.append(words[2:]))
    train_small(tracked_folder, tmp_path / "off", ["trainer.prune_share=0"])
    assert not calls
    trainer = small_config("trainer.prune_share=0.2").trainer
    train_small(tracked_folder, tmp_path / "on", ["trainer.prune_share=0.2"])
    ((frames, share, step),) = calls
    assert tuple(frames) == open_small(tracked_folder, small_config())[1].split.train
    assert (share, step) == (0.2, prune_step(trainer)) and 0 < step < trainer.iterations


def test_a_scene_that_cannot_be_drawn_is_named(tracked_folder: Path) -> None:
    _, subject, assets = open_small(tracked_folder, small_config())
    avatar = new_avatar(assets, subject, small_config())
    with torch.no_grad():
        avatar.log_scales[0] = float("nan")
    with pytest.raises(UserError, match="training stopped at step 7, frame"):
        coverage(avatar, subject.frame(0, SIZE), 7)
