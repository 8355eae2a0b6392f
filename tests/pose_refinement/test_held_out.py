"""Held-out frames do not reach the refined tracking of training frames, on which the next avatar is trained."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np
import torch
from drawn_clip import BACKGROUND, SIZE, Clip, drawn_clip, patterned_avatar, wrongly_tracked
from poison import poisoned_clip

from avatar.data.subject import Subject
from avatar.pose_refinement.refine_subject import Refined, refine_subject


def test_noise_in_held_out_frames_changes_no_bit_of_refined_training_frames(tmp_path: Path) -> None:
    avatar = patterned_avatar(tmp_path / "head")
    clip = wrongly_tracked(drawn_clip(avatar, frames=10, train=7))

    def refined(one: Clip) -> Refined:
        found = refine_subject(
            avatar, cast(Subject, one), SIZE, BACKGROUND, tmp_path / f"progress{id(one)}", lambda _: None
        )
        assert found is not None
        return found

    clean, other = refined(clip), refined(poisoned_clip(clip))
    train, test = list(clip.split.train), list(clip.split.test)
    for name, values in clean.tracks.items():
        if name == "shape":
            assert torch.equal(values, other.tracks[name])
            continue
        assert torch.equal(values[train], other.tracks[name][train]), name
        assert not torch.equal(values[test], other.tracks[name][test]), f"{name} is not poisoned"
    assert np.array_equal(clean.before[train], other.before[train])
    assert np.array_equal(clean.after[train], other.after[train])
    assert np.array_equal(clean.kept[train], other.kept[train])
