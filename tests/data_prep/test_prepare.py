"""A tracked folder becomes a prepared subject: what it holds, what is left out, and when it is made again."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from preparing import edit, prepare_folder
from tracked_folder import write_tracked_folder

from avatar.data.read_image import read_mask
from avatar.data.source import Source
from avatar.data.subject import Subject
from avatar.head.assets import load_head_assets
from avatar.head.model import HeadModel
from avatar.head.rasterize import rasterize_mesh
from data_prep.prepare.prepare import prepare
from data_prep.prepare.projection import filled_lips


def test_the_prepared_head_lies_on_the_masks(tmp_path: Path) -> None:
    """Every convention at once: pairing, cameras, 6D rotations, sizes. The renderer of the fixture is the witness."""
    folder = write_tracked_folder(tmp_path / "subject", frames=8, size=80, height=64, offset=2)
    subject, said = prepare_folder(folder, tmp_path / "out", frame_offset=2)
    assert said[0] == "format: metrical-tracker"
    assert said[1].startswith("image offset 2, given with --frame-offset: head overlap 1.000, lips overlap 1.000")
    head = HeadModel(load_head_assets(folder / "head_model"), subject.identity)
    for index in range(len(subject)):
        for size in (None, 40):
            frame = subject.frame(index, size)
            screen = frame.camera.project(head.vertices(frame.params)).numpy()
            height, width = frame.head_mask.shape
            assert (
                (width, height) == ((80, 64) if size is None else (40, 32)) == (frame.camera.width, frame.camera.height)
            )
            mesh = rasterize_mesh(screen, head.faces.numpy(), height, width).face_id >= 0
            agreement = np.mean(mesh == (frame.head_mask.numpy() > 0.5))
            assert agreement > (0.9995 if size is None else 0.98)


def test_manifest_and_tracks(tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "someone", frames=15, offset=1, suffix=".png")
    subject, said = prepare_folder(folder, tmp_path / "out")
    manifest = subject.manifest
    assert (manifest.name, manifest.fps, manifest.width, manifest.height) == ("someone", 25.0, 64, 64)
    assert manifest.frame_offset == 1 and manifest.offset_evidence == said[1]
    assert [(f.name, f.tracking) for f in manifest.frames] == [(f"{n + 1:05d}", n) for n in range(15)]
    assert manifest.frames[3].image == "imgs/00004.png" and manifest.frames[3].mouth_mask == "parsing/00004_mouth.png"
    assert subject.split == (tuple(range(12)), tuple(range(12, 15)))
    assert manifest.notes == () and manifest.left_out == {}
    track = torch.load(folder / "checkpoint" / "00006.frame", weights_only=False)
    params, camera = subject.params(6), subject.camera(6)
    for read, written in (
        (params.expression, track["flame"]["exp"]),
        (params.jaw, track["flame"]["jaw"]),
        (params.eyes, track["flame"]["eyes"]),
        (params.eyelids, track["flame"]["eyelids"]),
        (camera.t_cam_world, track["opencv"]["t"]),
        (subject.identity, track["flame"]["shape"]),
    ):
        np.testing.assert_array_equal(read.numpy(), written[0])
    np.testing.assert_allclose(camera.R_cam_world.numpy(), track["opencv"]["R"][0], atol=1e-6)
    assert params.neck.tolist() == [1, 0, 0, 0, 1, 0]
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == tuple(track["opencv"]["K"][0][[0, 1, 0, 1], [0, 1, 2, 2]])


def test_images_come_back_red_first(tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", frames=4, suffix=".png")
    subject, _ = prepare_folder(folder, tmp_path / "out", frame_offset=1)
    frame = subject.frame(0)
    lips = frame.image[frame.mouth_mask > 0]
    assert len(lips) > 5 and (lips[:, 0] > 1.5 * lips[:, 1]).all()
    assert frame.image[0, 0].tolist() == pytest.approx([90 / 255, 110 / 255, 130 / 255])


def test_a_slightly_inexact_rotation_is_made_orthonormal(tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", frames=24)
    for file in (folder / "checkpoint").iterdir():
        edit(file, "opencv", R=torch.load(file, weights_only=False)["opencv"]["R"] * 1.004)
    subject, _ = prepare_folder(folder, tmp_path / "out")
    R = subject.recording.tracks["R"]
    torch.testing.assert_close(R @ R.mT, torch.eye(3).expand_as(R), atol=1e-6, rtol=0)


def test_missing_masks_are_derived_or_assumed_and_said(tmp_path: Path) -> None:
    with_mouth = write_tracked_folder(tmp_path / "a" / "subject", frames=24)
    without = write_tracked_folder(tmp_path / "b" / "subject", frames=24, alpha=False, mouth_masks=False)
    subject, said = prepare_folder(without, tmp_path / "out")
    assert "note: there is no alpha/: the whole image is taken as foreground" in said
    assert "note: there are no parsing/*_mouth.png: masks of the projected lips are made" in said
    assert subject.manifest.mouth_masks == "derived"
    overlaps = []
    for index in range(24):
        frame = subject.frame(index)
        assert frame.alpha.min() == 1
        derived = frame.mouth_mask.numpy() > 0.5
        seen = read_mask(with_mouth / "parsing" / f"{frame.name}_mouth.png") > 0
        overlaps.append((derived & seen).sum() / (derived | seen).sum())
    assert np.mean(overlaps) > 0.95


def test_the_inner_mouth_belongs_to_a_derived_mask() -> None:
    """Open lips are a ring; teeth and tongue inside it need the mouth weight most."""
    angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    ring = np.stack((np.cos(angle), np.sin(angle)), 1)
    screen = np.concatenate((20 * ring, 12 * ring)) + 32
    screen = np.concatenate((screen, np.ones((32, 1))), 1).astype(np.float32)
    i = np.arange(16)
    j = (i + 1) % 16
    faces = np.concatenate((np.stack((i, j, i + 16), 1), np.stack((j, j + 16, i + 16), 1)))
    mask = filled_lips(screen, faces, 64, 64)
    assert mask[32, 32] == 1 and mask[32, 32 + 15] == 1 and mask[32, 32 + 22] == 0
    beside = screen + np.float32([64, 0, 0])
    both = filled_lips(np.concatenate((screen, beside)), np.concatenate((faces, faces + len(screen))), 128, 64)
    assert np.array_equal(both, np.concatenate((mask, mask), axis=1))


def test_without_head_masks_the_matte_is_the_head(tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", frames=24, head_masks=False)
    subject, said = prepare_folder(folder, tmp_path / "out")
    assert "note: there are no parsing/*_neckhead.png: the foreground matte is taken as the head" in said
    frame = subject.frame(5)
    assert torch.equal(frame.head_mask, (frame.alpha >= 10 / 255).float()) and 0.05 < frame.alpha.mean() < 0.6
    weight = frame.alpha * frame.head_mask
    assert float((weight - frame.alpha).abs().max()) < 10 / 255, "the matte counts once, not squared"


@pytest.mark.parametrize(
    ("colour", "noticed"), [((255, 255, 255), True), ((255, 252, 250), True), ((252, 250, 248), False)]
)
def test_images_that_were_composited_before_are_noticed(
    colour: tuple[int, int, int], noticed: bool, tmp_path: Path
) -> None:
    folder = write_tracked_folder(tmp_path / "subject", frames=24, suffix=".png")
    for path in (folder / "imgs").iterdir():
        image = cv2.imread(str(path))
        assert image is not None
        image[read_mask(folder / "alpha" / path.name) == 0] = colour
        cv2.imwrite(str(path), image)
    _, said = prepare_folder(folder, tmp_path / "out")
    assert any(s.startswith("note: the images seem to be composited on white already: ") for s in said) == noticed


def test_numbers_are_ordered_as_numbers(tmp_path: Path) -> None:
    """1.jpg ... 12.JPG without padding, as some extraction tools write them."""
    folder = write_tracked_folder(tmp_path / "subject", frames=12)
    for path in [*(folder / "imgs").iterdir(), *(folder / "parsing").iterdir(), *(folder / "alpha").iterdir()]:
        path.rename(path.with_name(path.name.lstrip("0").replace(".jpg", ".JPG")))
    for path in (folder / "checkpoint").iterdir():
        path.rename(path.with_name(f"{int(path.stem)}.frame"))
    subject, _ = prepare_folder(folder, tmp_path / "out")
    assert [f.name for f in subject.manifest.frames] == [str(n) for n in range(1, 13)]


def test_short_expressions_are_padded(tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", frames=12)
    for file in (folder / "checkpoint").iterdir():
        edit(file, "flame", exp=torch.load(file, weights_only=False)["flame"]["exp"][:, :6])
    subject, said = prepare_folder(folder, tmp_path / "out", frame_offset=1)
    assert "note: the tracking has 6 expression coefficients, the head model 10; the missing ones are zero" in said
    assert subject.params(0).expression.shape == (10,) and not subject.params(0).expression[6:].any()


def test_tracking_in_another_folder(tmp_path: Path) -> None:
    folder = write_tracked_folder(tmp_path / "subject", frames=12)
    (tmp_path / "tracker").mkdir()
    (folder / "checkpoint").rename(tmp_path / "tracker" / "checkpoint")
    for tracking in (tmp_path / "tracker", tmp_path / "tracker" / "checkpoint"):
        subject, _ = prepare_folder(folder, tmp_path / "out", tracking=tracking)
        assert len(subject) == 12


@pytest.mark.slow
@pytest.mark.shared
@pytest.mark.parametrize(("name", "count"), [("anna", 1000), ("carla", 400)])
def test_development_subjects(name: str, count: int, shared_dir: Path, tmp_path: Path) -> None:
    said: list[str] = []
    head_path = shared_dir / "subjects" / "head_model"
    source = Source(shared_dir / "subjects" / name, head_path)
    prepared = prepare(source, load_head_assets(head_path), out=tmp_path / "out", say=said.append)
    subject = Subject.open(prepared)
    assert len(subject) == count and subject.manifest.frame_offset == 1
    assert len(subject.split.test) == count // 5 and subject.manifest.notes == ()
    assert said[1].startswith("image offset 1 ") and len(said) == 3
