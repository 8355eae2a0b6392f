"""The fit to landmarks and then to pictures, on the demo's person whose motion is known; without MediaPipe."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from spoken_scene import DRIFT, NOISE, SIZE, Scene, drawn, spoken_scene

from avatar.demo.render import RenderedFrame
from avatar.head.expression_names import load_expression_names
from avatar.head.model import HeadModel
from data_prep.projection import project_head
from data_prep.track import photometric_fit
from data_prep.track.camera import to_camera
from data_prep.track.fit_result import Clip
from data_prep.track.fitting import as_tracks
from data_prep.track.landmark_fit import LandmarkFit, fit_landmarks
from data_prep.track.motion import Motion
from data_prep.track.photometric_fit import fit_pictures

FRAMES = 16


@dataclass(frozen=True)
class Fitted:
    seen: Scene
    pictures: list[RenderedFrame]
    fit: LandmarkFit

    def error(self, motion: Motion) -> float:
        return self.seen.error(self.fit, motion)


@pytest.fixture(scope="module")
def scene(demo_head_model: Path) -> Fitted:
    seen = spoken_scene(demo_head_model, FRAMES)
    fit = fit_landmarks(seen.assets, seen.names, seen.embedding, seen.landmarks, seen.camera)
    return Fitted(seen, drawn(FRAMES), fit)


def pictures_of(scene: Fitted, change=lambda image: image):
    shown = [change(picture.image) for picture in scene.pictures]
    return shown.__getitem__, [picture.alpha for picture in scene.pictures].__getitem__


def quiet(items, total, title):
    return items


def test_the_landmarks_are_met(scene: Fitted) -> None:
    errors = scene.fit.term.errors(scene.fit.identity, scene.fit.motion)
    assert 100 * float(errors.mean()) / scene.seen.eyes < 200 * NOISE
    assert scene.error(scene.fit.motion) < 100 * DRIFT
    for costs in scene.fit.costs:
        assert len(costs) > 1 and list(costs) == sorted(set(costs), reverse=True)
    assert float(scene.fit.identity.abs().max()) < 4.0
    assert not scene.fit.motion.neck.any()


def test_the_fit_repeats_to_the_bit(scene: Fitted, demo_head_model: Path) -> None:
    names = load_expression_names(demo_head_model, scene.seen.assets.num_expressions)
    seen = scene.seen.landmarks
    few = replace(seen, points=seen.points[:4], scores=seen.scores[:4], detected=seen.detected[:4])
    fits = [fit_landmarks(scene.seen.assets, names, scene.seen.embedding, few, scene.seen.camera) for _ in range(2)]
    assert torch.equal(fits[0].motion.R, fits[1].motion.R) and torch.equal(fits[0].identity, fits[1].identity)


def test_pictures_bring_frames_nearer_to_the_truth(scene: Fitted) -> None:
    done = fit_pictures(scene.seen.assets, scene.fit, scene.seen.camera, *pictures_of(scene), quiet)
    assert done.is_taken and done.after > done.before + 2.0
    assert scene.error(done.motion) < 0.5 * scene.error(scene.fit.motion)


def test_pictures_that_say_nothing_are_not_believed(scene: Fitted) -> None:
    rng = np.random.default_rng(0)
    noise = pictures_of(scene, lambda image: rng.integers(0, 256, image.shape).astype(np.uint8))
    done = fit_pictures(scene.seen.assets, scene.fit, scene.seen.camera, *noise, quiet)
    assert not done.is_taken and done.motion is scene.fit.motion


def test_what_the_held_out_points_gain_little_by_is_not_taken(scene: Fitted, monkeypatch: pytest.MonkeyPatch) -> None:
    figures = iter((30.0, 31.1))
    monkeypatch.setattr(photometric_fit, "_psnr", lambda *_: next(figures))
    done = fit_pictures(scene.seen.assets, scene.fit, scene.seen.camera, *pictures_of(scene), quiet)
    assert not done.is_taken and done.motion is scene.fit.motion


def test_tracks_place_the_head_where_the_fit_has_it(scene: Fitted) -> None:
    clip, fit = Clip(scene.seen.landmarks, tuple(scene.seen.camera), [], []), scene.fit
    tracks = as_tracks(fit, fit.motion, clip, scene.seen.assets.num_expressions)
    assert list(tracks) == list(range(FRAMES))
    expected = scene.seen.camera.project(
        to_camera(fit.motion, fit.term.points.positions(fit.identity, fit.motion))
    ).numpy()
    row_of = {int(landmark): row for row, landmark in enumerate(scene.seen.embedding.landmarks)}
    rows = [row_of[int(landmark)] for landmark in fit.term.landmarks]
    head = HeadModel(scene.seen.assets, torch.from_numpy(tracks[0].shape).float())
    for n in (0, 7, FRAMES - 1):
        screen = project_head(head, tracks[n], tracks[n].intrinsics, SIZE, SIZE)[:, :2]
        placed = (screen[scene.seen.embedding.corners] * scene.seen.embedding.barycentric[..., None]).sum(1)
        np.testing.assert_allclose(placed[rows], expected[n], atol=0.01)
