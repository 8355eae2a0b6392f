"""INSTA's published archives: the tracking comes back from meshes of any topology, and bad meshes are named."""

from __future__ import annotations

import dataclasses
import itertools
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from exports import write_insta
from importing import FRAMES, HEIGHT, SIZE, assert_same_pictures, import_folder
from mesh_folder import Topology, posed, write_meshes

from avatar.data.subject import Subject
from avatar.demo.head import demo_head
from avatar.demo.head_files import write_head_model
from avatar.errors import UserError, refuse
from avatar.head.assets import HeadAssets, load_head_assets
from avatar.head.model import HeadModel
from avatar.types import IDENTITY_6D, HeadParams
from data_prep.formats.detect import open_tracked_folder
from data_prep.formats.frame_track import Tracking
from data_prep.formats.insta_meshes import read_meshes
from data_prep.formats.mesh_head import HeadRows, MeshPose
from data_prep.formats.mesh_rows import increasing_rows
from data_prep.formats.transforms import ListedFrame
from data_prep.prepare.cache import input_hash

MILLIMETRE, DEGREE = 1e-3, np.pi / 180
KINDS = ("full", "faces", "vertices")


@pytest.fixture(scope="module")
def archive(tracked: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_insta(tracked, tmp_path_factory.mktemp("meshes") / "bala", checkpoint=False)
    write_meshes(tracked, folder, "vertices")
    return folder


@pytest.fixture
def copy(archive: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(archive, tmp_path / "bala"))


def tracking_of(folder: Path, tracked: Path) -> Tracking:
    head = load_head_assets(tracked / "head_model")
    return open_tracked_folder(folder).read(head, (SIZE, HEIGHT), refuse)


@pytest.mark.parametrize("kind", KINDS)
def test_an_archive_gives_the_same_pictures(kind: str, tracked: Path, original: Subject, tmp_path: Path) -> None:
    folder = write_insta(tracked, tmp_path / "bala", checkpoint=False)
    write_meshes(tracked, folder, kind)
    subject, said = import_folder(folder, tracked, tmp_path / "out")
    assert said[0] == "format: INSTA" and any("is fitted to the meshes, whose vertices it misses by" in s for s in said)
    assert_same_pictures(subject, original, tracked)
    assert subject.split == (tuple(range(18)), tuple(range(18, FRAMES)))


@pytest.fixture(scope="module")
def head(tmp_path_factory: pytest.TempPathFactory) -> HeadAssets:
    """With the demo's joints, correctives and eyelids, and directions in more of FLAME's places than the demo has."""
    folder = tmp_path_factory.mktemp("head")
    write_head_model(folder, demo_head())
    head, rng = load_head_assets(folder), np.random.default_rng(4)

    def waves(count: int) -> torch.Tensor:
        phases = head.template.double().numpy() @ (60 * rng.standard_normal((3, count))) + rng.uniform(0, 6, count)
        return torch.from_numpy(5e-4 * np.cos(phases)[:, None] * rng.standard_normal((3, count))).float()

    return dataclasses.replace(
        head, shape_dirs=head.shape_dirs + waves(300), expression_dirs=head.expression_dirs + waves(100)
    )


def rotation(*vector: float) -> np.ndarray:
    return cv2.Rodrigues(np.array(vector))[0]


def flame_of(number: int, head: HeadAssets) -> dict[str, np.ndarray]:
    rng, wave = np.random.default_rng(number), np.sin(0.7 * number + np.arange(6))
    return {
        "shape": 0.7 * np.random.default_rng(77).standard_normal(300),
        "exp": 0.6 * rng.standard_normal(head.num_expressions),
        "jaw": rotation(0.2 + 0.2 * wave[0], 0.03 * wave[1], 0.02 * wave[2])[:2].ravel(),
        "eyes": np.concatenate([rotation(*(0.2 * rng.standard_normal(3)))[:2].ravel() for _ in range(2)]),
        "eyelids": rng.uniform(0, 1, 2),
    }


@pytest.mark.parametrize("kind", [*(pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS[:2]), KINDS[2]])
def test_the_parameters_come_back(kind: str, head: HeadAssets, tmp_path: Path) -> None:
    """Of a mesh with a pose inside, whose expression is only roughly known, and some vertices of which were moved."""
    topology, truths, listed = Topology(head, kind), [], {}
    topology.write(tmp_path / "canonical.obj", posed(head, flame_of(0, head) | {"exp": np.zeros(100)}))
    moved = np.random.default_rng(1).permutation(head.num_vertices)[:50]
    for number in range(8):
        flame, rng = flame_of(number, head), np.random.default_rng(50 + number)
        vertices = posed(head, flame)
        R, t = rotation(*(0.3 * rng.standard_normal(3))), 0.02 * rng.standard_normal(3)
        camera = np.eye(4)
        camera[:3, :3], camera[:3, 3] = rotation(0.2, 3.0, 0.1), [0.1, 0.2, -0.9]
        inside = vertices @ R.T + t
        truths.append((vertices, camera[:3, :3] @ R, camera[:3, :3] @ t + camera[:3, 3], flame))
        inside[moved] += 0.03 * rng.standard_normal(3)
        topology.write(tmp_path / f"{number}.obj", inside)
        np.savetxt(tmp_path / f"{number}.txt", flame["exp"] + 0.1 * rng.standard_normal(100))
        values = {"mesh_path": f"{number}.obj", "exp_path": f"{number}.txt", "camera_angle_x": 0.3}
        values |= {"transform_matrix": np.linalg.inv(camera).tolist()}
        listed[number] = ListedFrame(tmp_path / "transforms.json", number, values, {}, None, tmp_path)
    tracking = read_meshes(tmp_path, listed, head, (64, 64), refuse)
    assert len(tracking.frames) == 8
    model = HeadModel(head, torch.from_numpy(tracking.frames[0].shape), torch.float64)
    for track, (vertices, R, t, flame) in zip(tracking.frames.values(), truths, strict=True):
        values = (track.expression, track.jaw, track.eyes, track.eyelids, np.array(IDENTITY_6D))
        found = model.vertices(HeadParams(*map(torch.from_numpy, values))).numpy()
        assert np.linalg.norm(found - vertices, axis=1).max() < 0.05 * MILLIMETRE
        assert np.linalg.norm(cv2.Rodrigues(track.R.T @ R)[0]) < 0.05 * DEGREE
        assert np.linalg.norm(track.t - t) < 0.05 * MILLIMETRE
        np.testing.assert_allclose(track.jaw, flame["jaw"], atol=1e-3)
        np.testing.assert_allclose(track.eyelids, flame["eyelids"], atol=1e-2)
        assert not (track.neck - IDENTITY_6D).any()


def test_rows_are_posed_as_the_head_model_poses_them_and_so_are_their_derivatives(head: HeadAssets) -> None:
    flame = flame_of(3, head)
    params = HeadParams(
        *(torch.from_numpy(flame[name]) for name in ("exp", "jaw", "eyes", "eyelids")), torch.tensor(IDENTITY_6D)
    )
    expected = HeadModel(head, torch.from_numpy(flame["shape"]), torch.float64).vertices(params).numpy()
    turns = np.concatenate((flame["jaw"], flame["eyes"])).reshape(3, 2, 3)
    turns = np.concatenate((turns, np.cross(turns[:, :1], turns[:, 1:])), axis=1)
    pose = MeshPose(rotation(0.1, 0.2, 0.3), np.full(3, 0.1), turns, flame["eyelids"], flame["exp"])
    chosen = np.arange(0, head.num_vertices, 7)
    mean = HeadRows(head, chosen)
    rows = mean.with_identity(flame["shape"])
    vertices, by = rows.linearised(pose)
    np.testing.assert_allclose(vertices, expected[chosen], atol=1e-7)
    points = vertices @ pose.R.T + pose.t
    for column in range(30):
        there = pose.moved(1e-6 * np.eye(by.shape[1])[column])
        change = pose.inside(rows.vertices(there) @ there.R.T + there.t) - pose.inside(points)
        np.testing.assert_allclose(change.ravel(), 1e-6 * by[:, column], atol=1e-11)
    nudged = mean.with_identity(flame["shape"] + 1e-3 * np.eye(300)[5]).vertices(pose) - vertices
    np.testing.assert_allclose(nudged.ravel(), 1e-3 * rows.identity_derivatives(pose)[:, 5], atol=1e-11)


def test_increasing_rows_are_those_of_the_least_sum() -> None:
    rng = np.random.default_rng(0)
    for count in (1, 3, 6):
        targets, points = rng.standard_normal((6, 3)), rng.standard_normal((count, 3))
        sums = {
            rows: np.linalg.norm(targets[list(rows)] - points, axis=1).sum()
            for rows in itertools.combinations(range(6), count)
        }
        assert tuple(increasing_rows(points, targets)) == min(sums, key=lambda rows: sums[rows])


def edit(path: Path, change: Callable[[list[str]], list[str]]) -> None:
    path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")


BAD_MESHES: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing": (Path.unlink, "does not exist"),
    "a pipe": (lambda p: (p.unlink(), os.mkfifo(p)), "a named pipe"),
    "another count": (lambda p: edit(p, lambda lines: ["v 0 0 0", *lines]), r"has \d+ vertices, but canonical.obj has"),
    "not a number": (lambda p: edit(p, lambda ls: ["v 0 nan 0" if "v " in x else x for x in ls]), "is not finite"),
    "words": (lambda p: edit(p, lambda ls: [x.replace("v 0", "v z") for x in ls]), "a vertex that is not numbers"),
    "two columns": (lambda p: p.write_text("v 0 0\n" * 9), "has vertices of 2 numbers"),
    "empty": (lambda p: p.write_text(""), "holds no vertices"),
    "millimetres": (lambda p: p.write_text("v 90 0 1\n" * 9), "reaches 90 m from its origin"),
    "too many": (lambda p: p.write_bytes(b"v 0 0 0\n" * 3_000_000), "read up to 16.8 MB"),
    "no head": (
        lambda p: edit(p, lambda ls: [f"v {i % 7} {i % 3} 0" if "v " in x else x for i, x in enumerate(ls)]),
        "the head model misses 00006.obj by",
    ),
}


@pytest.mark.parametrize("name", BAD_MESHES)
def test_a_bad_mesh_is_left_out_with_the_reason(name: str, copy: Path, tracked: Path) -> None:
    spoil, words = BAD_MESHES[name]
    spoil(copy / "meshes" / "00006.obj")
    found = tracking_of(copy, tracked)
    assert list(found.bad) == [6] and len(found.frames) == FRAMES - 1
    with pytest.raises(AssertionError, match=words):
        raise AssertionError(found.bad[6])


def test_an_expected_expression_that_changes_is_noticed(copy: Path) -> None:
    before = input_hash(open_tracked_folder(copy).files, {})
    edit(sorted((copy / "flame" / "exp").iterdir())[3], lambda lines: [*lines, "1"])
    assert input_hash(open_tracked_folder(copy).files, {}) != before


def wrinkled(lines: list[str]) -> list[str]:
    vertices = [[float(value) for value in line.split()[1:]] for line in lines if line[0] == "v"]
    return [f"v {x} {y} {z + 0.01 * (-1) ** i}" for i, (x, y, z) in enumerate(vertices)]


BAD_ARCHIVES: dict[str, tuple[Callable[[Path], object], str]] = {
    "no canonical mesh": (lambda f: (f / "canonical.obj").unlink(), r"canonical\.obj: does not exist: it says which"),
    "faces of nothing": (
        lambda f: edit(f / "canonical.obj", lambda lines: [*lines, "f 1 2 1000000000"]),
        r"a face of canonical\.obj names a vertex outside its \d+",
    ),
    "faces of words": (
        lambda f: edit(f / "canonical.obj", lambda lines: [*lines, "f one two three"]),
        r"canonical\.obj has a face that names no vertices",
    ),
    "another canonical mesh": (
        lambda f: edit(f / "canonical.obj", lambda ls: [*ls[:2], *ls[2:][::-1]]),
        r"canonical\.obj has \d+ vertices, and only \d+% of its triangles are the head model's; give --head",
    ),
    "more vertices": (
        lambda f: edit(f / "canonical.obj", lambda lines: [*lines, *["v 0 0 0"] * 1000]),
        r"canonical\.obj has \d+ vertices and the head model 768; give --head",
    ),
    "one vertex fewer": (
        lambda f: (f / "canonical.obj").write_text("v 0 0 0\n"),
        r"no mesh of .* has the 1 vertices of canonical\.obj",
    ),
    "another head": (
        lambda f: [edit(p, wrinkled) for p in (f / "meshes").iterdir()],
        r"the head model misses the meshes of .* by .* mm; give --head",
    ),
    "empty meshes": (
        lambda f: [p.write_text("") for p in (f / "meshes").iterdir()],
        r"none of the meshes of .* that were tried can be used: \d+\.obj holds no vertices",
    ),
    "no meshes": (
        lambda f: shutil.rmtree(f / "meshes"),
        r"holds no checkpoint/\*\.frame of metrical-tracker and none of the meshes that the listing names",
    ),
}


@pytest.mark.parametrize("name", BAD_ARCHIVES)
def test_an_archive_of_another_head_is_refused(name: str, copy: Path, tracked: Path) -> None:
    spoil, words = BAD_ARCHIVES[name]
    spoil(copy)
    with pytest.raises(UserError, match=words) as refusal:
        tracking_of(copy, tracked)
    assert "\n" not in str(refusal.value)


def test_without_a_canonical_mesh_whole_meshes_do_and_expectations_may_be_nonsense(
    tracked: Path, original: Subject, tmp_path: Path
) -> None:
    folder = write_insta(tracked, tmp_path / "bala", checkpoint=False)
    write_meshes(tracked, folder, "faces")
    (folder / "canonical.obj").unlink()
    for number, path in enumerate(sorted((folder / "flame" / "exp").iterdir())):
        path.write_text(["1e400 " * 10, "nan " * 10, "one", "1 2"][number % 4])
    subject, _ = import_folder(folder, tracked, tmp_path / "out")
    assert_same_pictures(subject, original, tracked)
