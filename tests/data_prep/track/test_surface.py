"""Positions against the program's own head model, derivatives against autograd through it; both in float64."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from heads import EXPRESSIONS, grid_head
from scipy.spatial.transform import Rotation

from avatar.errors import UserError
from avatar.head.assets import HeadAssets
from avatar.head.model import HeadModel
from avatar.types import HeadParams
from data_prep.track.fit.frame_poses import (
    NUM_FIXED,
    Columns,
    Motion,
    gaze_rotations,
    left_jacobians,
    rotations,
)
from data_prep.track.fit.surface import SurfacePoints

T, N, IDENTITIES = 3, 11, 4
USED = torch.tensor([0, 2, 3])  # of the head's expressions


def rooted_head(seed: int = 0) -> HeadAssets:
    """A head whose jaw and eyes hang on its root."""
    return replace(grid_head(seed=seed), parents=(-1, 0, 0, 0, 0))


def some_motion(seed: int, scale: float = 0.4) -> Motion:
    generator = torch.Generator().manual_seed(seed)

    def noise(*shape: int) -> torch.Tensor:
        return scale * torch.randn(*shape, generator=generator, dtype=torch.float64)

    return Motion(rotations(noise(T, 3)), noise(T, 3), noise(T, 3), noise(T, 4), noise(T, 2), noise(T, len(USED)))


def some_points(assets: HeadAssets, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    corners = assets.faces[torch.randperm(len(assets.faces), generator=generator)[:N]]
    weights = torch.rand(N, 3, generator=generator, dtype=torch.float64)
    return corners, weights / weights.sum(1, keepdim=True)


def by_head_model(assets: HeadAssets, corners, weights, identity, motion: Motion) -> torch.Tensor:
    head = HeadModel(assets, identity, torch.float64)
    frames = []
    for f in range(T):
        expression = motion.expression.new_zeros(EXPRESSIONS).index_put((USED,), motion.expression[f])
        params = HeadParams(
            expression=expression,
            jaw=torch.matrix_exp(skew(motion.jaw[f]))[:2].reshape(6),
            eyes=torch.cat([gaze_rotations(motion.gaze[f, s])[:2].reshape(6) for s in (slice(0, 2), slice(2, 4))]),
            eyelids=motion.eyelids[f],
            neck=torch.eye(3)[:2].reshape(6),
        )
        frames.append((head.vertices(params)[corners] * weights[..., None]).sum(1))
    return torch.stack(frames)


def skew(v: torch.Tensor) -> torch.Tensor:
    zero = v.new_zeros(())
    return torch.stack((zero, -v[2], v[1], v[2], zero, -v[0], -v[1], v[0], zero)).reshape(3, 3)


@pytest.mark.parametrize("make_head", [grid_head, rooted_head])
@pytest.mark.parametrize("seed", range(2))
def test_positions_and_derivatives_are_those_of_the_head_model(make_head, seed: int) -> None:
    assets, motion = make_head(seed=seed), some_motion(seed)
    corners, weights = some_points(assets, seed)
    identity = torch.randn(IDENTITIES, dtype=torch.float64)
    points = SurfacePoints(assets, corners, weights, IDENTITIES, USED)
    expected = by_head_model(assets, corners, weights, identity, motion)
    torch.testing.assert_close(points.positions(identity, motion), expected, rtol=0, atol=1e-12)

    directions = torch.randn(T, N, 2, 3, dtype=torch.float64)
    placed = points.placed(identity, motion)
    torch.testing.assert_close(placed.positions, expected, rtol=0, atol=1e-12)
    derivatives = points.derivatives(placed, directions, with_identity=True)

    def along(identity: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        at = by_head_model(assets, corners, weights, identity, motion.moved(step))
        return torch.einsum("tnqc,tnc->nqt", directions, at).flatten(0, 1)

    zero = torch.zeros(T, NUM_FIXED + len(USED), dtype=torch.float64)
    by_identity, by_step = torch.autograd.functional.jacobian(along, (identity, zero))
    of_same_frame = torch.diagonal(by_step, dim1=1, dim2=2).permute(0, 2, 1)
    torch.testing.assert_close(derivatives.coefficients, of_same_frame[..., Columns.HEAD], rtol=0, atol=1e-8)
    assert not of_same_frame[..., Columns.POSE].any()
    torch.testing.assert_close(derivatives.identity, by_identity, rtol=0, atol=1e-8)


def test_without_identity_and_pose_correctives_the_rest_is_the_same() -> None:
    assets = grid_head()
    plain = replace(assets, pose_dirs=torch.zeros_like(assets.pose_dirs))
    corners, weights = some_points(assets, 0)
    motion, identity = some_motion(0), torch.zeros(0, dtype=torch.float64)
    points = SurfacePoints(plain, corners, weights, 0, USED)
    expected = by_head_model(plain, corners, weights, identity, motion)
    placed = points.placed(identity, motion)
    torch.testing.assert_close(placed.positions, expected, rtol=0, atol=1e-12)
    derivatives = points.derivatives(placed, torch.ones(T, N, 1, 3, dtype=torch.float64))
    assert derivatives.identity.shape == (N, T, 0)


def test_a_head_whose_eyes_hang_on_its_jaw_is_refused() -> None:
    assets = replace(grid_head(), parents=(-1, 0, 1, 2, 2))
    with pytest.raises(UserError, match="jaw and eyes must hang on its neck"):
        SurfacePoints(assets, *some_points(assets, 0), IDENTITIES, USED)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-7, 9.9e-3, 1.01e-2, 0.5, 3.0])
def test_rotation_vectors(angle: float) -> None:
    v = angle * torch.tensor([0.6, -0.64, 0.48], dtype=torch.float64)
    R = rotations(v)
    np.testing.assert_allclose(R.numpy(), Rotation.from_rotvec(v.numpy()).as_matrix(), rtol=0, atol=1e-14)
    # exp(v + d) exp(v)^-1 = exp(J d) to first order in d
    moved = torch.autograd.functional.jacobian(lambda d: rotations(v + d) @ R.T, torch.zeros(3, dtype=torch.float64))
    turned = torch.stack((moved[2, 1], moved[0, 2], moved[1, 0]))
    torch.testing.assert_close(left_jacobians(v), turned, rtol=0, atol=1e-9)
