"""A head model or a video that the tracking is not of: head and lips are judged each by itself, in every layout."""

from __future__ import annotations

import pickle
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from exports import write_imavatar, write_vhap
from folder_damage import freeze, matching
from importing import import_folder
from tracked_folder import write_head_model, write_tracked_folder

from avatar.cli import main
from avatar.data.read_image import read_mask
from avatar.data.source import Source
from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.head.assets import HeadAssets, load_head_assets
from data_prep.check.folder import check_tracked_folder
from data_prep.formats.frame_files import FrameFiles
from data_prep.prepare.check_alignment import measure_alignment
from data_prep.prepare.mask_overlap import Fit
from data_prep.prepare.prepare import prepare

LIPS = r"the tracked lips do not lie on the mouth masks \(overlap 0\.[0-3]\d+, \d+\.\d% of the head's size away\)"
HEAD_LIES = r", although the head lies on its masks \(overlap 0\.[89]\d+\); "
ADVICE = r"is the head model the one that the tracking was made with, .* or --ignore-misfit to go on regardless$"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tracked_folder(tmp_path_factory.mktemp("misfit") / "someone", 24, size=96, suffix=".png")


@pytest.fixture
def broken(folder: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "someone"))


@pytest.fixture(scope="module")
def other_head(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same outline from everywhere, and the lips where another head has an ear."""
    path = tmp_path_factory.mktemp("other") / "head_model"
    write_head_model(path)
    model = pickle.loads((path / "generic_model.pkl").read_bytes())
    turn = cv2.Rodrigues(np.array([0.0, 0.4, 0.0]))[0]
    model["v_template"] = (model["v_template"] @ turn.T).astype(np.float32)
    (path / "generic_model.pkl").write_bytes(pickle.dumps(model))
    return path


def prepared(folder: Path, out: Path, head: Path | None = None, **options: Any) -> tuple[Subject, list[str]]:
    said: list[str] = []
    head = head or folder / "head_model"
    path = prepare(Source(folder, head, **options), load_head_assets(head), out=out, say=said.append)
    return Subject.open(path), said


def roll(folder: Path, pattern: str, rows: int, columns: int) -> None:
    for path in matching(folder, pattern):
        assert cv2.imwrite(str(path), np.roll(read_mask(path), (rows, columns), (0, 1)))


@pytest.mark.parametrize(
    ("head", "inside", "lips", "away", "size", "by_matte", "found"),
    [
        (0.31, 0.3, 0.2, 0.024, 100, False, None),  # a little overlap of the head, and lips where they are seen
        (0.29, 1.0, 0.9, 0.0, 100, False, "head"),
        (0.10, 0.51, 0.9, 0.0, 100, True, None),  # a matte has clothes in it
        (0.90, 0.49, 0.9, 0.0, 100, True, "head"),
        (0.90, 1.0, 0.59, 0.026, 100, False, "lips"),
        (0.90, 1.0, 0.61, 0.100, 100, False, None),  # large mouths overlap although they are apart
        (0.90, 1.0, 0.01, 0.024, 100, False, None),  # masks of the teeth alone
        (0.90, 1.0, 0.50, 0.049, 30, False, None),  # 1.47 pixels are nothing
        (0.90, 1.0, 0.50, 0.051, 30, False, "lips"),
        (0.90, 1.0, 0.0, np.nan, 100, False, "lips"),  # lips that are not in the picture
        (0.20, 0.2, 0.1, 0.500, 100, False, "neither"),
        (np.nan, np.nan, 0.59, 0.026, 100, False, "lips"),
        (0.90, 1.0, np.nan, np.nan, 100, False, None),
        (np.nan, np.nan, np.nan, np.nan, 100, False, None),
    ],
)
def test_where_the_limits_are(
    head: float, inside: float, lips: float, away: float, size: float, by_matte: bool, found: str | None
) -> None:
    paths = {1: Path("x")}
    files = FrameFiles(Path(), paths, paths, {} if by_matte else paths, paths, paths)
    usual = Fit(head, inside, 0.0, lips, away * size, 1.0, size)
    good, bad = Fit(1.0, 1.0, 0.0, 1.0, 0.0, 1.0, size), Fit(0.0, 0.0, 9.0, 0.0, size, 1.0, size)
    strays = [good, bad] if np.isfinite([head, lips, away]).all() else []
    for fits in ([usual], [usual, *strays, usual, usual]):  # single frames do not decide
        alignment = measure_alignment(fits, files)
        assert (
            None if alignment.problem is None else alignment.problem.split()[0 if found == "neither" else 2]
        ) == found
        assert ("head overlap" in alignment.evidence) == np.isfinite(head)
        assert ("lips overlap" in alignment.evidence) == np.isfinite(lips)
        assert ("of the head's size away" in alignment.evidence) == np.isfinite([lips, away]).all()


@pytest.mark.parametrize("options", [{}, {"frame_offset": 1}], ids=["offset found", "offset given"])
def test_a_head_model_of_another_topology_is_told_by_its_lips(
    options: dict[str, Any], folder: Path, other_head: Path, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match=LIPS + HEAD_LIES + ADVICE):
        prepared(folder, tmp_path / "out", other_head, **options)
    assert not (tmp_path / "out").exists()
    subject, said = prepared(folder, tmp_path / "out", other_head, frame_offset=1, ignore_misfit=True)
    (note,) = subject.manifest.notes
    assert note.startswith("the tracked lips do not lie on the mouth masks (")
    assert note.endswith(": taken regardless, as --ignore-misfit says") and f"note: {note}" in said


def test_an_offset_that_is_not_clear_is_blamed_on_the_head_model_first(
    broken: Path, other_head: Path, tmp_path: Path
) -> None:
    freeze(broken)
    with pytest.raises(UserError, match=LIPS + HEAD_LIES + ADVICE):
        prepared(broken, tmp_path / "out", other_head)
    with pytest.raises(UserError, match=r"the offset between images and tracking is not clear .* give --frame-offset"):
        prepared(broken, tmp_path / "out", other_head, ignore_misfit=True)


def test_a_paired_folder_is_judged_too(other_head: Path, tmp_path: Path) -> None:
    """The mouth masks are in the face parsing of IMavatar's layout; VHAP's has none."""
    tracked = write_tracked_folder(tmp_path / "someone", 24, size=96, suffix=".png")
    for file in (tracked / "checkpoint").iterdir():
        content = torch.load(file, weights_only=False)
        content["flame"]["eyelids"][:] = 0
        torch.save(content, file)
    folder = write_imavatar(tracked, tmp_path / "ima")
    right, said = prepared(folder, tmp_path / "right", tracked / "head_model")
    assert said[1] == right.manifest.offset_evidence
    assert said[1].startswith(
        "images and tracking are paired by flame_params.json: head overlap 1.000, lips overlap 1.000"
    )
    with pytest.raises(UserError, match=LIPS + HEAD_LIES + ADVICE):
        prepared(folder, tmp_path / "out", other_head)


def test_another_convention_is_noticed_by_the_matte(tracked: Path, tmp_path: Path) -> None:
    """A camera in OpenCV's axes where OpenGL's belong puts the head behind the camera or beside its mattes."""
    folder = write_vhap(tracked, tmp_path / "vhap", edit=lambda n, values: values["translation"].__iadd__([0.3, 0, 0]))
    sentence = r"the tracked head does not lie on the masks \(overlap 0\.[0-2]\d+, \d+% of it on the matte\); " + ADVICE
    for options in ({}, {"frame_offset": 0}):
        with pytest.raises(UserError, match=sentence):
            import_folder(folder, tracked, tmp_path / "out", **options)
    subject, said = import_folder(folder, tracked, tmp_path / "out", ignore_misfit=True)
    assert len(subject) == 24 and any(line.startswith("note: the tracked head does not lie on") for line in said)


def test_head_masks_elsewhere_are_not_excused_by_the_lips(broken: Path, tmp_path: Path) -> None:
    roll(broken, "parsing/*_neckhead.png", 48, 48)
    with pytest.raises(
        UserError, match=r"^the tracked head does not lie on the masks \(overlap 0\.[01]\d+\); " + ADVICE
    ):
        prepared(broken, tmp_path / "out", frame_offset=1)


def test_masks_that_are_both_elsewhere_are_both_named(broken: Path, tmp_path: Path) -> None:
    roll(broken, "parsing/*", 48, 48)
    with pytest.raises(
        UserError, match=r"^neither the tracked head \(overlap 0.* nor its lips \(.*\) lie on the masks; "
    ):
        prepared(broken, tmp_path / "out", frame_offset=1)


def test_mouth_masks_alone_tell_another_head(broken: Path, other_head: Path, tmp_path: Path) -> None:
    shutil.rmtree(broken / "alpha")
    for path in matching(broken, "parsing/*_neckhead.png"):
        path.unlink()
    _, said = prepared(broken, tmp_path / "right")
    assert ": lips overlap 1.000, 0.0% of the head's size away" in said[1]
    with pytest.raises(UserError, match=LIPS + "; " + ADVICE):
        prepared(broken, tmp_path / "out", other_head, frame_offset=1)


def test_a_matte_with_clothes_in_it_is_no_misfit(tmp_path: Path) -> None:
    """All but the upper rim of a tall image: less than a third of the matte is head."""
    folder = write_tracked_folder(tmp_path / "someone", 24, size=96, height=128, suffix=".png", head_masks=False)
    for path in matching(folder, "alpha/*"):
        matte = read_mask(path)
        matte[3:] = 255
        assert cv2.imwrite(str(path), matte)
    _, said = prepared(folder, tmp_path / "out", frame_offset=1)
    overlap = float(said[1].partition("head overlap ")[2][:5])
    assert overlap < 0.3 and "100% of it on the matte" in said[1]


@pytest.mark.parametrize("pixels", [-2, 2], ids=["without the lips' rim", "with a margin"])
def test_mouth_masks_that_are_drawn_otherwise_are_no_misfit(pixels: int, broken: Path, tmp_path: Path) -> None:
    change = cv2.dilate if pixels > 0 else cv2.erode
    for path in matching(broken, "parsing/*_mouth.png"):
        assert cv2.imwrite(str(path), change(read_mask(path), np.ones((abs(pixels) + 1,) * 2, np.uint8)))
    _, said = prepared(broken, tmp_path / "out", frame_offset=1)
    assert float(said[1].partition("lips overlap ")[2][:5]) < 0.75


def test_check_says_the_same_with_an_offset_too(folder: Path, other_head: Path) -> None:
    for options in ({}, {"frame_offset": 1}):
        check = check_tracked_folder(folder, lambda: load_head_assets(other_head), **options)
        assert check.status == 2
        (finding,) = (one for one in check.findings if one.severity == "error")
        assert finding.problem.startswith("the tracked lips do not lie on the mouth masks (overlap 0.")
        assert "--ignore-misfit to go on regardless" in finding.advice
    ignored = check_tracked_folder(folder, lambda: load_head_assets(other_head), frame_offset=1, ignore_misfit=True)
    (finding,) = (one for one in ignored.findings if one.check == "residual")
    assert (finding.severity, ignored.status) == ("warning", 1)
    right = check_tracked_folder(folder, lambda: load_head_assets(folder / "head_model"), frame_offset=1)
    assert right.status == 0


def test_the_command_line_takes_the_override(
    folder: Path, other_head: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["prepare", str(folder), "--head", str(other_head), "--frame-offset", "1", "--out", str(tmp_path / "out")]
    assert main(command) == 1
    assert "the tracked lips do not lie on the mouth masks" in capsys.readouterr().err
    assert main([*command, "--ignore-misfit"]) == 0
    assert "taken regardless, as --ignore-misfit says" in capsys.readouterr().out


def flame(shared: Path, like: HeadAssets) -> HeadAssets:
    """FLAME 2023 Open with ARKit's expressions, its lips those within 6 mm of MediaPipe's landmarks on them."""
    whole, marks = (np.load(shared / f"assets/flame2023open/flame2023open_{name}.npz") for name in ("arkit", "partial"))
    template, faces = whole["v_template"], whole["f"].astype(np.int64)
    corners = template[faces[marks["mp_lmk_face_idx"]]]
    points = (corners * marks["mp_lmk_b_coords"][..., None]).sum(axis=1)
    points = points[np.isin(marks["mp_landmark_indices"], (61, 291, 0, 17, 13, 14, 37, 267, 84, 314, 40, 270, 91, 321))]
    lips = np.flatnonzero(np.linalg.norm(template[:, None] - points, axis=2).min(axis=1) < 0.008)
    identity, expression = (np.zeros((len(template), 3, count), np.float32) for count in (300, like.num_expressions))
    identity[..., :60], expression[..., :53] = whole["shapedirs_id60"], whole["shapedirs_expr"]
    arrays = {
        "template": template,
        "shape_dirs": identity,
        "expression_dirs": expression,
        "pose_dirs": whole["posedirs"],
        "joint_regressor": whole["J_regressor"],
        "weights": whole["weights"],
        "eyelid_dirs": np.stack((whole["l_eyelid"], whole["r_eyelid"])),
    }
    tensors = {name: torch.from_numpy(np.ascontiguousarray(array, np.float32)) for name, array in arrays.items()}
    corners_of_faces = torch.from_numpy(faces)
    regions = {"lips": torch.from_numpy(lips)}
    return replace(like, **tensors, faces=corners_of_faces, uv_faces=corners_of_faces, regions=regions)


@pytest.mark.shared
@pytest.mark.slow
@pytest.mark.parametrize(("name", "options"), [("anna", {}), ("carla", {"frame_offset": 1})])
def test_flame_is_not_the_head_of_the_development_subjects(
    name: str, options: dict[str, Any], shared_dir: Path, tmp_path: Path
) -> None:
    folder, head = shared_dir / "subjects" / name, shared_dir / "subjects" / "head_model"
    own = load_head_assets(head)
    with pytest.raises(UserError, match=r"the tracked lips do not lie on the mouth masks \(overlap 0\.[34]"):
        prepare(Source(folder, head, **options), flame(shared_dir, own), out=tmp_path / "out", say=str)
    said: list[str] = []
    prepare(Source(folder, head, frame_offset=1), own, out=tmp_path / "out", say=said.append)
    assert float(said[1].partition("lips overlap ")[2][:5]) > 0.8
