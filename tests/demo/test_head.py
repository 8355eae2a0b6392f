"""The procedural head: a clean mesh, a chart without overlap, and a FLAME-format model that does what its names say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from avatar.demo.head import JOINTS, DemoHead, demo_head
from avatar.demo.occlusion import neutral_params
from avatar.demo.performance import perform
from avatar.demo.scene import head_assets
from avatar.head.model import HeadModel
from avatar.head.rasterize import rasterize_mesh


@pytest.fixture(scope="module")
def head() -> DemoHead:
    return demo_head()


@pytest.fixture(scope="module")
def model(head: DemoHead) -> HeadModel:
    return HeadModel(head_assets(head), torch.zeros(0))


def _directed_edges(faces: np.ndarray) -> np.ndarray:
    return np.concatenate((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]))


def _turn_about_x(angle: float) -> torch.Tensor:
    c, s = np.cos(angle), np.sin(angle)
    return torch.tensor([1.0, 0.0, 0.0, 0.0, c, -s], dtype=torch.float32)


def test_size_and_proportions(head: DemoHead) -> None:
    low, high = head.template.min(0), head.template.max(0)
    skin = head.template[head.regions["face"]]
    assert 4000 <= len(head.template) <= 6500
    chin_to_crown = high[1] - skin[:, 1].min()
    assert 0.20 < chin_to_crown < 0.25  # metres
    assert 0.14 < high[0] - low[0] < 0.19
    assert skin[:, 2].mean() > 0.04, "the face looks along +z"


def test_each_edge_is_used_once_in_each_direction_and_only_the_openings_are_open(head: DemoHead) -> None:
    edges = _directed_edges(head.mesh.faces)
    assert len(np.unique(edges, axis=0)) == len(edges), "two faces run along an edge in the same direction"
    both = set(map(tuple, edges.tolist()))
    open_edges = [e for e in both if (e[1], e[0]) not in both]
    following = dict(open_edges)
    assert len(following) == len(open_edges), "an open end touches itself"
    loops, left = [], set(following)
    while left:
        vertex, length = left.pop(), 1
        start = vertex
        while (vertex := following[vertex]) != start:
            left.remove(vertex)
            length += 1
        loops.append(length)
    # Neck, two lids, the slit between the lips, and the backs of the two eyeballs.
    eye, mouth = head.mesh.eye_rings.shape[-1], 2 * head.mesh.mouth_rings.shape[-1] - 2
    assert sorted(loops) == sorted([len(head.regions["boundary"]), eye, eye, mouth, 24, 24])


def test_faces_wind_outwards(head: DemoHead) -> None:
    points, faces = head.template.astype(np.float64), head.mesh.faces
    skull = np.isin(faces, head.regions["scalp"]).all(1)
    a, b, c = (points[faces[skull][:, k]] for k in range(3))
    centre = np.array([0.0, 0.05, -0.02])
    assert (((np.cross(b - a, c - a)) * ((a + b + c) / 3 - centre)).sum(-1) > 0).all()
    for ball, joint in zip(head.mesh.eyeballs, JOINTS[3:], strict=True):
        own = np.isin(faces, ball).all(1)
        a, b, c = (points[faces[own][:, k]] for k in range(3))
        assert ((np.cross(b - a, c - a) * ((a + b + c) / 3 - joint)).sum(-1) > 0).all()


def test_mesh_is_its_own_mirror_image(head: DemoHead) -> None:
    mirrored = head.template[head.mesh.mirror] * np.array([-1, 1, 1], np.float32)
    np.testing.assert_allclose(mirrored, head.template, atol=1e-6)


def test_chart_does_not_overlap(head: DemoHead) -> None:
    uv, faces = head.mesh.uvs, head.mesh.uv_faces
    assert uv.min() >= 0 and uv.max() <= 1
    a, b, c = (uv[faces[:, k]] for k in range(3))
    doubled = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    assert (doubled > 0).all(), "a triangle of the chart is turned over"
    # All triangles turn the same way; if none overlaps, they cover as much as their areas add up to.
    size = 1024
    screen = np.column_stack((uv * size, np.ones(len(uv))))
    covered = (rasterize_mesh(screen, faces, size, size).face_id >= 0).mean()
    assert covered == pytest.approx(doubled.sum() / 2, rel=2e-3)


def test_face_takes_most_of_a_128_raster(head: DemoHead) -> None:
    uv, size = head.mesh.uvs, 128
    screen = np.column_stack((uv * size, np.ones(len(uv))))
    raster = rasterize_mesh(screen, head.mesh.uv_faces, size, size)
    texel_faces = head.mesh.faces[raster.face_id[raster.face_id >= 0]]
    assert len(texel_faces) > 13_000
    of_face = np.isin(texel_faces, head.regions["face"]).all(1).mean()
    assert of_face > 0.5
    for eye in ("left_eyeball", "right_eyeball"):
        assert np.isin(texel_faces, head.regions[eye]).all(1).sum() > 120


def test_weights_and_joints(head: DemoHead) -> None:
    np.testing.assert_allclose(head.weights.sum(1), 1.0, atol=1e-6)
    assert head.weights.min() >= 0
    np.testing.assert_allclose(head.joint_regressor @ head.template, JOINTS, atol=1e-6)
    np.testing.assert_allclose(head.joint_regressor.sum(1), 1.0, atol=1e-5)
    # Joints keep their place in the eyes when the identity moves them.
    shifted = head.template + head.identity_dirs @ np.full(head.identity_dirs.shape[2], 0.7, np.float32)
    for ball, row in zip(head.mesh.eyeballs, (3, 4), strict=True):
        radius = np.linalg.norm(shifted[ball] - head.joint_regressor[row] @ shifted, axis=-1)
        np.testing.assert_allclose(radius, radius.mean(), atol=2e-6)


def test_there_are_enough_directions_and_each_moves_something(head: DemoHead) -> None:
    assert head.identity_dirs.shape[2] >= 10 and head.expression_dirs.shape[2] >= 20
    for basis in (head.identity_dirs, head.expression_dirs):
        largest = np.linalg.norm(basis, axis=1).max(0)
        assert (largest > 0.8e-3).all() and (largest < 20e-3).all()
    assert np.abs(head.pose_dirs[:, :, 9:18]).max() > 1e-3, "the jaw has no pose correctives"


@pytest.mark.parametrize(
    ("name", "axis", "sign"),
    [("smile_left", 0, 1), ("smile_left", 1, 1), ("pucker", 0, -1), ("frown_left", 1, -1), ("stretch_left", 0, 1)],
)
def test_expressions_move_the_left_mouth_corner_the_right_way(head: DemoHead, name: str, axis: int, sign: int) -> None:
    corner = head.mesh.mouth_rings[0, 4, head.mesh.mouth_rings.shape[-1] // 2]
    move = head.expression_dirs[corner, axis, head.expression_names.index(name)]
    assert move * sign > 1e-3


def test_jaw_parts_the_lips_and_leaves_the_upper_one(head: DemoHead, model: HeadModel) -> None:
    neutral = neutral_params()
    opened = model.vertices(replace(neutral, jaw=_turn_about_x(0.25)))
    closed = model.vertices(neutral)
    upper, lower = head.mesh.mouth_rings[0, 2, 0], head.mesh.mouth_rings[0, 2, -1]
    assert (closed[upper] - closed[lower]).norm() < 0.5e-3
    assert (opened[upper] - opened[lower])[1] > 15e-3
    assert (opened[upper] - closed[upper]).norm() < 1e-3
    scalp = torch.from_numpy(head.regions["scalp"])
    torch.testing.assert_close(opened[scalp], closed[scalp], atol=1e-6, rtol=0)


@pytest.mark.parametrize("side", [0, 1])
def test_eyelids_close_their_own_eye_without_entering_the_eyeball(head: DemoHead, model: HeadModel, side: int) -> None:
    def gap(vertices: torch.Tensor, eye: int) -> float:
        ring = head.mesh.eye_rings[eye, 1]
        quarter = len(ring) // 4
        return float(vertices[ring[quarter], 1] - vertices[ring[3 * quarter], 1])

    neutral = neutral_params()
    weights = torch.zeros(2)
    weights[side] = 1.0
    opened, closed = model.vertices(neutral), model.vertices(replace(neutral, eyelids=weights))
    assert gap(opened, side) > 8e-3
    assert gap(closed, side) < 1e-3
    assert gap(closed, 1 - side) == pytest.approx(gap(opened, 1 - side), abs=1e-6)
    lid = torch.from_numpy(head.mesh.eye_rings[side, 1:4])
    radius = (closed[lid] - torch.from_numpy(JOINTS[3 + side]).float()).norm(dim=-1)
    eyeball = float(np.linalg.norm(head.template[head.mesh.eyeballs[side]] - JOINTS[3 + side], axis=-1).mean())
    assert float(radius.min()) > eyeball


def test_tracked_head_holds_no_teeth(head: DemoHead, model: HeadModel) -> None:
    """Straight into the wide open mouth there is no surface of the tracked model before the back of the head."""
    vertices = model.vertices(replace(neutral_params(), jaw=_turn_about_x(0.3))).numpy()
    lips = vertices[head.mesh.mouth_rings[:, 2]]
    size = 200
    middle = np.array([0.0, lips[..., 1].mean()])
    screen = np.column_stack(((vertices[:, :2] - middle) / 0.05 * size + size / 2, 1.0 - vertices[:, 2]))
    raster = rasterize_mesh(screen, head.mesh.faces, size, size)
    assert raster.depth[size // 2, size // 2] > 1.0, "something is behind the lips and before the middle of the head"


def test_the_eyes_go_to_their_limits() -> None:
    p = perform(3, 80, "gaze")
    left, down = np.degrees(p.gaze).T
    is_open = p.eyelids.max(1) < 0.1
    assert left.max() > 30 and left.min() < -30 and down.min() < -20, "corners and up"
    assert ((down > 18) & (np.abs(left) < 5) & is_open).any(), "down with open lids"
    assert ((p.eyelids > 0.95) & (p.eyelids[:, ::-1] < 0.05)).any(0).all(), "both winks"


@pytest.mark.parametrize("motion", ["speech", "turn"])
def test_motion_is_smooth_and_of_human_size(motion) -> None:
    p = perform(3, 500, motion)
    assert p.jaw.max() > 0.12 and p.jaw.min() >= 0 and p.jaw.max() < 0.45
    assert np.abs(np.diff(p.jaw)).max() < 0.16
    assert np.degrees(np.abs(np.diff(p.head, axis=0)).max()) < 4.0
    yaw = np.degrees(p.head[:, 0])
    assert np.ptp(yaw) > (55 if motion == "turn" else 12)
    assert np.abs(yaw).max() < (60 if motion == "turn" else 25)
    assert (p.eyelids.max(1) > 0.95).sum() >= 4, "no blinks in twenty seconds"
    assert np.abs(p.expression).max() <= 1.6
