from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from heads import EXPRESSIONS, grid_head, random_params, rest_params

from avatar.head.assets import load_head_assets
from avatar.head.model import NECK, HeadModel, matrix_from_6d, nearest_rotation
from avatar.types import IDENTITY_6D
from data_prep.formats.root_pose import Joint, rotation_matrix, turned_with_neck


def oracle(assets, identity, params, anchor: str = "head") -> np.ndarray:
    """FLAME's equations written out, one vertex and one joint at a time, in float64.

    anchor  what stays in its place: "torso", as in FLAME, or "head": all is put back, by the inverse of the neck's turn
            about the identity's neck joint
    """
    f64 = lambda tensor: tensor.double().numpy()  # noqa: E731
    V, J = assets.num_vertices, 5
    shaped = f64(assets.template).copy()
    for v in range(V):
        for s, value in enumerate(f64(identity)):
            shaped[v] += f64(assets.shape_dirs)[v, :, s] * value
        for e, value in enumerate(f64(params.expression)):
            shaped[v] += f64(assets.expression_dirs)[v, :, e] * value
    joints, pivot = np.zeros((J, 3)), np.zeros(3)
    for v in range(V):
        for j in range(J):
            joints[j] += f64(assets.joint_regressor)[j, v] * shaped[v]
        neutral = f64(assets.template)[v] + f64(assets.shape_dirs)[v, :, : len(identity)] @ f64(identity)
        pivot += f64(assets.joint_regressor)[1, v] * neutral

    def rotation(six: np.ndarray) -> np.ndarray:
        a = six[:3] / np.linalg.norm(six[:3])
        b = six[3:] - np.dot(a, six[3:]) * a
        b = b / np.linalg.norm(b)
        return np.array([a, b, np.cross(a, b)])

    eyes = f64(params.eyes)
    local = [np.eye(3), *(rotation(r) for r in (f64(params.neck), f64(params.jaw), eyes[:6], eyes[6:]))]
    feature = np.concatenate([(R - np.eye(3)).reshape(-1) for R in local[1:]])
    transforms: list[np.ndarray] = []
    for j in range(J):
        parent = assets.parents[j]
        own = np.eye(4)
        own[:3, :3] = local[j]
        own[:3, 3] = joints[j] - (joints[parent] if parent >= 0 else 0)
        transforms.append(own if parent < 0 else transforms[parent] @ own)
    if anchor == "head":
        back = np.eye(4)
        back[:3, :3], back[:3, 3] = local[1].T, pivot - local[1].T @ pivot
        transforms = [back @ transform for transform in transforms]
    result = np.zeros((V, 3))
    for v in range(V):
        position = shaped[v] + f64(assets.pose_dirs)[v] @ feature
        for j in range(J):
            offset = transforms[j][:3, 3] - transforms[j][:3, :3] @ joints[j]
            result[v] += f64(assets.weights)[v, j] * (transforms[j][:3, :3] @ position + offset)
        for side in range(2):
            result[v] += f64(assets.eyelid_dirs)[side, v] * f64(params.eyelids)[side]
    return result


@pytest.mark.parametrize("seed", range(3))
def test_skinning_agrees_with_the_loop_written_oracle(seed: int) -> None:
    assets, params = grid_head(seed=seed), random_params(seed)
    identity = torch.randn(7)
    expected = oracle(assets, identity, params)
    in_float64 = HeadModel(assets, identity, torch.float64).vertices(params)
    np.testing.assert_allclose(in_float64.numpy(), expected, rtol=0, atol=1e-12)
    in_float32 = HeadModel(assets, identity).vertices(params)
    np.testing.assert_allclose(in_float32.numpy(), expected, rtol=0, atol=2e-6)


def test_an_imported_neck_turns_the_head_before_the_camera() -> None:
    assets, params, identity = grid_head(), random_params(), torch.randn(7).double()
    turn = np.array([0.2, -0.4, 0.1])
    params = replace(params, eyelids=torch.zeros(2), neck=torch.from_numpy(rotation_matrix(turn)[:2].ravel()))
    torso = rotation_matrix(np.array([0.1, 0.3, 3.0])), np.array([0.01, -0.02, 0.7])
    R, t = turned_with_neck(torso, turn, Joint(assets, NECK).position(identity.numpy()))
    seen = HeadModel(assets, identity, torch.float64).vertices(params).numpy() @ R.T + t
    expected = oracle(assets, identity, params, "torso")
    np.testing.assert_allclose(
        seen, expected @ torso[0].T + torso[1], rtol=0, atol=1e-8
    )  # float32 weights do not sum to 1


def test_at_rest_the_head_is_the_neutral_identity() -> None:
    head = HeadModel(grid_head(), torch.randn(300))
    torch.testing.assert_close(head.vertices(rest_params()), head.neutral_vertices(), rtol=0, atol=1e-6)


def test_missing_expression_coefficients_are_zeros() -> None:
    head = HeadModel(grid_head(), torch.zeros(0))
    full = random_params()
    full = replace(full, expression=torch.cat((full.expression[:2], torch.zeros(EXPRESSIONS - 2))))
    short = replace(full, expression=full.expression[:2])
    torch.testing.assert_close(head.vertices(short), head.vertices(full))


def test_a_rotation_in_6d_is_orthonormal_and_its_first_rows_are_the_input() -> None:
    six = torch.randn(20, 6, dtype=torch.float64)
    R = matrix_from_6d(six)
    torch.testing.assert_close(R @ R.transpose(1, 2), torch.eye(3).double().expand(20, 3, 3), rtol=0, atol=1e-12)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(20).double())
    torch.testing.assert_close(matrix_from_6d(R[:, :2].reshape(20, 6)), R, rtol=0, atol=1e-12)
    assert torch.equal(matrix_from_6d(torch.tensor(IDENTITY_6D)), torch.eye(3))


@pytest.mark.usefixtures("any_shapes")
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"jaw": torch.zeros(3)}, r"jaw must have shape \[6\], got \[3\]"),
        ({"eyelids": torch.zeros(1)}, r"eyelids must have shape \[2\], got \[1\]"),
        ({"expression": torch.zeros(9)}, "9 coefficients, but the head model has 5 directions"),
    ],
)
def test_wrong_shapes_are_named(change: dict, message: str) -> None:
    head = HeadModel(grid_head(), torch.zeros(0))
    with pytest.raises(ValueError, match=message):
        head.vertices(replace(rest_params(), **change))


@pytest.mark.shared
def test_the_development_head_model_loads_with_its_regions(shared_dir) -> None:
    assets = load_head_assets(shared_dir / "subjects" / "head_model")
    assert (assets.num_vertices, len(assets.faces), assets.num_expressions) == (5060, 9891, 100)
    assert {"boundary", "lips", "face", "left_eyeball", "right_eyeball"} <= set(assets.regions)
    assert (
        load_head_assets(shared_dir / "subjects" / "head_model" / "generic_model.pkl").fingerprint == assets.fingerprint
    )


def test_the_rotation_nearest_to_a_mean_of_rotations_is_one() -> None:
    """Also of half turns about all three axes, whose mean is nearer to a reflection; by itself and among others."""
    signs = [[1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]]
    mean = torch.stack([torch.diag(torch.tensor(each)) for each in signs]).mean(dim=0)
    for found in (nearest_rotation(mean), nearest_rotation(torch.stack((torch.eye(3), mean)))[1]):
        torch.testing.assert_close(found @ found.T, torch.eye(3))
        assert float(torch.det(found)) == pytest.approx(1.0)
