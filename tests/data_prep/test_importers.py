"""Every format of tracked folder gives the same subject: the same pictures, masks, meshes in the image, and split."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from exports import write_imavatar, write_insta, write_vhap
from importing import FRAMES, HEIGHT, SIZE, assert_same_pictures, import_folder

from avatar.data.subject import Subject
from avatar.errors import UserError
from data_prep.formats import imavatar, insta, vhap
from data_prep.formats.transforms import read_listings


def test_vhap(tracked: Path, original: Subject, tmp_path: Path) -> None:
    folder = write_vhap(tracked, tmp_path / "vhap")
    subject, said = import_folder(folder, tracked, tmp_path / "out")
    assert said[0] == "format: VHAP" and subject.manifest.format == "VHAP"
    assert said[1].startswith("images and tracking are paired by transforms_train.json: head overlap 1.000")
    assert_same_pictures(subject, original, tracked)
    assert all(torch.equal(subject.frame(i).alpha, original.frame(i).head_mask) for i in range(FRAMES))
    assert subject.split == (tuple(range(16)), tuple(range(18, FRAMES)))
    assert "note: the folder's own division into training and test frames is kept (2 are not used)" in said
    assert (
        "note: the tracking has 100 expression coefficients, the head model 10; the others are zero and left out"
        in said
    )
    assert "note: there are no head masks: the foreground matte is taken as the head" in said
    assert subject.manifest.frames[3].image == "images/00003_00.png" and not subject.recording.tracks["eyelids"].any()


def test_vhap_with_one_listing_an_angle_of_view_and_no_masks(tracked: Path, original: Subject, tmp_path: Path) -> None:
    folder = write_vhap(tracked, tmp_path / "vhap", divided=False, angle=True, masks=False)
    subject, said = import_folder(folder, tracked, tmp_path / "out")
    assert_same_pictures(subject, original, tracked)
    assert "there are no masks to confirm it with" in said[1]
    assert "note: there is no fg_masks/: the whole image is taken as foreground" in said
    assert subject.split == original.split


def test_the_neck_is_kept(tracked: Path, tmp_path: Path) -> None:
    folder = write_vhap(
        tracked, tmp_path / "vhap", edit=lambda n, v: v["neck_pose"].__setitem__(slice(None), [0.1, 0, 0])
    )
    subject, _ = import_folder(folder, tracked, tmp_path / "out")
    expected = torch.from_numpy(cv2.Rodrigues(np.array([0.1, 0, 0]))[0][:2].ravel()).float()
    torch.testing.assert_close(subject.recording.tracks["neck"], expected.expand(FRAMES, 6), atol=1e-6, rtol=0)


def test_the_frontal_one_of_several_cameras_is_used(tracked: Path, original: Subject, tmp_path: Path) -> None:
    folder = write_vhap(tracked, tmp_path / "vhap", divided=False, camera="front")
    listing = json.loads((folder / "transforms.json").read_text())
    aside = np.array(listing["frames"][0]["transform_matrix"])
    aside[:3, :3] = cv2.Rodrigues(np.array([0, 1.2, 0]))[0] @ aside[:3, :3]
    listing["frames"] += [
        entry
        | {
            "camera_id": "aside",
            "transform_matrix": aside.tolist(),
            "file_path": f"images/{i:05d}_00.jpg",
        }  # comes first
        for i, entry in enumerate(listing["frames"])
    ]
    (folder / "transforms.json").write_text(json.dumps(listing))
    subject, said = import_folder(folder, tracked, tmp_path / "out", cameras="front")
    assert_same_pictures(subject, original, tracked)
    assert "note: of the folder's 2 cameras front is used" in said


@pytest.mark.parametrize(("old_intrinsics", "subfolders"), [(False, False), (True, False), (False, True)])
def test_imavatar(old_intrinsics: bool, subfolders: bool, tracked: Path, original: Subject, tmp_path: Path) -> None:
    folder = write_imavatar(tracked, tmp_path / "ima", old_intrinsics=old_intrinsics, subfolders=subfolders)
    subject, said = import_folder(folder, tracked, tmp_path / "out")
    assert said[0] == "format: IMavatar"
    assert_same_pictures(subject, original, tracked)
    assert subject.manifest.head_masks == subject.manifest.mouth_masks == "derived"
    if subfolders:  # the test frames last, as they were in the video, although "test" comes before "train"
        assert subject.split == (tuple(range(18)), tuple(range(18, FRAMES)))
        assert [subject.manifest.frames[i].name for i in (0, 18)] == ["train_image_1", "test_image_19"]
    for index in range(FRAMES):
        mine, theirs = subject.frame(index), original.frame(index)
        for kind in ("head_mask", "mouth_mask"):
            assert torch.equal(getattr(mine, kind), getattr(theirs, kind)), kind
        assert torch.equal(mine.alpha, theirs.head_mask)


@pytest.mark.parametrize("matted", [False, True])
def test_insta(matted: bool, tracked: Path, original: Subject, tmp_path: Path) -> None:
    folder = write_insta(tracked, tmp_path / "insta", matted=matted)
    subject, said = import_folder(folder, tracked, tmp_path / "out")
    assert said[0] == "format: INSTA" and not any("renumbered" in sentence for sentence in said)
    assert_same_pictures(subject, original, tracked)
    assert subject.split == (tuple(range(18)), tuple(range(18, FRAMES)))
    for index in range(FRAMES):
        mine, theirs = subject.frame(index), original.frame(index)
        assert torch.equal(mine.alpha, theirs.head_mask)
        assert torch.equal(mine.head_mask[:-2], theirs.head_mask[:-2]) and not mine.head_mask[-2:].any()
        assert torch.equal(mine.mouth_mask[:-2], theirs.mouth_mask[:-2])


def test_insta_with_its_tracking_elsewhere(tracked: Path, original: Subject, tmp_path: Path) -> None:
    folder = write_insta(tracked, tmp_path / "insta", checkpoint=False)
    with pytest.raises(UserError, match=r"holds no checkpoint/\*\.frame of metrical-tracker and none of the meshes"):
        import_folder(folder, tracked, tmp_path / "out")
    with pytest.raises(UserError, match=r"images holds no \.frame files of metrical-tracker; give --tracking"):
        import_folder(folder, tracked, tmp_path / "out", tracking=folder / "images")
    subject, _ = import_folder(folder, tracked, tmp_path / "out", tracking=tracked)
    assert_same_pictures(subject, original, tracked)


def test_sizes_that_are_asked_for_override_the_division(tracked: Path, tmp_path: Path) -> None:
    folder = write_vhap(tracked, tmp_path / "vhap")
    subject, _ = import_folder(folder, tracked, tmp_path / "out", test_frames=3)
    assert subject.split == (tuple(range(21)), tuple(range(21, 24)))


def test_a_format_can_be_asked_for(tracked: Path, tmp_path: Path) -> None:
    folder = write_insta(tracked, tmp_path / "both")
    shutil.copytree(tracked / "imgs", folder / "imgs")
    with pytest.raises(UserError, match="could be a folder of metrical-tracker or INSTA; say which with --data-format"):
        import_folder(folder, tracked, tmp_path / "out")
    for name in ("INSTA", "metrical-tracker"):
        subject, said = import_folder(folder, tracked, tmp_path / name, data_format=name)
        assert said[0] == f"format: {name}" and len(subject) == FRAMES
    with pytest.raises(UserError, match="is not a folder of VHAP's"):
        import_folder(folder, tracked, tmp_path / "out", data_format="VHAP")
    with pytest.raises(
        UserError,
        match="--data-format must be one of metrical-tracker, VHAP, INSTA, IMavatar, .*avatar-track, not 'NeRFace'",
    ):
        import_folder(folder, tracked, tmp_path / "out", data_format="NeRFace")


def test_prepared_again_when_a_listing_or_a_late_mask_changes_it(tracked: Path, tmp_path: Path) -> None:
    folder = write_vhap(tracked, tmp_path / "vhap", divided=False)
    import_folder(folder, tracked, tmp_path / "out")
    assert import_folder(folder, tracked, tmp_path / "out")[1] == [f"using the prepared subject {tmp_path / 'out'}"]
    listing = json.loads((folder / "transforms.json").read_text())
    listing["fl_x"] *= 1.01
    (folder / "transforms.json").write_text(json.dumps(listing))
    subject, said = import_folder(folder, tracked, tmp_path / "out")
    assert said[0] == "format: VHAP" and subject.manifest.intrinsics[0] == pytest.approx(2.8 * SIZE * 1.01)


def test_one_bad_parameter_file_is_left_out_and_two_are_refused(tracked: Path, tmp_path: Path) -> None:
    def spoil(*numbers: int) -> Callable[[int, dict[str, np.ndarray]], None]:
        return lambda number, values: values["expr"].fill(np.inf) if number in numbers else None

    subject, said = import_folder(write_vhap(tracked, tmp_path / "one", edit=spoil(4)), tracked, tmp_path / "out")
    assert subject.manifest.left_out == {"00004_00": "expr is not finite (100 of 100 values)"}
    assert subject.split.train == tuple(range(15)) and any(s.startswith("warning: left out 1 of 24") for s in said)
    with pytest.raises(UserError, match=r"2 of 24 tracking files .*00004, 00007 \(expr is not finite \(100 of 100"):
        import_folder(write_vhap(tracked, tmp_path / "two", edit=spoil(4, 7)), tracked, tmp_path / "out2")


def test_a_face_parsing_that_shows_clothes_alone_is_left_out(tracked: Path, tmp_path: Path) -> None:
    folder = write_imavatar(tracked, tmp_path / "imavatar")
    assert cv2.imwrite(str(folder / "semantic" / "5.png"), np.full((HEIGHT, SIZE), 16, np.uint8))
    subject, _ = import_folder(folder, tracked, tmp_path / "out")
    assert list(subject.manifest.left_out) == ["5"] and "5.png is empty" in subject.manifest.left_out["5"]


def test_pickled_objects_in_a_parameter_file_are_refused(tracked: Path, tmp_path: Path) -> None:
    folder = write_vhap(tracked, tmp_path / "vhap")
    for number in (1, 2):
        np.savez(folder / "flame_param" / f"{number:05d}.npz", expr=np.array([{}], dtype=object))
    with pytest.raises(UserError, match=r"00001-00002 \(holds pickled Python objects"):
        import_folder(folder, tracked, tmp_path / "out")


def test_more_coefficients_than_directions_are_an_error_unless_zero(tracked: Path, tmp_path: Path) -> None:
    """In a metrical-tracker folder too, where the masks are compared with the mesh before."""
    folder = tmp_path / "subject"
    shutil.copytree(tracked, folder)
    for file in (folder / "checkpoint").iterdir():
        content = torch.load(file, weights_only=False)
        content["flame"]["exp"] = np.pad(content["flame"]["exp"], ((0, 0), (0, 40)))
        torch.save(content, file)
    subject, said = import_folder(folder, tracked, tmp_path / "out")
    assert (
        "note: the tracking has 50 expression coefficients, the head model 10; the others are zero and left out" in said
    )
    assert subject.recording.tracks["expression"].shape == (FRAMES, 10)
    spoiled = write_vhap(tracked, tmp_path / "vhap", edit=lambda n, values: values["expr"].__setitem__((0, 50), 0.5))
    with pytest.raises(
        UserError, match="has 100 expression coefficients but the head model has 10 expression directions"
    ):
        import_folder(spoiled, tracked, tmp_path / "out2")


def test_an_offset_contradicts_a_listing(tracked: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="--frame-offset 2: transforms_train.json itself says which image"):
        import_folder(write_vhap(tracked, tmp_path / "vhap"), tracked, tmp_path / "out", frame_offset=2)


def test_vhap_imavatar_and_insta_lack_a_number_between_two_folders_of_images(tmp_path: Path) -> None:
    frames = [
        {"file_path": f"{folder}/{n}.png", "flame_param_path": f"{folder}/{n}.npz", "mesh_path": "1.obj"}
        for folder in "ab"
        for n in (1, 2)
    ]
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    (tmp_path / "1.obj").touch()
    listed = read_listings(tmp_path)
    for layout in (vhap, imavatar, insta):
        assert list(layout.open_folder(tmp_path, listed).files.images) == [0, 1, 3, 4]
