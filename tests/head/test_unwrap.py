"""The layout of head models that come without one: no overlap, the same every time, and what cannot be laid out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import avatar
from small_runs import SMALL
from tracked_folder import write_head_model, write_tracked_folder

from avatar.demo.head import demo_head
from avatar.demo.head_files import write_head_model as write_demo_head
from avatar.errors import UserError
from avatar.files.pickles import load_pickle
from avatar.head import assets
from avatar.head.assets import HeadAssets, load_head_assets
from avatar.head.rasterize import rasterize_mesh
from avatar.head.unwrap import NoLayout, _seen_from_in_front, _squared_stretch, unwrap
from avatar.runs.trained_avatar import load_avatar

EYES = np.array([[0.03, 0.03, 0.06], [-0.03, 0.03, 0.06]])
RASTER = 512


def without_obj(folder: Path) -> HeadAssets:
    (folder / "head_template.obj").unlink()
    return load_head_assets(folder)


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> HeadAssets:
    folder = tmp_path_factory.mktemp("head") / "head_model"
    write_demo_head(folder, demo_head())
    return without_obj(folder)


def areas(uvs: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Signed: negative where a triangle is turned over."""
    u, w = (uvs[faces[:, k]].astype(np.float64) - uvs[faces[:, 0]] for k in (1, 2))
    return 0.5 * (u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0])


def covered(uvs: np.ndarray, faces: np.ndarray) -> float:
    """Share of the square that lies in a triangle."""
    flat = np.stack((uvs[:, 0] * RASTER, (1.0 - uvs[:, 1]) * RASTER, np.ones(len(uvs))), axis=1).astype(np.float32)
    return float((rasterize_mesh(flat, faces, RASTER, RASTER).face_id >= 0).mean())


def assert_apart(uvs: np.ndarray, faces: np.ndarray) -> None:
    """No triangle turned over, none outside the square, and together they cover what each of them does."""
    assert uvs.min() >= 0.0 and uvs.max() <= 1.0 and np.isfinite(uvs).all()
    signed = areas(uvs, faces)
    assert signed.min() >= 0.0
    assert covered(uvs, faces) == pytest.approx(signed.sum(), rel=0.01)


def ball(rows: int = 24, columns: int = 32, neck: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A closed ball, or one that is open from `neck` radians before its lower pole on; radius 0.1."""
    theta = np.linspace(0.0, np.pi - neck, rows + 1)[1 : None if neck else -1]
    phi = np.linspace(0.0, 2.0 * np.pi, columns, endpoint=False)
    t, p = (grid.ravel() for grid in np.meshgrid(theta, phi, indexing="ij"))
    points = np.stack((np.sin(t) * np.sin(p), np.cos(t), np.sin(t) * np.cos(p)), axis=1)
    count = len(theta)
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(count - 1), np.arange(columns), indexing="ij"))
    here, right = i * columns + j, i * columns + (j + 1) % columns
    below, below_right = here + columns, right + columns
    faces = [np.stack((here, below, below_right), axis=1), np.stack((here, below_right, right), axis=1)]
    top, ring = len(points), np.arange(columns)
    faces.append(np.stack((np.full(columns, top), ring, np.roll(ring, -1)), axis=1))
    points = np.concatenate((points, [[0.0, 1.0, 0.0]]))
    if not neck:
        last = (count - 1) * columns + ring
        faces.append(np.stack((np.full(columns, len(points)), np.roll(last, -1), last), axis=1))
        points = np.concatenate((points, [[0.0, -1.0, 0.0]]))
    return 0.1 * points, np.concatenate(faces)


def test_a_head_is_laid_out_without_overlap(demo: HeadAssets) -> None:
    uvs, faces = demo.uvs.numpy(), demo.uv_faces.numpy()
    assert demo.layout_is_made and faces.shape == demo.faces.shape
    assert_apart(uvs, faces)
    assert covered(uvs, faces) > 0.75
    # Rows of one vertex may be several, along the cut; never the other way round.
    pairs = np.unique(np.stack((faces.ravel(), demo.faces.numpy().ravel()), axis=1), axis=0)
    pairs = pairs[pairs[:, 0] != 0]  # row 0: triangles without area
    assert len(np.unique(pairs[:, 0])) == len(pairs)


def test_the_face_gets_the_larger_part(demo: HeadAssets) -> None:
    template, faces = demo.template.numpy(), demo.faces.numpy()
    u, w = (template[faces[:, k]] - template[faces[:, 0]] for k in (1, 2))
    on_mesh = 0.5 * np.linalg.norm(np.cross(u, w), axis=1)
    laid = areas(demo.uvs.numpy(), demo.uv_faces.numpy())
    in_face = np.isin(faces, demo.regions["face"].numpy()).all(axis=1)
    shares = [float(each[in_face].sum() / each.sum()) for each in (on_mesh, laid)]
    assert shares[1] > 1.2 * shares[0]
    # No triangle of the face is starved: all have an eighth at least of what their area is due.
    assert (laid[in_face] / laid.sum() > 0.125 * on_mesh[in_face] / on_mesh.sum()).mean() > 0.99


def test_every_time_the_same_and_elsewhere_nearly(demo: HeadAssets) -> None:
    eyes = (demo.joint_regressor.double() @ demo.template.double()).numpy()[[3, 4]]
    template, mesh = demo.template.numpy(), demo.faces.numpy()
    first, again, elsewhere = (unwrap(template, mesh, at) for at in (eyes, eyes, eyes.astype(np.float32)))
    moved = unwrap(template.astype(np.float64) + 1.0, mesh, eyes + 1.0)
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, other)
    for uvs, corners in (elsewhere, moved):
        np.testing.assert_allclose(uvs, first[0], atol=2e-5)
        np.testing.assert_array_equal(corners, first[1])


def test_the_fingerprint_is_that_of_the_method(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rounding on another machine does not make another head model of it; another method does."""
    with_obj = write_head_model(tmp_path)
    made = without_obj(tmp_path)
    assert made.layout_is_made and not with_obj.layout_is_made and made.fingerprint != with_obj.fingerprint
    moved = made.uvs + 1e-5
    with monkeypatch.context() as patch:
        patch.setattr(assets, "unwrap", lambda *_: (moved.numpy(), made.uv_faces.numpy()))
        elsewhere = load_head_assets(tmp_path)
        assert elsewhere.fingerprint == made.fingerprint and torch.equal(elsewhere.uvs, moved)
    monkeypatch.setattr(assets, "LAYOUT_METHOD", assets.LAYOUT_METHOD + 1)
    assert load_head_assets(tmp_path).fingerprint != made.fingerprint


@pytest.mark.parametrize(("neck", "lowest"), [(0.0, -0.0609), (0.6, -0.0825)])
def test_a_ball_open_or_closed(neck: float, lowest: float) -> None:
    """The cut goes down the middle of the back, to the opening if there is one."""
    points, faces = ball(neck=neck)
    uvs, laid = unwrap(points, faces, EYES)
    assert_apart(uvs, laid)
    pairs = np.unique(np.stack((laid.ravel(), faces.ravel()), axis=1), axis=0)
    cut = points[np.flatnonzero(np.bincount(pairs[:, 1]) == 2)]
    assert np.abs(cut[:, 0]).max() < 1e-9 and cut[:, 2].max() < 0
    assert (cut[:, 1].max(), cut[:, 1].min()) == pytest.approx((0.0992, lowest), abs=4e-4)


@pytest.mark.parametrize("count", [1, 2, 4, 5, 9])
def test_other_parts_lie_in_the_corners(count: int) -> None:
    points, faces = ball(neck=0.6)
    small, small_faces = ball(8, 10)
    parts, parts_faces = [points], [faces]
    for n in range(count):
        parts.append(0.1 * small + [0.02 * n, 0.0, 0.1])
        parts_faces.append(small_faces + len(points) + n * len(small))
    uvs, laid = unwrap(np.concatenate(parts), np.concatenate(parts_faces), EYES)
    assert_apart(uvs, laid)
    assert (laid[areas(uvs, laid) == 0] == 0).all()  # row 0: triangles without area
    seen = areas(uvs, laid)[len(faces) :].reshape(count, -1)
    assert ((seen > 0).sum(axis=1) > 0.6 * len(small_faces)).all()
    assert covered(uvs, laid) > 0.75


def test_a_part_in_a_corner_keeps_the_proportions_of_its_areas() -> None:
    points, faces = ball()
    laid, corners = _seen_from_in_front(points, faces, (0.0, 0.0), 1.0)
    u, w = (points[faces[:, k]] - points[faces[:, 0]] for k in (1, 2))
    shares = (areas(laid, corners) / np.linalg.norm(np.cross(u, w), axis=1))[points[faces, 2].min(axis=1) > -0.04]
    assert shares.min() > 0 and shares.std() < 0.05 * shares.mean()


@pytest.mark.parametrize(("along", "across"), [(1.0, 1.0), (2.0, 2.0), (2.0, 0.5), (1.0, -3.0)])
def test_stretch_is_the_mean_square_over_all_directions(along: float, across: float) -> None:
    rng = np.random.default_rng(0)
    x, x2, y2 = flat = rng.uniform(0.5, 1.0, (3, 20))
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    triangles = np.stack((np.stack((0 * x, 0 * x), 1), np.stack((x, 0 * x), 1), np.stack((x2, y2), 1)), axis=1)
    laid = rng.normal(size=(20, 1, 2)) + triangles * (along, across) @ turn.T
    expected = 0.5 * (along**-2 + across**-2)
    np.testing.assert_allclose(_squared_stretch(flat.T, laid), expected, rtol=1e-9)


def test_what_cannot_be_laid_out() -> None:
    points, faces = ball(neck=0.6)
    with pytest.raises(NoLayout, match="both eyes are in one place"):
        unwrap(points, faces, np.zeros((2, 3)))
    turned = faces.copy()
    turned[100] = turned[100, ::-1]
    with pytest.raises(NoLayout, match="opposite ways"):
        unwrap(points, turned, EYES)
    with pytest.raises(NoLayout, match="more than two triangles"):
        unwrap(points, np.concatenate((faces, faces[:1], faces[:1])), EYES)
    with pytest.raises(NoLayout, match="no disk"):
        unwrap(*ring(), EYES)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of values that float32 cannot hold
@pytest.mark.parametrize("seed", range(4))
def test_damaged_meshes_are_laid_out_or_refused(seed: int) -> None:
    rng = np.random.default_rng(seed)
    outcomes = []
    for n in range(60):
        points, faces = ball(8, 10, neck=0.6) if n % 2 else ball(6, 8)
        if seed == 0:
            points, faces = rng.normal(size=(20, 3)), rng.integers(0, 20, (rng.integers(1, 40), 3))
        elif seed == 1:
            faces = np.delete(faces, rng.integers(0, len(faces), rng.integers(1, 20)), axis=0)
        elif seed == 2:
            chosen = rng.integers(0, len(points), rng.integers(1, 10))
            points[chosen] = points[rng.integers(0, len(points))] if n % 3 else points[chosen] * 1e20
        else:
            faces[rng.integers(0, len(faces)), rng.integers(3)] = rng.integers(0, len(points))
        try:
            uvs, laid = unwrap(points, faces, EYES)
        except NoLayout:
            outcomes.append(False)
        else:
            assert uvs.min() >= 0.0 and uvs.max() <= 1.0 and laid.min() >= 0 and laid.max() < len(uvs)
            outcomes.append(True)
    assert not all(outcomes) and (any(outcomes) or seed == 0)


def ring(columns: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """A torus: no cut along one line makes a disk of it."""
    angle = np.linspace(0.0, 2.0 * np.pi, columns, endpoint=False)
    t, p = (grid.ravel() for grid in np.meshgrid(angle, angle, indexing="ij"))
    across = 0.1 + 0.03 * np.cos(t)
    points = np.stack((across * np.sin(p), across * np.cos(p), 0.03 * np.sin(t)), axis=1)
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(columns), np.arange(columns), indexing="ij"))
    here, right = i * columns + j, i * columns + (j + 1) % columns
    below, below_right = (i + 1) % columns * columns + j, (i + 1) % columns * columns + (j + 1) % columns
    triangles = (np.stack(corners, axis=1) for corners in ((here, below, below_right), (here, below_right, right)))
    return points, np.concatenate(list(triangles))


def test_such_a_model_is_named_by_its_folder(tmp_path: Path) -> None:
    write_head_model(tmp_path)
    content = dict(load_pickle(tmp_path / "generic_model.pkl"))
    content["f"][5] = content["f"][5][::-1]
    np.savez(tmp_path / "generic_model.npz", **content)
    (tmp_path / "generic_model.pkl").unlink()
    with pytest.raises(UserError, match=r"no OBJ with a UV layout lies in .*opposite ways\): put head_template.obj"):
        without_obj(tmp_path)


@pytest.mark.slow
def test_an_avatar_is_trained_without_an_obj(tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "someone", frames=30, size=48)
    made = without_obj(folder / "head_model")
    run = tmp_path / "run"
    output = avatar("train", folder, "--out", run, "--frame-offset", 1, *SMALL, "trainer.iterations=8")
    assert "no UV layout (head_template.obj) lies beside the head model: the program makes one" in output
    assert "strict" in avatar("eval", run, "--protocol", "strict")
    # The file with its head in it knows of the layout, and draws by itself.
    alone = tmp_path / "alone.safetensors"
    avatar("export", run, "--with-head", "--format", "avatar", "--out", alone)
    trained = load_avatar(alone)
    assert trained.assets.layout_is_made and trained.assets.fingerprint == made.fingerprint
    assert torch.equal(trained.assets.uvs, made.uvs)
    # Beside the OBJ it is another head model.
    write_head_model(folder / "head_model")
    refused = avatar("eval", run, "--protocol", "strict", status=1)
    assert "head model" in refused
