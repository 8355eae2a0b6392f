"""Head and mouth masks, against the demo person's own."""

from __future__ import annotations

import functools

import cv2
import numpy as np
import pytest
import torch
from skimage.segmentation import find_boundaries

from avatar.data.subject import FAINTEST_MATTE
from avatar.demo.identity import sample_identity
from avatar.demo.performance import frame_camera, frame_params, perform
from avatar.demo.render import Renderer
from avatar.errors import UserError
from data_prep.check.overlay import draw_mesh, outline
from data_prep.prepare.mask_overlap import Mesh
from data_prep.track.faces.landmark_groups import OUTER_LIPS
from data_prep.track.masks.clothes import learn_colours
from data_prep.track.masks.head_and_mouth import head_mask, mouth_mask, neck_ring
from data_prep.track.masks.neck_zones import zones_of

SIZE = 256


@functools.cache
def renderer_of(seed: int) -> Renderer:
    return Renderer(sample_identity(seed))


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


@pytest.mark.parametrize("seed", [1, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 3))])
@pytest.mark.parametrize("shift", [0, 6])
def test_the_head_without_its_clothes(seed: int, shift: int) -> None:
    """Also where the mesh lies 6 of 256 pixels aside, as fits do."""
    renderer = renderer_of(seed)
    performance = perform(seed, 40, "turn")
    model = renderer.performer.model
    faces, template = model.faces.numpy(), model.assets.template.numpy()
    ring = neck_ring(template, faces)
    clip = []
    for frame in (0, 20):
        params, camera = frame_params(performance, frame), frame_camera(performance, frame, SIZE)
        picture = renderer.render(params, camera)
        with torch.no_grad():
            screen = camera.project(model.vertices(params)).numpy()
        zones = zones_of(picture.image, picture.alpha, screen + np.array([shift, 0, 0]), faces, ring)
        clip.append((picture, screen, zones))
    colours = learn_colours(zones for _, _, zones in clip)
    for picture, screen, zones in clip:
        made = head_mask(picture.image, picture.alpha, zones, colours)
        share, truth = made.mask / 255.0 * (picture.alpha / 255.0), picture.head / 255.0
        assert iou(share > 0.5, truth > 0.5) > 0.995
        assert made.overlap > (0.99 if shift == 0 else 0.9)
        # Along the person's outline the matte is soft, and the mask as large as the matte.
        above = (zones.level > 1.0) & (picture.alpha >= FAINTEST_MATTE)
        assert (made.mask[above] == 255).all() and ((picture.alpha < 250) & above).sum() > 50
        clothes = ((picture.alpha > 127) & (picture.head < 128)).astype(np.uint8)
        collar = cv2.dilate(clothes, np.ones((9, 9))) > 0
        length = (cv2.dilate(clothes, np.ones((3, 3))) > 0)[picture.head > 127].sum()
        assert np.abs(share - truth)[collar].sum() < 0.15 * length
        # A matte that is empty, and a mesh that is elsewhere, make no mask and no noise.
        nobody = zones_of(picture.image, 0 * picture.alpha, screen, faces, ring)
        assert not head_mask(picture.image, 0 * picture.alpha, nobody).mask.any()
        elsewhere = zones_of(picture.image, picture.alpha, screen + np.array([2000.0, 0, 0]), faces, ring)
        assert head_mask(picture.image, picture.alpha, elsewhere).overlap == 0.0


@pytest.mark.parametrize(("width", "height"), [(512, 512), (550, 802), (1280, 720)])
def test_heights_are_along_the_heads_axis_whatever_the_picture(width: int, height: int) -> None:
    model = renderer_of(1).performer.model
    template, faces = model.assets.template.numpy(), model.faces.numpy()
    ring, roll = neck_ring(template, faces), np.radians(20)
    flat = (template[:, :2] - template[:, :2].mean(0)) * [1, -1] * 0.5 * min(width, height) / np.ptp(template[:, 1])
    turned = flat @ np.array([[np.cos(roll), np.sin(roll)], [-np.sin(roll), np.cos(roll)]]) + [width / 2, height / 2]
    screen = np.column_stack((turned, 1 - 0.1 * template[:, 2]))
    image = np.zeros((height, width, 3), np.uint8)
    zones = zones_of(image, image[..., 0], screen, faces, ring)
    gy, gx = (float(slope.mean()) for slope in np.gradient(zones.level))
    axis = turned.mean(0) - turned[ring].mean(0)
    assert np.arctan2(gx / width, -gy / height) == pytest.approx(np.arctan2(axis[0], -axis[1]), abs=1e-6)


@pytest.mark.slow
def test_masks_repeat() -> None:
    renderer = renderer_of(1)
    performance = perform(1, 2, "speech")
    params, camera = frame_params(performance, 1), frame_camera(performance, 1, SIZE)
    picture = renderer.render(params, camera)
    model = renderer.performer.model
    with torch.no_grad():
        screen = camera.project(model.vertices(params)).numpy()
    ring = neck_ring(model.assets.template.numpy(), model.faces.numpy())
    zones = zones_of(picture.image, picture.alpha, screen, model.faces.numpy(), ring)
    first = head_mask(picture.image, picture.alpha, zones, learn_colours([zones])).mask
    cv2.randu(np.zeros((9, 9), np.uint8), 0, 255)  # others use OpenCV's random numbers
    again = head_mask(picture.image, picture.alpha, zones, learn_colours([zones])).mask
    np.testing.assert_array_equal(first, again)


def test_the_ring_is_the_lowest_open_edge() -> None:
    # Two open tubes of triangles, one above the other.
    def tube(y: float, first: int) -> tuple[np.ndarray, np.ndarray]:
        turn = np.arange(6) * np.pi / 3
        rows = [np.stack((np.cos(turn), np.full(6, h), np.sin(turn)), 1) for h in (y, y + 1)]
        a = first + np.arange(6)
        b = first + (np.arange(6) + 1) % 6
        return np.concatenate(rows), np.concatenate((np.stack((a, b, b + 6), 1), np.stack((a, b + 6, a + 6), 1)))

    (high, high_faces), (low, low_faces) = tube(5, 0), tube(0, 12)
    points, faces = np.concatenate((high, low + np.array([0, 0, 1]))), np.concatenate((high_faces, low_faces))
    assert sorted(neck_ring(points, faces).tolist()) == list(range(12, 18))
    tetrahedron = np.array([(0, 1, 2), (0, 3, 1), (0, 2, 3), (1, 3, 2)])
    with pytest.raises(UserError, match="closed everywhere"):
        neck_ring(np.zeros((4, 3)), tetrahedron)


def test_outlines_are_the_inner_pixels_of_the_mask() -> None:
    noise = cv2.GaussianBlur(np.random.default_rng(0).random((40, 50)), (0, 0), 2)
    mask, canvas = noise > 0.5, np.zeros((40, 50, 3), np.uint8)
    outline(canvas, mask, (1, 2, 3))
    np.testing.assert_array_equal(canvas[..., 2] == 3, find_boundaries(mask, mode="inner"))
    assert mask[0].any()  # the picture's border is none of the mask's


def test_every_edge_that_faces_the_camera_is_drawn_and_no_other() -> None:
    screen = np.array([[4, 4, 1], [4, 30, 1], [30, 30, 1], [30, 4, 1], [50, 4, 1]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3], [3, 2, 4][::-1]])  # the last one looks away
    drawn = draw_mesh(np.zeros((40, 60, 3), np.uint8), Mesh(screen, faces[[0, 2]], faces, faces[:0])).any(-1)
    assert drawn[15, 3:5].any() and drawn[28:31, 15].any() and not drawn[:, 35:].any()
    assert not drawn[3:5, 15].any()  # the edge from 0 to 3 belongs to the second face alone


def test_the_mouth_is_inside_the_lips_outline() -> None:
    points = np.zeros((478, 3), np.float32)
    turn = np.linspace(0, 2 * np.pi, len(OUTER_LIPS), endpoint=False)
    points[list(OUTER_LIPS), 0], points[list(OUTER_LIPS), 1] = 60 + 30 * np.cos(turn), 40 + 12 * np.sin(turn)
    mask = mouth_mask(points, 128, 96)
    rows, columns = np.nonzero(mask)
    assert (columns.mean() + 0.5, rows.mean() + 0.5) == pytest.approx((60, 40), abs=0.3)
    assert (mask > 0).sum() == pytest.approx(np.pi * 30 * 12, rel=0.06) and mask.dtype == np.uint8
    assert not mouth_mask(points + np.float32(1e9), 128, 96).any()
