from __future__ import annotations

import pickle
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from heads import grid_head

from avatar.errors import UserError
from avatar.head.assets import HeadAssets, load_head_assets


def flame_dict(assets: HeadAssets) -> dict[str, np.ndarray]:
    """The arrays of a model file, under FLAME's keys."""
    directions = np.concatenate((assets.shape_dirs.numpy(), assets.expression_dirs.numpy()), axis=2)
    parents = np.array([2**32 - 1, *assets.parents[1:]], dtype=np.uint32)
    return {
        "v_template": assets.template.numpy(),
        "f": assets.faces.numpy().astype(np.uint32),
        "shapedirs": directions,
        "posedirs": assets.pose_dirs.numpy(),
        "J_regressor": assets.joint_regressor.numpy(),
        "weights": assets.weights.numpy(),
        "kintree_table": np.stack((parents, np.arange(5, dtype=np.uint32))),
    }


def obj_text(assets: HeadAssets, order: np.ndarray | None = None) -> str:
    lines = ["# a comment", "mtllib none.mtl"]
    lines += [f"v {x} {y} {z}" for x, y, z in assets.template.tolist()]
    lines += [f"vt {u} {v}" for u, v in assets.uvs.tolist()]
    for face in order if order is not None else range(len(assets.faces)):
        corners = zip(assets.faces[face].tolist(), assets.uv_faces[face].tolist(), strict=True)
        lines.append("f " + " ".join(f"{v + 1}/{t + 1}" for v, t in corners))
    return "\n".join(lines) + "\n"


@pytest.fixture
def head_dir(tmp_path: Path) -> Path:
    assets = grid_head()
    with (tmp_path / "generic_model.pkl").open("wb") as file:
        pickle.dump(flame_dict(assets), file, protocol=2)
    (tmp_path / "head_template.obj").write_text(obj_text(assets))
    for side, name in enumerate(("l_eyelid.npy", "r_eyelid.npy")):
        np.save(tmp_path / name, assets.eyelid_dirs[side].numpy())
    np.savez(tmp_path / "masks.npz", **{k: v.numpy() for k, v in assets.regions.items()})
    return tmp_path


def rewrite(head_dir: Path, **changes: object) -> None:
    arrays: dict = flame_dict(grid_head()) | changes
    with (head_dir / "generic_model.pkl").open("wb") as file:
        pickle.dump({k: v for k, v in arrays.items() if v is not None}, file, protocol=2)


def test_a_folder_and_the_file_in_it_are_the_same_model(head_dir: Path) -> None:
    expected = grid_head()
    from_folder = load_head_assets(head_dir)
    from_file = load_head_assets(head_dir / "generic_model.pkl")
    for name in ("template", "faces", "shape_dirs", "expression_dirs", "weights", "eyelid_dirs", "uvs", "uv_faces"):
        np.testing.assert_array_equal(getattr(from_folder, name), getattr(expected, name), err_msg=name)
    assert from_folder.parents == expected.parents
    assert from_folder.fingerprint == from_file.fingerprint
    assert set(from_folder.regions) == {"boundary", "lips"}


def test_npz_and_pickle_have_the_same_fingerprint(head_dir: Path) -> None:
    from_pickle = load_head_assets(head_dir).fingerprint
    (head_dir / "generic_model.pkl").unlink()
    np.savez(head_dir / "generic_model.npz", **flame_dict(grid_head()))
    assert load_head_assets(head_dir).fingerprint == from_pickle


def test_any_change_changes_the_fingerprint(head_dir: Path) -> None:
    before = load_head_assets(head_dir).fingerprint
    moved = grid_head().template.numpy().copy()
    moved[3, 1] += 1e-6
    rewrite(head_dir, v_template=moved)
    assert load_head_assets(head_dir).fingerprint != before


def test_the_objs_faces_may_come_in_another_order(head_dir: Path) -> None:
    expected = load_head_assets(head_dir).uv_faces
    order = np.random.default_rng(0).permutation(len(expected))
    (head_dir / "head_template.obj").write_text(obj_text(grid_head(), order))
    np.testing.assert_array_equal(load_head_assets(head_dir).uv_faces, expected)


def test_a_triangle_that_is_there_twice_keeps_both_layouts(head_dir: Path) -> None:
    head = grid_head()
    faces, corners = torch.cat((head.faces, head.faces[:1])), torch.cat((head.uv_faces, head.uv_faces[-1:]))
    (head_dir / "head_template.obj").write_text(obj_text(replace(head, faces=faces, uv_faces=corners)))
    rewrite(head_dir, f=faces.numpy())
    assert torch.equal(load_head_assets(head_dir).uv_faces, corners)


def test_the_objs_words_may_stand_apart_by_tabs(head_dir: Path) -> None:
    expected = load_head_assets(head_dir)
    (head_dir / "head_template.obj").write_text("  " + obj_text(grid_head()).replace(" ", "\t"))
    found = load_head_assets(head_dir)
    assert torch.equal(found.uvs, expected.uvs) and torch.equal(found.uv_faces, expected.uv_faces)


def test_the_objs_faces_may_count_backwards(head_dir: Path) -> None:
    before, file = load_head_assets(head_dir).fingerprint, head_dir / "head_template.obj"
    text = file.read_text()
    backwards = re.sub(r"(?<= )(\d+)/(\d+)", lambda m: f"{int(m[1]) - 64}/{int(m[2]) - 64}", text)
    assert "f -63/-63" in backwards
    file.write_text(backwards)
    assert load_head_assets(head_dir).fingerprint == before
    file.write_text(backwards.replace("f -63/-63", "f -63/-64"))
    with pytest.raises(UserError, match="names a UV outside the 63"):
        load_head_assets(head_dir)


def test_trimesh_reads_the_same_layout(head_dir: Path) -> None:
    assets = load_head_assets(head_dir)
    read = trimesh.load(head_dir / "head_template.obj", process=False, force="mesh")
    np.testing.assert_allclose(read.visual.uv[read.faces], assets.uvs[assets.uv_faces], atol=1e-7)
    np.testing.assert_allclose(read.vertices[read.faces], assets.template[assets.faces], atol=1e-7)


def test_parts_that_a_model_may_lack(head_dir: Path) -> None:
    for name in ("l_eyelid.npy", "r_eyelid.npy", "masks.npz"):
        (head_dir / name).unlink()
    rewrite(head_dir, posedirs=None)
    assets = load_head_assets(head_dir)
    assert not assets.eyelid_dirs.any() and not assets.pose_dirs.any() and not assets.regions
    assert assets.pose_dirs.shape == (63, 3, 36)


@pytest.mark.parametrize("name", ["l_eyelid.npy", "r_eyelid.npy"])
def test_one_eyelid_without_the_other_is_refused(head_dir: Path, name: str) -> None:
    (head_dir / name).unlink()
    with pytest.raises(UserError, match=f"{name} is missing beside the other eyelid"):
        load_head_assets(head_dir)


CASES = {
    "missing key": ({"weights": None}, "lacks weights"),
    "wrong template": ({"v_template": np.zeros((5, 2), np.float32)}, r"v_template has shape \[5, 2\]"),
    "vertex counts disagree": ({"weights": np.full((9, 5), 0.2)}, r"weights has shape \[9, 5\], expected \[63, 5\]"),
    "too few directions": ({"shapedirs": np.zeros((63, 3, 300))}, "has 300 directions"),
    "face out of range": ({"f": np.array([[0, 1, 99]])}, "outside the 63 of v_template"),
    "no faces": ({"f": np.zeros((0, 3), np.int64)}, "faces f name vertices outside"),
    "weights do not sum to one": ({"weights": np.full((63, 5), 0.3)}, "vertex 0 sum to 1.5000"),
    "not finite": ({"v_template": np.full((63, 3), np.nan)}, "v_template holds values that are not finite"),
    "child before parent": ({"kintree_table": np.array([[-1, 2, 1, 1, 1], [0, 1, 2, 3, 4]])}, "after its parent"),
    "a root with a parent": (
        {"kintree_table": np.array([[0, 0, 1, 1, 1], [0, 1, 2, 3, 4]])},
        "root first; its parents",
    ),
    "not numbers": ({"J_regressor": [["a"]]}, "J_regressor is not an array of numbers"),
}


@pytest.mark.parametrize("case", CASES)
def test_a_model_that_does_not_fit_together_is_refused(head_dir: Path, case: str) -> None:
    changes, message = CASES[case]
    rewrite(head_dir, **changes)
    with pytest.raises(UserError, match=message) as caught:
        load_head_assets(head_dir)
    assert "generic_model.pkl" in str(caught.value)


def test_a_hostile_model_runs_nothing(head_dir: Path) -> None:
    marker = head_dir / "executed"

    class Hostile:
        def __reduce__(self):
            return (Path.touch, (marker,))

    rewrite(head_dir, v_template=Hostile())
    with pytest.raises(UserError, match="generic_model.pkl"):
        load_head_assets(head_dir)
    assert not marker.exists()


OBJ_CASES = {
    "other topology": (lambda text: text + "v 0 0 0\n", "64 vertices and 96 triangles, but the head model has 63"),
    "no uvs": (
        lambda text: "\n".join(line.split("/")[0] for line in text.splitlines()),
        "line 129: not a line of an OBJ",
    ),
    "uv out of range": (lambda text: text.replace("f 1/1", "f 1/999"), "names a UV outside the 63"),
    "nan": (lambda text: text.replace("vt ", "vt nan ", 1), "not finite"),
    "other faces": (
        lambda text: text.replace("f 1/1 2/2 10/10", "f 1/1 2/2 30/30"),
        "has no triangle with the vertices",
    ),
}


@pytest.mark.parametrize("case", OBJ_CASES)
def test_a_uv_layout_that_does_not_fit_is_refused(head_dir: Path, case: str) -> None:
    change, message = OBJ_CASES[case]
    file = head_dir / "head_template.obj"
    file.write_text(change(file.read_text()))
    with pytest.raises(UserError, match=message):
        load_head_assets(head_dir)


def test_files_that_are_missing_or_ambiguous(head_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    empty = tmp_path_factory.mktemp("empty")
    with pytest.raises(UserError, match="does not exist; give --head"):
        load_head_assets(empty / "nothing")
    with pytest.raises(UserError, match="holds no head model"):
        load_head_assets(empty)
    (head_dir / "generic_model.pkl").rename(head_dir / "flame2023.pkl")
    assert load_head_assets(head_dir).num_vertices == 63
    (head_dir / "flame2020.pkl").write_bytes((head_dir / "flame2023.pkl").read_bytes())
    with pytest.raises(UserError, match=r"several files that could be the head model \(flame2020.pkl, flame2023.pkl\)"):
        load_head_assets(head_dir)
    (head_dir / "head_template.obj").unlink()
    (head_dir / "FLAME_texture.npz").write_bytes(b"of no use here")
    (head_dir / "flame2023.pkl").unlink()
    with pytest.raises(UserError, match="no OBJ with a UV layout"):  # and none can be made of a patch
        load_head_assets(head_dir)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "l_eyelid.npy is empty"),
        (b"garbage", "l_eyelid.npy is damaged or holds no numpy arrays"),
        (b"\x93NUMPY\x01\x00", "l_eyelid.npy is damaged or holds no numpy arrays"),
    ],
)
def test_a_damaged_eyelid_file_is_named(head_dir: Path, content: bytes, message: str) -> None:
    (head_dir / "l_eyelid.npy").write_bytes(content)
    with pytest.raises(UserError, match=message):
        load_head_assets(head_dir)


@pytest.mark.parametrize(("indices", "outside"), [([1, 63], 63), ([-2, 1], -2)])
def test_a_region_outside_the_model_is_named(head_dir: Path, indices: list[int], outside: int) -> None:
    np.savez(head_dir / "masks.npz", lips=np.array(indices))
    with pytest.raises(UserError, match=f"region lips names vertex {outside}, but the model has 63"):
        load_head_assets(head_dir)


def test_masks_may_lie_in_the_folder_that_their_archive_makes(head_dir: Path) -> None:
    (head_dir / "FLAME_masks").mkdir()
    lips = np.array([5, 7, 40])
    (head_dir / "FLAME_masks" / "FLAME_masks.pkl").write_bytes(pickle.dumps({"lips": lips}))
    assert load_head_assets(head_dir).regions["lips"].tolist() == lips.tolist()


@pytest.mark.parametrize("kind", [bool, np.uint8, np.float32])
def test_a_region_may_say_it_of_every_vertex(head_dir: Path, kind: type) -> None:
    mask = np.zeros(63, kind)
    mask[[5, 7, 40]] = 1
    np.savez(head_dir / "masks.npz", lips=mask, face=np.array([1, 0]), head=np.arange(63))
    regions = load_head_assets(head_dir).regions
    assert regions["lips"].tolist() == [5, 7, 40] and regions["face"].tolist() == [0, 1]
    assert regions["head"].tolist() == list(range(63))


def test_a_region_of_shares_is_refused(head_dir: Path) -> None:
    np.savez(head_dir / "masks.npz", lips=np.full(63, 0.7))
    with pytest.raises(UserError, match="lips holds values that are no whole numbers"):
        load_head_assets(head_dir)


def test_faces_beside_the_uv_map_are_said(head_dir: Path) -> None:
    """As of a map in several tiles; a last corner on the edge is none."""
    assert not load_head_assets(head_dir).notes
    file = head_dir / "head_template.obj"
    lines = file.read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("vt "))
    for i in (first, first + 1, first + 9):  # the corners of the first face
        u, v = lines[i].split()[1:3]
        lines[i] = f"vt {float(u) + 1} {v}"
    file.write_text("\n".join(lines))
    (note,) = load_head_assets(head_dir).notes
    assert note.startswith("1 of 96 faces lie beside the UV map of head_template.obj")
