"""Skin and clothes by the colours of a clip."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from avatar.demo.identity import sample_identity
from avatar.demo.performance import frame_camera, frame_params, perform
from avatar.demo.render import Renderer
from data_prep.track.masks.clothes import learn_colours
from data_prep.track.masks.head_and_mouth import head_mask, neck_ring
from data_prep.track.masks.neck_zones import Zones, zones_of

SIZE = 256
COLLAR = (-0.1, 0.14)  # heights above the neck ring


@pytest.fixture(scope="module", params=[1.0, 0.45], ids=["", "in the shade"])
def clip(request: pytest.FixtureRequest) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, Zones]]:
    """Picture, matte, true head without the collar, and zones of frames whose clothes reach up the mesh's neck."""
    renderer = Renderer(sample_identity(2))
    model, performance = renderer.performer.model, perform(2, 40, "turn")
    faces = model.faces.numpy()
    ring = neck_ring(model.assets.template.numpy(), faces)
    frames = []
    for frame in (0, 13, 26, 39):
        params, camera = frame_params(performance, frame), frame_camera(performance, frame, SIZE)
        picture = renderer.render(params, camera)
        with torch.no_grad():
            screen = camera.project(model.vertices(params)).numpy()
        bare = zones_of(picture.image, picture.alpha, screen, faces, ring)
        cloth = picture.image[bare.outside & bare.person & (picture.head < 128) & (bare.level < 0.2)]
        collar = (picture.head > 127) & (bare.level > COLLAR[0]) & (bare.level < COLLAR[1])
        image = picture.image.copy()
        texture = cloth[np.random.default_rng(frame).integers(len(cloth), size=np.count_nonzero(collar))]
        image[collar] = np.rint(request.param * texture)
        head = (picture.head > 127) & (bare.level >= COLLAR[1])
        frames.append((image, picture.alpha, head, zones_of(image, picture.alpha, screen, faces, ring)))
    return frames


def test_a_collar_on_the_meshs_neck_is_clothes(clip: list[tuple[np.ndarray, np.ndarray, np.ndarray, Zones]]) -> None:
    colours = learn_colours(zones for *_, zones in clip)
    assert colours is not None
    for image, matte, head, zones in clip:
        collar = zones.body & zones.person & (zones.level > 0.0) & (zones.level < COLLAR[1] - 0.04)
        mask = head_mask(image, matte, zones, colours).mask > 127
        assert collar.sum() > 300 and mask[collar].mean() < 0.05
        assert (mask & head).sum() / (mask | head).sum() > 0.97


def test_each_colour_is_told_from_the_other(clip: list[tuple[np.ndarray, np.ndarray, np.ndarray, Zones]]) -> None:
    colours = learn_colours(zones for *_, zones in clip)
    assert colours is not None
    _, _, _, zones = clip[0]
    shoulders = zones.person & zones.outside & (zones.level < 0.0)
    face = zones.inside & zones.person & (zones.level > 0.5) & (zones.level < 0.9)
    assert colours.head_share(zones.image, shoulders).mean() < 0.1
    assert colours.head_share(zones.image, face).mean() > 0.95


def test_without_clothes_or_face_nothing_is_learned(
    clip: list[tuple[np.ndarray, np.ndarray, np.ndarray, Zones]],
) -> None:
    _, _, _, zones = clip[0]
    assert learn_colours([]) is None
    assert learn_colours([zones._replace(person=zones.person & zones.body)]) is None
    assert learn_colours([zones._replace(person=zones.person & ~zones.body)]) is None


def test_pictures_of_one_colour_are_all_head(clip: list[tuple[np.ndarray, np.ndarray, np.ndarray, Zones]]) -> None:
    """Of two equal colours neither is likelier."""
    _, _, _, zones = clip[0]
    grey = zones._replace(image=np.full_like(zones.image, 90))
    colours = learn_colours([grey])
    assert colours is not None and colours.head_share(grey.image, grey.person).min() > 0.9
