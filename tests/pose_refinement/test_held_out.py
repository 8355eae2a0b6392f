"""What does not reach the refined tracking: held-out frames that of training frames, on which the next avatar is trained,
and tracking that no picture supports that of its neighbours."""

from __future__ import annotations

from dataclasses import replace
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


def test_the_tracking_of_a_frame_without_a_head_pulls_at_no_neighbour(tmp_path: Path) -> None:
    avatar = patterned_avatar(tmp_path / "head")
    clip = wrongly_tracked(drawn_clip(avatar, frames=10, train=7))
    pictures = list(clip.pictures)
    pictures[8] = replace(pictures[8], head_mask=torch.zeros(SIZE, SIZE))
    places = clip.recording.tracks["t"].clone()
    places[8] += 0.01
    lost = replace(clip.recording, tracks={**clip.recording.tracks, "t": places})

    def neighbours(one: Clip) -> dict[str, torch.Tensor]:
        hidden = cast(Subject, replace(one, pictures=tuple(pictures)))
        found = refine_subject(avatar, hidden, SIZE, BACKGROUND, tmp_path / f"progress{id(one)}", lambda _: None)
        assert found is not None and found.kept[8] and not found.kept[7]
        return {name: found.tracks[name][[7, 9]] for name in ("R", "t", "expression")}

    tracked, other = neighbours(clip), neighbours(replace(clip, recording=lost))
    assert all(torch.equal(values, other[name]) for name, values in tracked.items())
