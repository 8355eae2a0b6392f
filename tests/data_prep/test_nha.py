"""Persons of NHA's data set: where the head lies, its joints near their limits, what is held out, and what is refused."""

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
from nha_folder import (
    BODY,
    CLOTH,
    CY_FROM_BOTTOM,
    DEGREES,
    EYES,
    FRAMES,
    JAW,
    LIP,
    NECK,
    SIZE,
    SKIN,
    edit_tracking,
    identity_of,
    true_rows,
    true_screen,
    turn,
    write_nha,
)
from preparing import prepare_folder

from avatar.data.subject import Subject
from avatar.errors import UserError, refuse
from avatar.head.assets import load_head_assets
from avatar.head.model import HeadModel
from data_prep.check.folder import check_tracked_folder
from data_prep.formats.detect import open_tracked_folder
from data_prep.formats.frame_track import FrameTrack, fit_coefficients
from data_prep.prepare.projection import project_head
from data_prep.prepare.wrong_inputs import check_folder

NPZ = "tracked_flame_params_0.npz"
TRAINED = FRAMES - FRAMES // 4


@pytest.fixture(scope="module")
def person(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_nha(tmp_path_factory.mktemp("nha") / "person_0000")


@pytest.fixture(scope="module")
def prepared(person: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Subject, list[str]]:
    return prepare_folder(person, tmp_path_factory.mktemp("out") / "out")


@pytest.fixture
def copy(person: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(person, tmp_path / "person_0000"))


def tracked(folder: Path, size: tuple[int, int] = SIZE) -> dict[int, FrameTrack]:
    assets = load_head_assets(folder / "head_model")
    return fit_coefficients(open_tracked_folder(folder).read(assets, size, refuse), assets).frames


@pytest.mark.parametrize("size", [SIZE, (SIZE[1], SIZE[0])])
def test_every_vertex_of_head_and_torso_is_at_its_pixel(size: tuple[int, int], tmp_path: Path) -> None:
    """The focal length is in units of the longer side, the width or the height."""
    folder = write_nha(tmp_path / "person", 6, size)
    assets = load_head_assets(folder / "head_model")
    head = HeadModel(assets, torch.from_numpy(identity_of()).float())
    for track, row in zip(tracked(folder, size).values(), true_rows(6), strict=True):
        screen, truth = (
            project_head(head, track, track.intrinsics, *size),
            true_screen(assets, identity_of(), row, size),
        )
        np.testing.assert_allclose(screen[:, :2], truth[:, :2], atol=1e-3)
        np.testing.assert_allclose(screen[:, 2], truth[:, 2], atol=1e-5)


def test_the_head_lies_on_its_masks(prepared: tuple[Subject, list[str]]) -> None:
    subject, said = prepared
    assert said[0] == "format: NHA" and subject.manifest.format == "NHA"
    assert said[1].startswith(f"images and tracking are paired by the frame numbers in {NPZ}: head overlap 1.000")
    assert subject.manifest.frames[3].name == "frame_0003_image_0000"
    np.testing.assert_allclose(subject.camera(0).cy, SIZE[1] * (1 - CY_FROM_BOTTOM), atol=1e-5)


@pytest.mark.parametrize(
    ("name", "frame", "angles"),
    [
        ("neck", 0, NECK * [1, 0, 0]),
        ("neck", 1, NECK * [0, 1, 0]),
        ("neck", 3, NECK * [0, 0, 1]),
        ("jaw", 2, JAW),
        ("eyes", 1, EYES),
    ],
)
def test_joints_near_their_limits_keep_their_angles(name: str, frame: int, angles: np.ndarray, person: Path) -> None:
    rows = getattr(tracked(person)[frame], name).reshape(-1, 2, 3)
    np.testing.assert_allclose(rows, [turn(vector)[:2] for vector in angles.reshape(-1, 3)], atol=1e-5)


@pytest.mark.parametrize(("stored", "end"), [(-40.0, 0), (40.0, 1)])
def test_no_joint_goes_beyond_its_limits(stored: float, end: int, copy: Path) -> None:
    edit_tracking(copy, lambda values: [values[name].__setitem__(slice(None), stored) for name in DEGREES])
    track = tracked(copy)[5]
    for name in DEGREES:
        limits = np.radians(DEGREES[name])[:, end].reshape(-1, 3)
        rows = getattr(track, name.removesuffix("_pose")).reshape(-1, 2, 3)
        np.testing.assert_allclose(rows, [turn(vector)[:2] for vector in limits], atol=1e-5)


def test_labels_and_classes_become_masks(prepared: tuple[Subject, list[str]], person: Path) -> None:
    subject, said = prepared
    assert "note: in seg_0000.png 0 is taken as the background and every other label as the person" in said
    assert subject.manifest.head_masks == subject.manifest.mouth_masks == "derived"
    for index in (0, 2, FRAMES - 1):
        frame, place = subject.frame(index), person / f"frame_{index:04d}"
        classes, labels = (
            cv2.imread(str(place / f"{name}_0000.png"), cv2.IMREAD_GRAYSCALE) for name in ("parsing", "seg")
        )
        assert labels is not None and classes is not None and {BODY, CLOTH} <= {labels[-1, 0], classes[-1, 0]}
        np.testing.assert_array_equal(frame.alpha.numpy(), labels > 0)
        np.testing.assert_array_equal(frame.head_mask.numpy(), np.isin(classes, (SKIN, LIP)))
        np.testing.assert_array_equal(frame.mouth_mask.numpy(), classes == LIP)


def test_the_frames_under_val_are_tested(prepared: tuple[Subject, list[str]]) -> None:
    assert prepared[0].split == (tuple(range(TRAINED)), tuple(range(TRAINED, FRAMES)))
    assert "note: the folder's own division into training and test frames is kept" in prepared[1]


def test_frames_may_be_listed_by_name_and_left_out_of_both(copy: Path, tmp_path: Path) -> None:
    names = [f"frame_{number:04d}" for number in range(FRAMES)]
    (copy / "split.json").write_text(json.dumps({"train": names[:10], "val": names[9:12]}))
    subject, said = prepare_folder(copy, tmp_path / "out")
    assert subject.split == (tuple(range(9)), (9, 10, 11))
    assert any("(12 are not used)" in line for line in said)


def test_without_a_split_the_last_frames_are_tested(copy: Path, tmp_path: Path) -> None:
    (copy / "split.json").unlink()
    subject, said = prepare_folder(copy, tmp_path / "out")
    assert max(subject.split.train) < min(subject.split.test) and not any("own division" in line for line in said)


def test_rows_in_another_order_are_the_same_frames(
    copy: Path, prepared: tuple[Subject, list[str]], tmp_path: Path
) -> None:
    rows = [*DEGREES, "rotation", "translation", "expr", "frame"]
    edit_tracking(copy, lambda values: values.update({name: values[name][::-1] for name in rows}))
    assert prepare_folder(copy, tmp_path / "out")[0].data_hash == prepared[0].data_hash


def test_a_turned_camera_turns_the_head(copy: Path) -> None:
    before, camera, moved = tracked(copy)[4], turn(np.array([0.0, 0.1, 0.3])), np.array([0.01, 0.02, 0.1])
    edit_tracking(copy, lambda values: values.update(RT=np.column_stack((camera, moved))))
    after, axes = tracked(copy)[4], np.diag([-1.0, -1.0, 1.0])
    np.testing.assert_allclose(after.R, axes @ camera @ axes @ before.R, atol=1e-6)
    np.testing.assert_allclose(after.t, axes @ (camera @ axes @ before.t + moved), atol=1e-6)


def test_one_bad_row_or_missing_picture_is_left_out(copy: Path, tmp_path: Path) -> None:
    edit_tracking(copy, lambda values: values["neck_pose"].__setitem__((4, 1), np.nan))
    shutil.rmtree(copy / "frame_0007")
    subject, said = prepare_folder(copy, tmp_path / "out")
    assert subject.manifest.left_out == {"frame_0004_image_0000": "neck_pose is not finite (1 of 3 values)"}
    assert len(subject) == FRAMES - 2 and f"note: there are {FRAMES - 1} images and {FRAMES} tracking frames" in said


def test_a_folder_is_told_by_its_files(person: Path, copy: Path, tmp_path: Path) -> None:
    check_folder(person)
    with pytest.raises(UserError, match="it holds person_0000/; give it"):
        check_folder(person.parent)
    (copy / "imgs").mkdir()
    with pytest.raises(UserError, match="metrical-tracker or NHA; say which with --data-format"):
        prepare_folder(copy, tmp_path / "out")
    assert len(prepare_folder(copy, tmp_path / "out", data_format="NHA")[0]) == FRAMES


def test_check_finds_nothing_wrong(person: Path) -> None:
    outcome = check_tracked_folder(person, lambda: load_head_assets(person / "head_model"))
    assert not [finding for finding in outcome.findings if finding.severity == "error"]


def of_tracking(edit: Callable[[dict[str, Any]], object]) -> Callable[[Path], object]:
    return lambda folder: edit_tracking(folder, edit)


def of_split(text: str) -> Callable[[Path], object]:
    return lambda folder: (folder / "split.json").write_text(text)


def rewrite(name: str, edit: Callable[[np.ndarray], np.ndarray], frames: int) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        for number in range(frames):
            path = folder / f"frame_{number:04d}" / name
            pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            assert pixels is not None and cv2.imwrite(str(path), edit(pixels))

    return change


HOSTILE: dict[str, tuple[Callable[[Path], object], str]] = {
    "no tracking": (lambda f: (f / NPZ).unlink(), r"person_0000 holds no tracked_flame_params\*.npz; copy it"),
    "two trackings": (
        lambda f: shutil.copy(f / NPZ, f / "tracked_flame_params_1.npz"),
        "_0.npz, .*_1.npz; keep one of them",
    ),
    "damaged tracking": (lambda f: (f / NPZ).write_bytes(b"PK" * 50), "is damaged or not a .npz file"),
    "tracking without a jaw": (of_tracking(lambda v: v.pop("jaw_pose")), f"{NPZ} lacks jaw_pose"),
    "rows that are missing": (
        of_tracking(lambda v: v.update(expr=v["expr"][1:])),
        r"expr has the shape \[23, 100\], not some values for each of 24 frames; copy it or track the folder again",
    ),
    "eyes of one side": (
        of_tracking(lambda v: v.update(eyes_pose=v["eyes_pose"][:, :3])),
        r"eyes_pose has the shape \[24, 3\], not 6 values for each of 24 frames",
    ),
    "rows that are not finite": (
        of_tracking(lambda v: v["rotation"].__setitem__(slice(2, 9), np.inf)),
        r"7 of 24 tracking files .*00002-00008 \(rotation is not finite",
    ),
    "an identity that is not finite": (of_tracking(lambda v: v["shape"].fill(np.nan)), "shape is not finite"),
    "a frame twice": (of_tracking(lambda v: v["frame"].__setitem__(1, 0)), "1 of 24 numbers in frame are there twice"),
    "a negative frame": (of_tracking(lambda v: v["frame"].__setitem__(1, -1)), "frame does not hold whole numbers"),
    "frames out of the tracking": (
        of_tracking(lambda v: v.update(frame=v["frame"] + 1000)),
        "no image belongs to a tracking frame",
    ),
    "many frames that are missing": (
        lambda f: [shutil.rmtree(f / f"frame_{n:04d}") for n in range(12)],
        "12 of 24 tracking frames have no partner",
    ),
    "a picture that is missing": (
        lambda f: [(f / f"frame_{n:04d}" / "image_0000.png").unlink() for n in (3, 4)],
        "2 of 24 images cannot be used.*image_0000.png does not exist",
    ),
    "labels that are missing": (
        lambda f: [(f / f"frame_{n:04d}" / "seg_0000.png").unlink() for n in (3, 4)],
        r"2 of 24 images cannot be used.*00003-00004 \(it has no alpha\)",
    ),
    "two sizes": (rewrite("image_0000.png", lambda p: p[:, :50], 1), "is 64x56 pixels but image_0000.png is 50x56"),
    "labels of another size": (rewrite("seg_0000.png", lambda p: p[:, :50], 1), "is 50x56 pixels but the images are"),
    "tracking of another size": (
        of_tracking(lambda v: v.update(image_size=np.array([512, 512]))),
        "the tracking was made on 512x512 images, but those in .* are 64x56",
    ),
    "no size": (of_tracking(lambda v: v.update(image_size=np.zeros(2))), "image_size is 0 and 0, which no image is"),
    "no focal length": (
        of_tracking(lambda v: v["K"].__setitem__(0, 0)),
        "K is 0, 0.47, 0.56, no lens in units of the picture",
    ),
    "a lens in pixels": (of_tracking(lambda v: v.update(K=np.array([150.0, 30, 31]))), "K is 150, 30, 31, no lens"),
    "a lens of four values": (of_tracking(lambda v: v.update(K=np.ones(4))), "K has 4 values, not 3"),
    "a camera that is no rotation": (of_tracking(lambda v: v.update(RT=2 * v["RT"])), "RT is not a rotation"),
    "labels that are inverted": (
        rewrite("seg_0000.png", lambda p: np.where(p > 0, 0, 7).astype(np.uint8), FRAMES),
        "the mattes in .* are inverted",
    ),
    "a split that is no JSON": (of_split("{"), "split.json cannot be read as JSON"),
    "a split without val": (of_split('{"train": [1, 2]}'), "split.json has no list of frame numbers under 'val'"),
    "a split of pictures": (of_split('{"train": ["a.png"], "val": []}'), "no list of frame numbers under 'train'"),
    "a split that is a list": (of_split("[1, 2]"), "no list of frame numbers under 'train'; copy it again, or remove"),
    "a split of numbers with points": (of_split('{"train": [1.5], "val": [true]}'), "no list of frame numbers"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_folders_are_refused_in_a_sentence(name: str, copy: Path, tmp_path: Path) -> None:
    edit, sentence = HOSTILE[name]
    edit(copy)
    with pytest.raises(UserError, match=sentence) as error:
        prepare_folder(copy, tmp_path / "out")
    assert "\n" not in str(error.value) and not (tmp_path / "out").exists()
