"""Cameras around the demo person: where they stand, what they see, and the lights that stay where they are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from listed_views import CAMERAS, FRAMES, FRONT, NAMES, SEED, SIZE, View, drawn, posed, views

from avatar.demo.cameras import front_camera, studio_cameras
from avatar.demo.performance import frame_camera, frame_params, perform
from avatar.demo.render import VIEW_AXES, renderer_of
from avatar.head.assets import HeadAssets
from avatar.types import Camera


def profile_error(assets: HeadAssets, seen: View, side: int) -> float:
    """Mean distance in pixels of the model's outline from the matte's between nose and chin, on the left (0) or right (-1).

    No hair stands before the face: there the outlines are the same.
    """
    vertices, joint = posed(assets, seen.flame)
    R, t = seen.of_head(joint)
    lips = vertices[assets.regions["lips"].numpy()].mean(0)
    p = (lips + np.array([[0, 0.04, 0], [0, -0.02, 0]])) @ R.T + t
    top, bottom = (p[:, 1] / p[:, 2] * seen.K[1, 1] + seen.K[1, 2]).astype(int)
    mesh, matte = drawn(assets, seen), seen.matte > 127
    columns = [[np.flatnonzero(mask[row])[side] for row in range(top, bottom)] for mask in (mesh, matte)]
    return float(np.abs(np.subtract(*columns)).mean())


def chin_row(assets: HeadAssets, seen: View) -> int:
    """The row of the picture that is 4 cm below the lips."""
    vertices, joint = posed(assets, seen.flame)
    R, t = seen.of_head(joint)
    p = R @ (vertices[assets.regions["lips"].numpy()].mean(0) - (0, 0.04, 0)) + t
    return int(p[1] / p[2] * seen.K[1, 1] + seen.K[1, 2])


@pytest.mark.parametrize("name", NAMES)
def test_the_listed_head_lies_on_the_matte_of_each_camera(name: str, camera_folder: Path, assets: HeadAssets) -> None:
    for entry, seen in views(camera_folder, name):
        mesh = drawn(assets, seen).astype(np.uint8)
        inner = cv2.erode(mesh, np.ones((3, 3), np.uint8)) > 0
        inner[chin_row(assets, seen) :] = False  # the neck goes on under the collar, where the matte ends
        assert inner.sum() > 0.1 * SIZE**2 and (seen.matte[inner] > 127).all()
        if entry["camera_index"] != FRONT:  # the others see the face in profile
            assert profile_error(assets, seen, -1 if entry["camera_index"] == 0 else 0) < 0.6


def test_the_principal_point_is_off_the_centre_and_cy_counted_from_the_bottom(
    camera_folder: Path, assets: HeadAssets
) -> None:
    points = {(entry["cx"], entry["cy"]) for entry, _ in views(camera_folder, "SPEECH")}
    assert len(points) == CAMERAS
    for entry, seen in views(camera_folder, "SPEECH"):
        assert abs(entry["cy"] - SIZE / 2) > 0.015 * SIZE and abs(entry["cx"] - SIZE / 2) > 0.015 * SIZE
        if entry["camera_index"] == 0:
            from_the_top = seen.K.copy()
            from_the_top[1, 2] = entry["cy"]
            assert profile_error(assets, seen._replace(K=from_the_top), -1) > 1.0


def test_a_sequence_has_a_world_of_its_own_and_the_same_cameras(camera_folder: Path) -> None:
    cameras = [[seen for entry, seen in views(camera_folder, name) if entry["timestep_index"] == 0] for name in NAMES]
    for one in cameras[1:]:
        for seen, first in zip(one, cameras[0], strict=True):
            assert np.linalg.norm(seen.t - first.t) > 0.02 and np.abs(seen.R - first.R).max() > 0.05
            np.testing.assert_array_equal(seen.K, first.K)
            # From the front camera to this one: the same in both sequences.
            turn = seen.R @ one[FRONT].R.T
            np.testing.assert_allclose(turn, first.R @ cameras[0][FRONT].R.T, atol=1e-9)
            np.testing.assert_allclose(seen.t - turn @ one[FRONT].t, first.t - turn @ cameras[0][FRONT].t, atol=1e-9)


def test_the_front_camera_stands_where_the_camera_of_one_video_does(camera_folder: Path, assets: HeadAssets) -> None:
    for take, (name, motion) in enumerate(zip(NAMES, ("speech", "gaze", "turn"), strict=True)):
        performance = perform(SEED, FRAMES, motion, take)
        for entry, seen in views(camera_folder, name):
            time = entry["timestep_index"]
            single = frame_camera(performance, time, SIZE)
            R, t = seen.of_head(posed(assets, seen.flame)[1])
            place, expected = -R.T @ t, -(single.R_cam_world.T @ single.t_cam_world).numpy()
            assert (np.linalg.norm(place - expected) < 2e-6) == (entry["camera_index"] == FRONT)
            assert entry["fl_x"] == pytest.approx(single.fx)
            np.testing.assert_array_equal(seen.flame["expr"][0], frame_params(performance, time).expression)


def test_nobody_blinks_since_the_layout_has_no_eyelids(camera_folder: Path) -> None:
    renderer, performance = renderer_of(SEED), perform(SEED, FRAMES, "speech")
    single, params = frame_camera(performance, 0, SIZE), frame_params(performance, 0)
    pose = VIEW_AXES @ single.R_cam_world.numpy(), VIEW_AXES @ single.t_cam_world.numpy()
    front = studio_cameras(CAMERAS, SIZE)[FRONT]
    written = cv2.imread(str(camera_folder / "SPEECH" / "images" / f"00000_{FRONT:02d}.png"))
    assert written is not None and params.eyelids.max() > 0.05
    for lids, is_written in ((torch.zeros(2), True), (params.eyelids, False)):
        picture = renderer.render_scene(renderer.pose_scene(replace(params, eyelids=lids), *pose), front)
        assert np.array_equal(picture.image, written[..., ::-1]) == is_written


def test_cameras_stand_over_120_degrees_and_the_ninth_of_16_in_front() -> None:
    for count in (2, 3, 16, 64):
        cameras = studio_cameras(count, SIZE)
        away = [-(camera.R_cam_world.T @ camera.t_cam_world).numpy() + (0, 0, 1) for camera in cameras]
        assert np.linalg.norm(away, axis=1) == pytest.approx(1.0)
        azimuth = np.degrees([np.arctan2(x, z) for x, _, z in away])
        elevation = np.degrees(np.arcsin([y for _, y, _ in away]))
        assert azimuth[0] == pytest.approx(-60) and azimuth[-1] == pytest.approx(60 if count > 2 else 0)
        assert (np.diff(azimuth) > 0).all() and np.abs(elevation).max() < 10.001
        assert abs(azimuth[front_camera(count)]) < 1e-9 and abs(elevation[front_camera(count)]) < 1e-9
        for camera in cameras:  # the head is in the middle of the picture
            seen = camera.project(torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64))
            assert seen.tolist() == pytest.approx([SIZE / 2, SIZE / 2, 1.0], rel=1e-3)
    assert front_camera(16) == 8


def test_lights_stand_still_in_the_studio_while_cameras_move() -> None:
    renderer, size = renderer_of(SEED), 96
    performance = perform(SEED, 1, "speech")
    params, single = frame_params(performance, 0), frame_camera(performance, 0, size)
    R, t = VIEW_AXES @ single.R_cam_world.numpy(), VIEW_AXES @ single.t_cam_world.numpy()
    scene = renderer.pose_scene(params, R, t)
    front = replace(single, R_cam_world=torch.from_numpy(VIEW_AXES), t_cam_world=torch.zeros(3))
    for mine, theirs in zip(renderer.render_scene(scene, front), renderer.render(params, single), strict=True):
        np.testing.assert_array_equal(mine, theirs)

    aside = studio_cameras(16, size)[12]
    beside_head = replace(
        aside,
        R_cam_world=aside.R_cam_world @ torch.from_numpy(R).double(),
        t_cam_world=aside.R_cam_world @ torch.from_numpy(t).double() + aside.t_cam_world,
    )
    face = renderer.performer.head.regions["face"]
    face = face[(scene.surface[face][:, :3] @ [0.3, 0.0, 0.95]) > 0.8]  # what both cameras see
    points = torch.from_numpy(scene.geometry.points[face] @ R.T + t)

    def brightness(image: np.ndarray, camera: Camera) -> np.ndarray:
        x, y = camera.project(points.to(camera.R_cam_world)).numpy()[:, :2].astype(int).T
        return image[y, x].mean(-1)

    seen = brightness(renderer.render_scene(scene, front).image, front)
    still = brightness(renderer.render_scene(scene, aside).image, aside) - seen
    carried = brightness(renderer.render(params, beside_head).image, aside) - seen  # the camera's own lights
    assert len(face) > 100 and np.abs(still).mean() < 0.7 * np.abs(carried).mean()
