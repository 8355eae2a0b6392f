"""The subject folder and the renderer: complete, true to its tracking, the same each time, and never half written."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from avatar.demo import make_subject, render_frame, subject
from avatar.demo.identity import sample_identity
from avatar.demo.occlusion import neutral_params
from avatar.demo.performance import frame_camera, frame_params, perform
from avatar.demo.render import RenderedFrame
from avatar.demo.scene import EYE_LEFT, EYE_RIGHT, FRAME, MOUTH_UPPER, Performer
from avatar.errors import UserError
from avatar.head.assets import load_head_assets
from avatar.head.model import HeadModel, matrix_from_6d
from avatar.head.rasterize import rasterize_mesh
from avatar.types import IDENTITY_6D, Camera, HeadParams

FRAMES, SIZE = 5, 96
SEED_WITH_GLASSES, SEED_WITHOUT = 1, 3


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("demo") / "someone"
    return make_subject(out, frames=FRAMES, size=SIZE, seed=SEED_WITH_GLASSES)


def test_a_frame_is_written_under_a_name_that_is_not_utf8(tmp_path: Path) -> None:
    path = tmp_path / os.fsdecode(b"Zo\xeb.png")
    subject.write_image(path, np.zeros((4, 4, 3), np.uint8), [])
    assert path.read_bytes().startswith(b"\x89PNG")


def _tracked(folder: Path, index: int) -> tuple[HeadParams, Camera, np.ndarray]:
    data = torch.load(folder / "checkpoint" / f"{index:05d}.frame", weights_only=False)
    flame, opencv = data["flame"], data["opencv"]
    width, height = (int(n) for n in data["img_size"])
    K = opencv["K"][0]
    camera = Camera(
        torch.from_numpy(opencv["R"][0]),
        torch.from_numpy(opencv["t"][0]),
        *[float(v) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2])],
        width=width,
        height=height,
    )
    values = [torch.from_numpy(flame[key][0]) for key in ("exp", "jaw", "eyes", "eyelids")]
    return HeadParams(*values, neck=torch.tensor(IDENTITY_6D)), camera, flame["shape"][0]


def test_folder_has_the_layout_of_a_tracked_video(folder: Path) -> None:
    numbers = [f"{k:05d}" for k in range(1, FRAMES + 1)]
    assert sorted(p.name for p in folder.iterdir()) == ["alpha", "checkpoint", "head_model", "imgs", "parsing"]
    assert sorted(p.name for p in (folder / "imgs").iterdir()) == [f"{n}.jpg" for n in numbers]
    assert sorted(p.name for p in (folder / "alpha").iterdir()) == [f"{n}.jpg" for n in numbers]
    masks = [f"{n}_{kind}.png" for n in numbers for kind in ("mouth", "neckhead")]
    assert sorted(p.name for p in (folder / "parsing").iterdir()) == masks
    assert sorted(p.name for p in (folder / "checkpoint").iterdir()) == [f"{k:05d}.frame" for k in range(FRAMES)]
    assert {p.name for p in (folder / "head_model").iterdir()} == {
        "expression_names.json",
        "generic_model.pkl",
        "head_template.obj",
        "l_eyelid.npy",
        "r_eyelid.npy",
        "FLAME_masks.pkl",
    }
    image = cv2.imread(str(folder / "imgs" / "00001.jpg"), cv2.IMREAD_UNCHANGED)
    assert image.shape == (SIZE, SIZE, 3)
    for name in ("neckhead", "mouth"):
        mask = cv2.imread(str(folder / "parsing" / f"00001_{name}.png"), cv2.IMREAD_UNCHANGED)
        assert mask.shape == (SIZE, SIZE) and set(np.unique(mask)) == {0, 255}


def test_tracking_file_holds_the_reference_fields(folder: Path) -> None:
    data = torch.load(folder / "checkpoint" / "00002.frame", weights_only=False)
    shapes = {key: value.shape for key, value in data["flame"].items()}
    assert shapes == {
        "exp": (1, 100),
        "shape": (1, 300),
        "tex": (1, 140),
        "sh": (1, 9, 3),
        "eyes": (1, 12),
        "eyelids": (1, 2),
        "jaw": (1, 6),
    }
    assert {key: value.shape for key, value in data["opencv"].items()} == {"R": (1, 3, 3), "t": (1, 3), "K": (1, 3, 3)}
    assert data["img_size"].tolist() == [SIZE, SIZE] and data["frame_id"] == "00002" and data["global_step"] == 0
    R = data["opencv"]["R"][0]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-5)
    for six in (data["flame"]["jaw"][0], *data["flame"]["eyes"].reshape(2, 6)):
        rows = matrix_from_6d(torch.from_numpy(six))[:2].reshape(-1)
        torch.testing.assert_close(rows, torch.from_numpy(six), atol=1e-6, rtol=0)


def test_written_tracking_reproduces_the_rendered_silhouette(folder: Path) -> None:
    """The mesh of the written files, posed and projected, against the head mask; hair and glasses stand outside it."""
    assets = load_head_assets(folder / "head_model")
    below_hair = np.ones((SIZE, SIZE), bool)
    for index in range(FRAMES):
        params, camera, shape = _tracked(folder, index)
        model = HeadModel(assets, torch.from_numpy(shape))
        screen = camera.project(model.vertices(params)).numpy()
        projected = rasterize_mesh(screen, assets.faces.numpy(), SIZE, SIZE).face_id >= 0
        name = f"{index + 1:05d}"
        head = cv2.imread(str(folder / "parsing" / f"{name}_neckhead.png"), cv2.IMREAD_UNCHANGED) > 127
        alpha = cv2.imread(str(folder / "alpha" / f"{name}.jpg"), cv2.IMREAD_UNCHANGED) > 127
        overlap = (head & projected).sum() / (head | projected).sum()
        assert overlap > 0.8  # this person's hair is 2 cm high, an eighth of the mask
        # One pixel in from its edge, where a JPEG blurs it, the mesh is in the matte everywhere.
        inner = cv2.erode(projected.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        assert (alpha | ~inner).all()
        # From the brows down to the chin there is no hair: there they agree.
        face = screen[assets.regions["face"].numpy()]
        below_hair[:] = False
        below_hair[int(np.median(face[:, 1])) : int(face[:, 1].max())] = True
        cheeks = ((head & projected) & below_hair).sum() / ((head | projected) & below_hair).sum()
        assert cheeks > 0.95


def test_mouth_mask_lies_where_the_tracked_lips_are(folder: Path) -> None:
    assets = load_head_assets(folder / "head_model")
    params, camera, shape = _tracked(folder, 0)
    lips = camera.project(HeadModel(assets, torch.from_numpy(shape)).vertices(params))[assets.regions["lips"]]
    mask = cv2.imread(str(folder / "parsing" / "00001_mouth.png"), cv2.IMREAD_UNCHANGED) > 127
    rows, columns = np.nonzero(mask)
    assert abs(columns.mean() - float(lips[:, 0].mean())) < 0.02 * SIZE
    assert rows.min() > float(lips[:, 1].min()) - 2 and rows.max() < float(lips[:, 1].max()) + 2


def test_same_arguments_same_files_and_threads_do_not_matter(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(subject, "processor_count", lambda: 3)
    again = make_subject(tmp_path / "again", frames=FRAMES, size=SIZE, seed=SEED_WITH_GLASSES)
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.suffix in (".jpg", ".png", ".obj", ".npy", ".pkl"):
            assert path.read_bytes() == (again / path.relative_to(folder)).read_bytes(), path.name
    for index in range(FRAMES):
        first, second = _tracked(folder, index), _tracked(again, index)
        torch.testing.assert_close(first[0].condition(), second[0].condition(), atol=0, rtol=0)


def test_another_seed_is_another_person() -> None:
    camera = frame_camera(perform(0, 1, "speech"), 0, SIZE)
    one, other = (render_frame(seed, neutral_params(), camera) for seed in (SEED_WITH_GLASSES, SEED_WITHOUT))
    differing = np.abs(one.image.astype(int) - other.image.astype(int)).max(-1)[one.head > 127]
    assert (differing > 24).mean() > 0.5
    a, b = sample_identity(SEED_WITH_GLASSES), sample_identity(SEED_WITHOUT)
    assert np.abs(a.shape - b.shape).max() > 0.5


def test_glasses_and_teeth_are_in_the_picture_only() -> None:
    """They belong to the renderer's scene, change the picture, and are no part of the tracked mesh."""
    performer = Performer(sample_identity(SEED_WITH_GLASSES))
    tracked = len(performer.head.template)
    for material in (FRAME, MOUTH_UPPER):
        corners = performer.faces[performer.materials == material]
        assert len(corners) > 100 and corners.min() >= tracked
    assert sample_identity(SEED_WITH_GLASSES).glasses and not sample_identity(SEED_WITHOUT).glasses
    # The frame stands before the eyes by more than a centimetre: nothing of the tracked mesh is there.
    geometry = performer.pose(neutral_params(), np.eye(3, dtype=np.float32))
    eyes = geometry.points[np.concatenate(performer.head.mesh.eyeballs)]
    rim = geometry.points[performer.starts[FRAME] :][: len(performer.props[FRAME].points)]
    before = rim[(rim[:, 2] > eyes[:, 2].max() + 0.01) & (np.abs(rim[:, 0]) > 0.02)]
    skin = geometry.points[:tracked]
    assert len(before) > 100
    assert np.linalg.norm(before[:, None] - skin[None], axis=-1).min(1).max() > 0.006


def _mouth_and_eyes(params: HeadParams) -> RenderedFrame:
    camera = frame_camera(perform(0, 1, "speech"), 0, 128)
    return render_frame(SEED_WITHOUT, params, camera)


def test_mouth_area_grows_with_the_jaw_and_shows_teeth() -> None:
    closed = _mouth_and_eyes(neutral_params())
    angle = 0.25
    jaw = torch.tensor([1.0, 0.0, 0.0, 0.0, np.cos(angle), -np.sin(angle)], dtype=torch.float32)
    opened = _mouth_and_eyes(replace(neutral_params(), jaw=jaw))
    assert opened.mouth.astype(int).sum() > 1.6 * closed.mouth.astype(int).sum()
    inside = opened.image[opened.mouth > 250].mean(-1)
    assert inside.min() < 60, "no dark mouth cavity"
    assert inside.max() > 130, "no teeth"


def test_blink_hides_the_eyes() -> None:
    camera = frame_camera(perform(0, 1, "speech"), 0, 512)
    performer = Performer(sample_identity(SEED_WITHOUT))

    def eye_pixels(closed: float) -> int:
        params = replace(neutral_params(), eyelids=torch.full((2,), closed))
        points = torch.from_numpy(performer.pose(params, np.eye(3, dtype=np.float32)).points)
        raster = rasterize_mesh(camera.project(points).numpy(), performer.faces, camera.height, camera.width)
        seen = performer.materials[raster.face_id[raster.face_id >= 0]]
        return int(np.isin(seen, (EYE_LEFT, EYE_RIGHT)).sum())

    assert eye_pixels(0.0) > 400
    assert eye_pixels(1.0) <= 0.02 * eye_pixels(0.0)


def test_turning_the_head_changes_its_shading_under_fixed_lights() -> None:
    performance = perform(0, 2, "turn")
    means = []
    for yaw in (-0.5, 0.5):
        turned = performance._replace(head=np.array([[yaw, 0.0, 0.0], [yaw, 0.0, 0.0]]))
        picture = render_frame(SEED_WITHOUT, frame_params(turned, 0), frame_camera(turned, 0, SIZE))
        means.append(picture.image[picture.head > 250].mean(0))
    assert np.abs(means[0] - means[1]).max() > 4.0


def test_picture_scales_with_the_size() -> None:
    small = render_frame(SEED_WITHOUT, neutral_params(), frame_camera(perform(0, 1, "speech"), 0, 64))
    large = render_frame(SEED_WITHOUT, neutral_params(), frame_camera(perform(0, 1, "speech"), 0, 256))
    shrunk = cv2.resize(large.image, (64, 64), interpolation=cv2.INTER_AREA)
    assert np.abs(shrunk.astype(int) - small.image.astype(int)).mean() < 2.0
    for mask in ("alpha", "head", "mouth"):
        assert abs(getattr(large, mask).mean() - getattr(small, mask).mean()) < 0.002 * 255


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"frames": 0}, "frames must be from 1 to 100000, not 0"),
        ({"frames": 2.5}, "frames must be a whole number, not 2.5"),
        ({"size": 32}, "size must be from 64 to 1024, not 32"),
        ({"size": 4096}, "size must be from 64 to 1024, not 4096"),
        ({"seed": -1}, "seed must be from 0 to 4294967295, not -1"),
        ({"motion": "dance"}, "motion must be one of speech, turn, gaze, not 'dance'"),
    ],
)
def test_values_out_of_range_are_said_before_anything_is_written(tmp_path: Path, arguments: dict, says: str) -> None:
    with pytest.raises(UserError, match=says):
        make_subject(tmp_path / "out", **arguments)
    assert not list(tmp_path.iterdir())


def test_a_folder_in_use_is_left_alone(tmp_path: Path) -> None:
    used = tmp_path / "used"
    used.mkdir()
    (used / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match="is not empty; choose another --out"):
        make_subject(used, frames=1, size=64)
    with pytest.raises(UserError, match="is not a folder"):
        make_subject(used / "notes.txt", frames=1, size=64)
    assert [p.name for p in used.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError(28, "No space left on device")])
def test_an_interrupted_run_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error) -> None:
    write_frame = subject._write_frame

    def stop_at_the_third(folder: Path, index: int, *rest) -> None:
        if index == 2:
            raise error
        write_frame(folder, index, *rest)

    monkeypatch.setattr(subject, "_write_frame", stop_at_the_third)
    expected = UserError if isinstance(error, OSError) else KeyboardInterrupt
    with pytest.raises(
        expected, match=r"No space left on device\); nothing was left" if expected is UserError else None
    ):
        make_subject(tmp_path / "out", frames=4, size=64, seed=SEED_WITHOUT)
    assert not list(tmp_path.iterdir())
