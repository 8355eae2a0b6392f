from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from heads import grid_head, rest_params
from poison import poisoned
from small_runs import new_avatar, open_small, small_config

from avatar.data.frame import Frame
from avatar.data.split import Split
from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.gaussians import initial_colours
from avatar.gaussians.uv_base_model import UVAvatar
from avatar.runs.model_registry import make_avatar
from avatar.splat.sh import C0
from avatar.train.trainer import initialize_from_frames
from avatar.types import Camera


def seen_colours(avatar: UVAvatar, frame: Frame) -> tuple[torch.Tensor, torch.Tensor]:
    return initial_colours.seen_colours(avatar.mesh, avatar.embedding, frame)


def colour_from_frames(avatar: UVAvatar, subject: Subject) -> int:
    """How many Gaussians got another colour than grey."""
    initialize_from_frames(avatar, subject, small_config("trainer.initialization=frames"))
    return int((avatar.sh_dc[:, 0] != 0).any(dim=-1).sum())


@pytest.mark.parametrize(("cameras", "times"), [(16, 47), (16, 94), (14, 47), (16, 40), (16, 300)])
def test_first_colours_are_taken_from_all_cameras_and_many_times(cameras: int, times: int) -> None:
    """Every 16th picture, in order of time, is of the same camera."""
    shown: list[int] = []
    model: Any = SimpleNamespace(
        has_surface=False, initial_frames=48, initialize_from=lambda frames, _: shown.extend(frames)
    )
    subject: Any = SimpleNamespace(
        split=Split(tuple(range(cameras * times)), ()),
        recording=SimpleNamespace(view=lambda picture: picture % cameras),
        frame=lambda picture, _: picture,
    )
    initialize_from_frames(model, subject, small_config())
    assert len(shown) == 48 and {picture % cameras for picture in shown} == set(range(cameras))
    assert len({picture // cameras for picture in shown}) >= 6


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
    count = colour_from_frames(avatar, subject)
    after = float((((avatar.sh_dc[:, 0] * C0 + 0.5) - truth).square().sum(-1) * seen).sum().detach())
    assert 0 < count <= len(avatar)
    assert after < 0.5 * before
    untouched = (avatar.sh_dc[:, 0] == 0).all(dim=-1)
    assert int((~untouched).sum()) <= count


def test_first_colours_are_those_of_training_frames(tracked_folder: Path) -> None:
    config = small_config()
    _, subject, assets = open_small(tracked_folder, config)
    found = []
    for one in (subject, poisoned(subject)):
        avatar = new_avatar(assets, subject, config)
        assert colour_from_frames(avatar, one) > 0
        found.append(avatar.sh_dc)
    assert torch.equal(*found)


def two_sheets(apart: float) -> tuple[UVAvatar, Frame]:
    """A flat sheet of 20 x 20 cm that faces the camera at 1 m, and another one `apart` metres behind it, of another colour.

    Half of the Gaussians, the first, lie on the front sheet; the picture shows a gradient, so that places differ.
    """
    sheet = grid_head()
    V = sheet.num_vertices
    flat = sheet.template * torch.tensor([1.0, 1.0, 0.0])
    behind = flat * 0.9 - torch.tensor([0.0, 0.0, apart])
    left, right = sheet.uvs * torch.tensor([0.5, 1.0]), sheet.uvs * torch.tensor([0.5, 1.0]) + torch.tensor([0.5, 0.0])
    assets = replace(
        sheet,
        template=torch.cat((flat, behind)),
        faces=torch.cat((sheet.faces, sheet.faces + V)),
        shape_dirs=torch.zeros(2 * V, 3, 300),
        expression_dirs=torch.zeros(2 * V, 3, 5),
        pose_dirs=torch.zeros(2 * V, 3, 36),
        joint_regressor=torch.full((5, 2 * V), 0.5 / V),
        weights=sheet.weights.repeat(2, 1),
        eyelid_dirs=torch.zeros(2, 2 * V, 3),
        uvs=torch.cat((left, right)),
        uv_faces=torch.cat((sheet.uv_faces, sheet.uv_faces + len(sheet.uvs))),
        regions={},
    )
    avatar = make_avatar(assets, torch.zeros(0), small_config().model)
    camera = Camera(torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.tensor([0.0, 0, 1]), 400, 400, 64, 64, 128, 128)
    ones = torch.ones(128, 128)
    ramp = torch.linspace(0, 1, 128).expand(128, 128)[..., None].repeat(1, 1, 3)
    return avatar, Frame(0, "00000", camera, rest_params(), ramp, ones, ones, ones)


def on_back(avatar: UVAvatar) -> torch.Tensor:
    return avatar.embedding.corners[:, 0] >= avatar.head.assets.num_vertices // 2


def test_what_another_surface_hides_has_no_colour() -> None:
    avatar, frame = two_sheets(apart=0.02)
    _, seen = seen_colours(avatar, frame)
    back = on_back(avatar)
    assert bool((seen[~back] > 0.9).all()), "the front sheet is seen, nearly from straight ahead"
    assert bool((seen[back] == 0).all()), "the sheet behind it is hidden, though it faces the camera too"


def test_what_turns_its_back_has_no_colour_though_nothing_hides_it() -> None:
    """The inside of an open neck: the camera is behind both sheets."""
    avatar, frame = two_sheets(apart=0.02)
    behind = replace(frame.camera, R_cam_world=torch.diag(torch.tensor([-1.0, -1.0, 1.0])))
    assert bool((seen_colours(avatar, replace(frame, camera=behind))[1] == 0).all())


def test_what_lies_a_little_under_the_surface_counts_as_seen() -> None:
    """Lids and lips lie on each other; a raster's depth is no more exact than a pixel."""
    avatar, frame = two_sheets(apart=0.001)
    assert bool((seen_colours(avatar, frame)[1] > 0.9).all())


def test_a_place_counts_by_the_square_of_the_cosine_under_which_it_is_seen(tracked_folder: Path) -> None:
    config = small_config()
    _, subject, assets = open_small(tracked_folder, config)
    avatar = new_avatar(assets, subject, config)
    frame = subject.frame(0)
    whole = torch.ones_like(frame.alpha)
    _, seen = seen_colours(avatar, replace(frame, alpha=whole, head_mask=whole))
    vertices = avatar.head.vertices(frame.params).double().numpy()
    a, b, c = vertices[avatar.embedding.corners.numpy()].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    eye = -frame.camera.R_cam_world.double().numpy().T @ frame.camera.t_cam_world.double().numpy()
    sight = eye - avatar.embedding.points(avatar.head.vertices(frame.params)).double().numpy()
    cosine = (normals * sight).sum(1) / np.linalg.norm(normals, axis=1) / np.linalg.norm(sight, axis=1)
    shown = seen.numpy() > 0
    assert cosine[shown].min() < 0.5 < 0.9 < cosine[shown].max(), "no slants to tell from"
    np.testing.assert_allclose(seen.numpy()[shown], cosine[shown] ** 2, atol=1e-4)


def test_several_frames_are_averaged_by_how_well_they_show_a_place(
    tracked_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = small_config()
    _, subject, assets = open_small(tracked_folder, config)
    avatar = new_avatar(assets, subject, config)
    N = len(avatar)
    looks = iter([(torch.full((N, 3), 0.2), torch.full((N,), 0.25)), (torch.full((N, 3), 0.6), torch.full((N,), 0.75))])
    monkeypatch.setattr(initial_colours, "seen_colours", lambda *_: next(looks))
    mean, shown = initial_colours.mean_colours(avatar.mesh, avatar.embedding, [subject.frame(i) for i in (0, 1)])
    assert bool(shown.all())
    torch.testing.assert_close(mean, torch.full((N, 3), 0.5))


def test_the_matte_and_the_head_mask_are_weights(tracked_folder: Path) -> None:
    config = small_config()
    _, subject, assets = open_small(tracked_folder, config)
    avatar = new_avatar(assets, subject, config)
    frame = subject.frame(0)
    whole, half = torch.ones_like(frame.alpha), torch.full_like(frame.alpha, 0.5)
    _, full = seen_colours(avatar, replace(frame, alpha=whole, head_mask=whole))
    _, less = seen_colours(avatar, replace(frame, alpha=half, head_mask=half))
    torch.testing.assert_close(less, 0.25 * full)


def test_a_model_whose_gaussians_start_on_the_mesh_has_no_surface(tracked_folder: Path) -> None:
    config = small_config("trainer.initialization=surface")
    _, subject, assets = open_small(tracked_folder, config)
    with pytest.raises(UserError, match="initialization=surface is for model=gaussianheadavatar.*hypergaussians"):
        initialize_from_frames(new_avatar(assets, subject, config), subject, config)
