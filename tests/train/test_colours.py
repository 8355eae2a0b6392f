from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from small_runs import new_avatar, open_small, small_config

from avatar.splat.sh import C0
from avatar.train.colours import colour_from_frames, sample, seen_colours


def test_a_head_of_one_colour_gives_that_colour_where_it_is_seen(tracked_folder: Path) -> None:
    config = small_config()
    _, subject, assets = open_small(tracked_folder, config)
    avatar = new_avatar(assets, subject, config)
    frame = subject.frame(0)
    colour = torch.tensor([0.8, 0.4, 0.2])
    whole = torch.ones_like(frame.alpha)
    painted = replace(frame, image=colour.expand_as(frame.image), alpha=whole, head_mask=whole)
    found, seen = seen_colours(avatar, painted)
    shown = seen > 0
    assert 0.2 < float(shown.float().mean()) < 0.9, "a camera sees about half of a head"
    torch.testing.assert_close(found[shown], colour.expand(int(shown.sum()), 3), rtol=0, atol=1e-5)
    # What turns its back has no weight.
    points = avatar.embedding.points(avatar.head.vertices(frame.params))
    depth = frame.camera.project(points)[:, 2]
    assert float(depth[shown].mean()) < float(depth[~shown].mean())


def test_coloured_gaussians_start_closer_to_the_frames(tracked_folder: Path) -> None:
    config = small_config()
    _, subject, assets = open_small(tracked_folder, config)
    avatar = new_avatar(assets, subject, config)
    frame = subject.frame(subject.split.train[0])
    truth, seen = seen_colours(avatar, frame)
    before = float((((avatar.sh_dc[:, 0] * C0 + 0.5) - truth).square().sum(-1) * seen).sum().detach())
    count = colour_from_frames(avatar, subject, None)
    after = float((((avatar.sh_dc[:, 0] * C0 + 0.5) - truth).square().sum(-1) * seen).sum().detach())
    assert 0 < count <= len(avatar)
    assert after < 0.5 * before
    untouched = (avatar.sh_dc[:, 0] == 0).all(dim=-1)
    assert int((~untouched).sum()) <= count


def test_nothing_is_sampled_outside_the_image_or_in_the_cameras_plane() -> None:
    image = torch.arange(12.0).reshape(3, 4, 1) + 1
    points = torch.tensor(
        [[0.5, 0.5, 1], [3.5, 2.5, 1], [2.0, 0.5, 1], [-5, 1, 1], [1, 99, 1], [torch.inf, torch.nan, 0]]
    )
    expected = torch.tensor([1.0, 12.0, 2.5, 0.0, 0.0, 0.0])
    torch.testing.assert_close(sample(image, points, "bilinear")[:, 0], expected, rtol=0, atol=1e-5)
