"""Exported splats, meshes and videos, read back with other libraries."""

from __future__ import annotations

import copy
import io
import math
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import cv2
import imageio.v3 as iio
import numpy as np
import pytest
import torch
import trimesh
from command_line import avatar
from lively import lively_avatar, lively_run, psnr
from splat_file import read_splats

from avatar.export.bake_texture import bake_texture
from avatar.export.glb import _end, encode_glb, offsets
from avatar.export.movie import path_camera
from avatar.export.ply import FIELDS, encode_ply
from avatar.export.web_arrays import reduce_avatar
from avatar.export.web_file import SMALL, quantised
from avatar.motion.orbit import seen_from
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.types import Camera


@pytest.fixture(scope="module")
def run(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return lively_run(tracked_folder, tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture(scope="module", params=["plain", "teeth"])
def trained(
    request: pytest.FixtureRequest,
    tracked_folder: Path,
    open_mouth_folder: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> TrainedAvatar:
    run = tmp_path_factory.mktemp("runs") / "run"
    if request.param == "teeth":
        return lively_avatar(open_mouth_folder, run, "model.teeth=true")
    return lively_avatar(tracked_folder, run)


def test_a_page_keeps_the_rotation_of_a_short_quaternion(trained: TrainedAvatar) -> None:
    avatar = copy.deepcopy(trained.avatar)
    with torch.no_grad():
        avatar.quats[:5] *= 1e-5
    whole, short = (reduce_avatar(replace(trained, avatar=one)).arrays["quats"] for one in (trained.avatar, avatar))
    np.testing.assert_allclose(short, whole, atol=1e-6)
    assert quantised(short, *SMALL["quats"])[0].any(axis=1).all()


def from_below(camera: Camera) -> Camera:
    """The camera for splats of which -y is up."""
    return replace(camera, R_cam_world=camera.R_cam_world * torch.tensor([-1.0, -1.0, 1.0]))


def test_splats_read_back_draw_the_same_picture(trained: TrainedAvatar) -> None:
    for i in (0, 7):
        params, camera = trained.recording.params(i), trained.recording.camera(i, 96)
        data = encode_ply(trained.gaussians(params, camera), "a\nb")
        assert tuple(re.findall(r"property float (\S+)", data[:4000].decode("latin-1"))) == FIELDS
        again = read_splats(data)
        assert again.sh.shape[1] == 16
        picture = trained.avatar.draw(again, from_below(camera), trained.background).image
        assert psnr(picture, trained.render(params, camera).image) > 50
    other = trained.avatar.draw(again, from_below(trained.recording.camera(0, 96)), trained.background).image
    assert psnr(other, trained.render(trained.recording.params(0), trained.recording.camera(0, 96)).image) < 40


@pytest.fixture
def converter() -> str:
    """PlayCanvas', which reads splats as SuperSplat does."""
    path = shutil.which("splat-transform")
    if path is None:
        pytest.skip("npm's @playcanvas/splat-transform is not installed")
    return path


def test_an_spz_of_the_splats_draws_nearly_the_same_picture(
    trained: TrainedAvatar, converter: str, tmp_path: Path
) -> None:
    params, camera = trained.rest_params(), trained.rest_camera()
    (tmp_path / "a.ply").write_bytes(encode_ply(trained.gaussians(params)))
    for before, after in (("a.ply", "a.spz"), ("a.spz", "b.ply")):
        subprocess.run([converter, "--gpu", "cpu", tmp_path / before, tmp_path / after], check=True)
    again = read_splats((tmp_path / "b.ply").read_bytes())
    picture = trained.avatar.draw(again, from_below(camera), trained.background).image
    assert psnr(picture, trained.render(params, camera).image) > 35


def test_a_viewers_reader_finds_the_head_upright(trained: TrainedAvatar, converter: str, tmp_path: Path) -> None:
    """The y of glTF is up."""
    gaussians = trained.gaussians(trained.rest_params())
    (tmp_path / "a.ply").write_bytes(encode_ply(gaussians))
    subprocess.run([converter, "--gpu", "cpu", tmp_path / "a.ply", tmp_path / "a.glb"], check=True)
    tree, buffer = gltf_parts((tmp_path / "a.glb").read_bytes())
    attributes = tree["meshes"][0]["primitives"][0]["attributes"]

    def values(name: str, width: int) -> np.ndarray:
        view = tree["bufferViews"][tree["accessors"][attributes[name]]["bufferView"]]
        return np.frombuffer(buffer, "<f4", len(gaussians.means) * width, view["byteOffset"]).reshape(-1, width)

    np.testing.assert_allclose(values("POSITION", 3), gaussians.means, atol=1e-6)
    quats = torch.nn.functional.normalize(gaussians.quats, dim=1).roll(-1, dims=1).numpy()
    same = np.abs((values("KHR_gaussian_splatting:ROTATION", 4) * quats).sum(axis=1))
    np.testing.assert_allclose(same, 1, atol=1e-5)
    for i in range(gaussians.sh.shape[1]):
        degree = math.isqrt(i)
        name = f"KHR_gaussian_splatting:SH_DEGREE_{degree}_COEF_{i - degree**2}"
        np.testing.assert_allclose(values(name, 3), gaussians.sh[:, i], atol=1e-6)


def test_the_command_writes_a_frame_and_a_sequence(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.ply"
    avatar("export", run, "--out", out, "--frame", 3)
    one = out.read_bytes()
    assert b"comment Nothing of the head model is in it" in one[:300]
    means = read_splats(one).means
    avatar("export", run, "--out", out, "--frame", 3, "--up=-y")
    assert out.read_bytes() == one
    avatar("export", run, "--out", out, "--frame", 3, "--up", "z")
    torch.testing.assert_close(read_splats(out.read_bytes()).means, means[:, [0, 2, 1]] * torch.tensor([-1, -1, -1]))
    said = avatar("export", run, "--out", out, "--motion", "all")
    sequence = sorted(tmp_path.glob("x-*.ply"))
    assert len(sequence) == 30 and sequence[3].read_bytes() == one != sequence[4].read_bytes()
    assert "x-00000.ply to x-00029.ply, 25 a second" in said
    said = avatar("export", run, "--out", out, "--motion", "test")
    shorter = sorted(tmp_path.glob("x-*.ply"))
    assert shorter == sequence[: len(shorter)] != sequence and f"Removed {sequence[len(shorter)]} to x-00029" in said
    assert "--frame must be from 0 to 29" in avatar("export", run, "--out", out, "--frame", 30, status=1)
    assert "give one of the two" in avatar("export", run, "--out", out, "--frame", 1, "--motion", "test", status=1)
    assert "or a drive file" in avatar("export", run, "--out", out, "--motion", "tset", status=1)
    assert "--up belongs to --format ply" in avatar("export", run, "--out", tmp_path / "x.glb", "--up", "y", status=1)
    assert "--camera belongs to --format video" in avatar("export", run, "--out", out, "--camera", "orbit", status=1)


def test_a_mesh_has_the_pose_the_texture_and_the_expressions(trained: TrainedAvatar) -> None:
    params = trained.recording.params(4)
    data, names = encode_glb(trained, params, 128, "a licence")
    scene = trimesh.load(io.BytesIO(data), file_type="glb")
    (mesh,) = scene.geometry.values()  # type: ignore[union-attr]
    posed = trained.avatar.head.vertices(params).numpy()
    corners = posed[trained.assets.faces.numpy()]
    np.testing.assert_allclose(mesh.vertices[mesh.faces], corners, atol=1e-6)
    uv = trained.assets.uvs.numpy()[trained.assets.uv_faces.numpy()]
    np.testing.assert_allclose(mesh.visual.uv[mesh.faces], uv, atol=1e-5)
    assert mesh.visual.material.baseColorTexture.size == (128, 128)
    tree, buffer = gltf_parts(data)
    assert tree["asset"]["copyright"] == "a licence"
    (gltf_mesh,) = tree["meshes"]
    assert tuple(gltf_mesh["extras"]["targetNames"]) == names and {"jaw", "left lid"} <= set(names)
    targets = gltf_mesh["primitives"][0]["targets"]
    assert len(targets) == len(names) == len(gltf_mesh["weights"])
    lid = accessor(tree, buffer, targets[names.index("left lid")]["POSITION"])
    moved = np.abs(trained.assets.eyelid_dirs[0].numpy()).max(axis=1)[trained.assets.faces.numpy()]
    assert ((np.abs(lid).max(axis=1)[mesh.faces] > 1e-7) <= (moved > 0)).all() and np.abs(lid).max() > 1e-4
    position = accessor(tree, buffer, gltf_mesh["primitives"][0]["attributes"]["POSITION"])
    assert position.shape == lid.shape
    np.testing.assert_allclose(position, mesh.vertices, atol=1e-6)


def test_a_mesh_whose_face_never_moved_has_no_empty_lists(trained: TrainedAvatar) -> None:
    """The schema of glTF asks for one entry or more in each."""
    rest, count = trained.rest_params(), len(trained.recording)
    still = {name: getattr(rest, name).expand(count, -1) for name in ("expression", "jaw", "eyes", "eyelids", "neck")}
    unmoved = replace(trained, recording=replace(trained.recording, tracks={**trained.recording.tracks, **still}))
    data, names = encode_glb(unmoved, rest, 16, "")
    (mesh,) = gltf_parts(data)[0]["meshes"]
    assert names == () and mesh["name"] == trained.name
    assert "weights" not in mesh and "targets" not in mesh["primitives"][0]


def test_a_mesh_is_smooth_where_its_texture_is_cut(trained: TrainedAvatar) -> None:
    tree, buffer = gltf_parts(encode_glb(trained, trained.rest_params(), 16, "")[0])
    attributes = tree["meshes"][0]["primitives"][0]["attributes"]
    places, normals = (accessor(tree, buffer, attributes[name]) for name in ("POSITION", "NORMAL"))
    _, first, of = np.unique(places, axis=0, return_index=True, return_inverse=True)
    assert len(first) < len(places)
    np.testing.assert_allclose(normals, normals[first[of.ravel()]], atol=1e-6)


def test_a_meshs_target_moves_one_joint_and_leaves_the_others(trained: TrainedAvatar) -> None:
    """Whatever the others do in the frame: eyelids add up."""
    params = trained.recording.params(4)
    shut = replace(params, eyelids=torch.tensor([float(params.eyelids[0]), 0.7]))
    of_open, of_shut = (offsets(trained, one)["left lid"] for one in (params, shut))
    assert float(of_open.abs().max()) > 1e-4
    torch.testing.assert_close(of_shut, of_open, atol=1e-6, rtol=0)


def test_a_target_goes_where_its_name_says_and_as_far_from_every_frame(trained: TrainedAvatar) -> None:
    assert _end(-2.4, 1.3) == (1.3, "") and _end(-0.8, 0.1) == (-0.8, " (reversed)") and _end(-0.16, 0.14) == (0.14, "")
    rest, head = trained.rest_params(), trained.avatar.head
    control = trained.expression_controls()[0]
    frame = replace(rest, expression=rest.expression + 0.5 * control.high * control.direction)
    name = f"{control.part}: {control.name}"
    of_frame, of_rest = (head.vertices(one) + offsets(trained, one)[name] for one in (frame, rest))
    assert float((head.vertices(frame) - head.vertices(rest)).abs().max()) > 1e-4
    torch.testing.assert_close(of_frame, of_rest, atol=1e-6, rtol=0)


def gltf_parts(data: bytes) -> tuple[dict, bytes]:
    import json

    length = int.from_bytes(data[12:16], "little")
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def accessor(tree: dict, buffer: bytes, index: int) -> np.ndarray:
    found = tree["accessors"][index]
    view = tree["bufferViews"][found["bufferView"]]
    values = np.frombuffer(buffer, "<f4", 3 * found["count"], view.get("byteOffset", 0)).reshape(-1, 3)
    np.testing.assert_allclose(values.min(axis=0), found["min"], atol=1e-6)
    np.testing.assert_allclose(values.max(axis=0), found["max"], atol=1e-6)
    return values


def test_the_texture_is_what_is_seen(trained: TrainedAvatar) -> None:
    """The textured mesh, drawn from the front, looks like the avatar where the avatar is its mesh."""
    params, camera = trained.rest_params(), trained.rest_camera(96)
    with torch.no_grad():
        flat = lively_copy(trained)
    texture = bake_texture(flat, params, 256)
    from avatar.head.rasterize import rasterize_mesh

    assets = trained.assets
    vertices = camera.project(trained.avatar.vertices(params)).numpy()
    raster = rasterize_mesh(vertices, assets.faces.numpy(), 96, 96)
    uv = (assets.uvs.numpy()[assets.uv_faces.numpy()][raster.face_id] * raster.barycentric[..., None]).sum(axis=2)
    drawn = cv2.remap(
        texture, (uv[..., 0] * 256 - 0.5).astype(np.float32), ((1 - uv[..., 1]) * 256 - 0.5).astype(np.float32), 1
    )
    picture = flat.render(params, camera).image.clamp(0, 1).numpy()
    inside = cv2.erode((raster.face_id >= 0).astype(np.uint8), np.ones((9, 9))).astype(bool)
    error = np.abs(drawn / 255 - picture)[inside]
    contrast = np.abs(picture - picture[inside].mean(axis=0))[inside]
    assert error.mean() < 0.35 * contrast.mean()


def lively_copy(trained: TrainedAvatar) -> TrainedAvatar:
    """The same avatar with opaque Gaussians whose colour changes slowly over the mesh."""
    import copy

    model = copy.deepcopy(trained.avatar)
    points = model.embedding.points(model.mesh.neutral_vertices())
    model.sh_dc[:, 0] = 1.5 * torch.sin(points * 60)
    model.sh_rest.zero_()
    for parameter in (*model.deformation.parameters(), *model.hyper.parameters()):  # on the mesh
        parameter.zero_()
    model.log_scales.fill_(float(torch.log(torch.tensor(0.004))))
    model.opacity_logits.fill_(4.0)
    return replace(trained, avatar=model)


def test_paths_stay_where_the_training_video_was(trained: TrainedAvatar) -> None:
    rest = trained.rest_camera()
    limits = trained.orbit_limits(rest)
    own = seen_from(rest)
    turns = [seen_from(path_camera(rest, limits, "swing", s / 10)).yaw - own.yaw for s in range(60)]
    assert min(turns) == pytest.approx(-limits.yaw[1], abs=0.2) and max(turns) == pytest.approx(-limits.yaw[0], abs=0.2)
    assert max(turns) - min(turns) > 4
    heights = [path_camera(rest, limits, "orbit", s / 10) for s in range(60)]
    elevations = [seen_from(camera).elevation - own.elevation for camera in heights]
    assert max(elevations) - min(elevations) > 4 and max(elevations) < limits.pitch[1] + 1
    assert path_camera(rest, limits, "still", 1.0) == rest


def test_the_command_writes_videos(run: Path, tracked_folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.mp4"
    avatar("export", run, "--out", out, "--motion", "all", "--size", 64)
    recorded = iio.imread(out)
    assert recorded.shape == (30, 64, 64, 3)
    avatar("export", run, "--out", out, "--motion", "all", "--size", 64, "--camera", "swing")
    turned = iio.imread(out)
    assert turned.shape == recorded.shape and np.abs(turned.astype(int) - recorded).mean() > 1
    csv = tmp_path / "drive.csv"
    csv.write_text("time,expression_0,jaw_x,jaw_y,jaw_z\n0,0,0,0,0\n0.1,0.5,0.1,0,0\n")
    avatar("export", run, "--out", out, "--motion", csv, "--size", 48, "--camera", "still")
    assert iio.imread(out).shape == (2, 48, 48, 3)
    assert "--size must be from" in avatar("export", run, "--out", out, "--size", 100000, status=1)
    before = csv.read_bytes()
    avatar("export", run, "--format", "video", "--out", csv, "--motion", csv, status=1)
    assert csv.read_bytes() == before
