"""A prepared subject on disk: what is refused, and what frames look like."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from tracked_folder import write_tracked_folder

from avatar.data.source import Source
from avatar.data.subject import FramePixels, Subject
from avatar.errors import UserError
from avatar.head.assets import load_head_assets
from data_prep.prepare.prepare import prepare


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("prepared")
    folder = write_tracked_folder(root / "someone", frames=10, size=64, height=48, suffix=".png")
    head_path = folder / "head_model"
    return prepare(Source(folder, head_path, frame_offset=1), load_head_assets(head_path), out=root / "out", say=str)


@pytest.fixture
def broken(prepared: Path, tmp_path: Path) -> Path:
    """A copy of subject and prepared folder to break."""
    shutil.copytree(prepared.parent, tmp_path / "copy")
    edit_manifest(tmp_path / "copy" / "out", source=str(tmp_path / "copy" / "someone"))
    return tmp_path / "copy" / "out"


def edit_manifest(folder: Path, **changes: Any) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    for name, value in changes.items():
        if value is None:
            del manifest[name]
        else:
            manifest[name] = value(manifest[name]) if callable(value) else value
    (folder / "manifest.json").write_text(json.dumps(manifest))


def edit_tracks(folder: Path, **changes: Callable[[torch.Tensor], torch.Tensor | None]) -> None:
    tracks = load_file(folder / "tracks.safetensors")
    for name, change in changes.items():
        changed = change(tracks.pop(name))
        if changed is not None:
            tracks[name] = changed.contiguous()
    save_file(tracks, folder / "tracks.safetensors")


def frame_path(path: object) -> Callable[[list], list]:
    return lambda frames: [frames[0] | {"image": path}, *frames[1:]]


CASES: dict[str, tuple[Callable[[Path], object], str]] = {
    "not a prepared subject": (
        lambda f: (f / "manifest.json").unlink(),
        r"is not a prepared subject: it has no manifest",
    ),
    "folder missing": (shutil.rmtree, r"out is not a prepared subject: it has no manifest\.json"),
    "manifest cut short": (
        lambda f: (f / "manifest.json").write_text((f / "manifest.json").read_text()[:500]),
        r"manifest\.json cannot be read as JSON \(.*\); prepare the subject again",
    ),
    "manifest binary": (
        lambda f: (f / "manifest.json").write_bytes(b"\xff\x00" * 40),
        r"manifest\.json cannot be read",
    ),
    "manifest nested": (lambda f: (f / "manifest.json").write_text("[" * 100_000), r"manifest\.json cannot be read"),
    "manifest a list": (lambda f: (f / "manifest.json").write_text("[1]"), r"has manifest version None"),
    "another version": (
        lambda f: edit_manifest(f, version=99),
        r"version 99, and this program reads 9; prepare it again",
    ),
    "a key missing": (lambda f: edit_manifest(f, width=None), r"damaged \(width is missing\)"),
    "a wrong type": (lambda f: edit_manifest(f, width="64"), r"damaged \(width is not a whole number\)"),
    "a size of zero": (lambda f: edit_manifest(f, width=0), r"an image size of 0x48 is impossible"),
    "no focal length": (lambda f: edit_manifest(f, intrinsics=[0, 1, 2, 3]), r"focal lengths must be positive"),
    "three intrinsics": (lambda f: edit_manifest(f, intrinsics=[1, 2, 3]), r"intrinsics has 3 values, not 4"),
    "not finite": (lambda f: edit_manifest(f, fps=float("nan")), r"fps is not a finite number"),
    "a path upwards": (
        lambda f: edit_manifest(f, frames=frame_path("../../etc/passwd")),
        r"leaves the subject's folder",
    ),
    "an absolute path": (lambda f: edit_manifest(f, frames=frame_path("/etc/passwd")), r"leaves the subject's folder"),
    "a drive": (lambda f: edit_manifest(f, frames=frame_path("C:\\x\\y.jpg")), r"leaves the subject's folder"),
    "an upwards path, Windows": (
        lambda f: edit_manifest(f, frames=frame_path("..\\y.jpg")),
        r"leaves the subject's folder",
    ),
    "an empty path": (lambda f: edit_manifest(f, frames=frame_path("")), r"leaves the subject's folder"),
    "a path that is a number": (lambda f: edit_manifest(f, frames=frame_path(3)), r"frames\[0\]\.image is not text"),
    "no frames": (
        lambda f: edit_manifest(f, frames=[]),
        r"train is empty or names frames outside the 0 of the subject",
    ),
    "no training frames": (lambda f: edit_manifest(f, train=[]), r"train is empty or names frames outside"),
    "a frame outside": (lambda f: edit_manifest(f, test=[10]), r"test is empty or names frames outside the 10"),
    "a frame in both": (lambda f: edit_manifest(f, test=[0, 1]), r"a frame is in both train and test"),
    "tracks missing": (lambda f: (f / "tracks.safetensors").unlink(), r"tracks\.safetensors does not exist; prepare"),
    "tracks cut short": (
        lambda f: (f / "tracks.safetensors").write_bytes((f / "tracks.safetensors").read_bytes()[:-9]),
        r"tracks\.safetensors is damaged",
    ),
    "tracks of another kind": (
        lambda f: edit_tracks(f, jaw=lambda _: None),
        r"tracks\.safetensors is damaged \(it lacks jaw\)",
    ),
    "tracks too short": (lambda f: edit_tracks(f, jaw=lambda t: t[:5]), r"N = "),
    "tracks of the wrong width": (lambda f: edit_tracks(f, eyes=lambda t: t[:, :6]), r"eyes must have shape \[N, 12\]"),
    "tracks not finite": (lambda f: edit_tracks(f, t=lambda t: t / 0), r"t has 30 non-finite of 30 values"),
    "fewer frames than tracks": (
        lambda f: edit_manifest(f, frames=lambda frames: frames[:9], train=[0], test=[1]),
        r"tracks\.safetensors is damaged \(it has 10 frames where 9 are listed\)",
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_a_damaged_subject_is_refused(name: str, broken: Path) -> None:
    damage, sentence = CASES[name]
    assert len(Subject.open(broken)) == 10
    damage(broken)
    with pytest.raises(UserError, match=sentence):
        Subject.open(broken)


IMAGE_CASES: dict[str, tuple[Callable[[Path], object], str]] = {
    "image gone": (lambda s: (s / "imgs/00003.png").unlink(), r"imgs/00003\.png does not exist"),
    "mask gone": (lambda s: (s / "parsing/00003_mouth.png").unlink(), r"00003_mouth\.png does not exist"),
    "source gone": (shutil.rmtree, r"the subject's frames are gone: .*someone does not exist; prepare"),
    "image damaged": (lambda s: (s / "imgs/00003.png").write_bytes(b"?"), r"imgs/00003\.png is neither a JPEG nor"),
    "image of another size": (
        lambda s: cv2.imwrite(str(s / "imgs/00003.png"), np.zeros((8, 9, 3), np.uint8)),
        r"imgs/00003\.png is 9x8 pixels, but the subject was prepared at 64x48; prepare it again",
    ),
}


@pytest.mark.parametrize("name", IMAGE_CASES)
def test_images_that_change_after_preparation(name: str, broken: Path) -> None:
    damage, sentence = IMAGE_CASES[name]
    subject = Subject.open(broken)
    damage(Path(subject.manifest.source))
    with pytest.raises(UserError, match=sentence):
        subject.frame(2)


@pytest.mark.parametrize("source", ["/" + "so/" * 2000, "/" + 300 * "a", "~\0~"], ids=["a path", "a name", "no name"])
def test_a_source_that_no_system_could_hold_is_a_source_that_is_gone(source: str, broken: Path) -> None:
    edit_manifest(broken, source=source)
    with pytest.raises(UserError, match=r"the subject's frames are gone: \S+ does not exist; prepare") as refused:
        Subject.open(broken).frame(2)
    assert len(str(refused.value)) < 1200


def test_frames_at_their_own_size(prepared: Path) -> None:
    subject = Subject.open(prepared)
    frame = subject.frame(4)
    source = cv2.imread(str(Path(subject.manifest.source) / "imgs" / "00005.png"))
    assert source is not None
    assert (frame.index, frame.name) == (4, "00005")
    torch.testing.assert_close(frame.image, torch.from_numpy(source[..., ::-1] / 255.0).float(), atol=1e-7, rtol=0)
    assert frame.image.dtype == torch.float32 and frame.image.shape == (48, 64, 3)
    assert frame.alpha.shape == frame.head_mask.shape == frame.mouth_mask.shape == (48, 64)
    assert (frame.camera.width, frame.camera.height) == (64, 48)


def test_resized_frames_average_and_keep_the_view(prepared: Path) -> None:
    subject = Subject.open(prepared)
    full, half = subject.frame(4), subject.frame(4, size=32)
    white = torch.ones(3)
    expected = full.composite(white).reshape(24, 2, 32, 2, 3).mean((1, 3))
    torch.testing.assert_close(half.composite(white), expected, atol=1.01 / 255, rtol=0)
    assert half.mouth_mask.shape == (24, 32) and 0 <= half.mouth_mask.min() <= half.mouth_mask.max() <= 1
    point = torch.tensor([0.01, -0.02, 0.05])
    full_xy, half_xy = full.camera.project(point)[:2], half.camera.project(point)[:2]
    torch.testing.assert_close(full_xy / 2, half_xy)


@pytest.mark.parametrize("size", [(32, 24), (50, 38), (9, 7)])
@pytest.mark.parametrize("background", [(1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (0.2, 0.5, 0.8)])
def test_the_composite_of_resized_frames_is_the_resized_composite(
    prepared: Path, size: tuple[int, int], background: tuple[float, float, float]
) -> None:
    rng = np.random.default_rng(0)
    noise = [cv2.GaussianBlur(rng.random((48, 64), np.float32) - 0.5, (0, 0), 2) * 20 for _ in range(2)]
    alpha, head = (np.rint(255 * np.clip(each + 0.5, 0, 1)).astype(np.uint8) for each in noise)
    assert 0 in alpha and 255 in alpha and 0 in head and 255 in head  # the outlines of both cross
    pixels = FramePixels(rng.integers(0, 256, (48, 64, 3), np.uint8), alpha, head, alpha)
    subject, over = Subject.open(prepared), torch.tensor(background)

    small = pixels.resized(size)
    assert [(plane.shape[:2], plane.dtype) for plane in small] == 4 * [(size[::-1], np.uint8)]
    full = subject.assemble(0, pixels).composite(over).numpy()
    expected = torch.from_numpy(cv2.resize(full, size, interpolation=cv2.INTER_AREA))
    composite = subject.assemble(0, small, size[0]).composite(over)
    torch.testing.assert_close(composite, expected, atol=1.01 / 255, rtol=0)  # image and alpha are rounded
    np.testing.assert_array_equal(small.head_mask, cv2.resize(head, size, interpolation=cv2.INTER_AREA))


def test_resized_frames_without_an_outline_are_averaged_as_they_are() -> None:
    rng = np.random.default_rng(1)
    image, alpha, mouth = (rng.integers(0, 256, shape, np.uint8) for shape in ((48, 64, 3), (48, 64), (48, 64)))
    for matte, mask in ((np.full_like(alpha, 255), np.full_like(alpha, 255)), (alpha, np.zeros_like(alpha))):
        pixels = FramePixels(image, matte, mask, mouth)
        for ours, plane in zip(pixels.resized((32, 24)), pixels, strict=True):
            np.testing.assert_array_equal(ours, cv2.resize(plane, (32, 24), interpolation=cv2.INTER_AREA))


@pytest.mark.parametrize("index", [-1, 10])
def test_frames_outside(index: int, prepared: Path) -> None:
    subject = Subject.open(prepared)
    for ask in (subject.frame, subject.camera, subject.params):
        with pytest.raises(IndexError, match=f"frame {index} of subject someone, which has frames 0 to 9"):
            ask(index)
    with pytest.raises(ValueError, match="size must be at least 1 pixel.* got 0"):
        subject.frame(0, size=0)
