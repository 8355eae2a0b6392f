"""The fit to landmarks and then to pictures, on the demo's person whose motion is known; without MediaPipe."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from avatar.demo.identity import sample_identity
from avatar.demo.motion import frame_camera, frame_params, perform
from avatar.demo.render import RenderedFrame, render_frame
from avatar.head.assets import HeadAssets, load_head_assets
from avatar.head.expression_names import load_expression_names
from avatar.head.model import HeadModel
from data_prep.projection import project_head
from data_prep.track import photometric_fit
from data_prep.track.camera import Pinhole, to_camera
from data_prep.track.embedding import LandmarkEmbedding, iris_embedding
from data_prep.track.fit_result import Clip
from data_prep.track.fitting import as_tracks
from data_prep.track.landmark_fit import LandmarkFit, fit_landmarks
from data_prep.track.landmark_groups import FEATURES
from data_prep.track.landmarks import BLENDSHAPES, NUM_POINTS, Landmarks
from data_prep.track.motion import Motion
from data_prep.track.photometric_fit import fit_pictures
from data_prep.track.surface import SurfacePoints

FRAMES, SIZE, SEED = 16, 160, 1
NOISE = 0.012  # of the distance between the eyes: the landmarks' own
DRIFT = 0.03  # all landmarks of a frame together, as detectors err


@dataclass(frozen=True)
class Scene:
    assets: HeadAssets
    pictures: list[RenderedFrame]
    camera: Pinhole
    screens: np.ndarray  # [T, V, 2] true vertices in pixels
    landmarks: Landmarks
    embedding: LandmarkEmbedding
    fit: LandmarkFit
    eyes: float  # pixels between the irises

    def error(self, motion: Motion) -> float:
        """Of the face's vertices against the truth, but for what is the same in all frames; per cent of the eyes'."""
        face = self.assets.regions["face"]
        alone = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64).expand(len(face), 3)
        points = SurfacePoints(
            self.assets, face[:, None].expand(-1, 3), alone, len(self.fit.identity), self.fit.expressions
        )
        placed = self.camera.project(to_camera(motion, points.positions(self.fit.identity, motion))).numpy()
        residual = placed - self.screens[:, face.numpy()]
        return 100 * float(np.linalg.norm(residual - residual.mean(0), axis=-1).mean()) / self.eyes


@pytest.fixture(scope="module")
def scene(demo_head_model: Path) -> Scene:
    assets = load_head_assets(demo_head_model)
    head = HeadModel(assets, torch.from_numpy(sample_identity(SEED).shape).float())
    performance, rng = perform(SEED, 40, "speech"), np.random.default_rng(0)
    face = assets.regions["face"].numpy()
    chosen = rng.choice(face, len(FEATURES), replace=False)
    embedding = LandmarkEmbedding(
        np.array(FEATURES), np.repeat(chosen[:, None], 3, axis=1), np.tile([1.0, 0.0, 0.0], (len(chosen), 1))
    )
    everything = embedding.with_others(iris_embedding(assets))
    screens, pictures = [], []
    points = np.zeros((FRAMES, NUM_POINTS, 3), np.float32)
    for n in range(FRAMES):
        params, camera = frame_params(performance, n), frame_camera(performance, n, SIZE)
        pictures.append(render_frame(SEED, params, camera))
        with torch.no_grad():
            screens.append(camera.project(head.vertices(params)).numpy()[:, :2])
        placed = (screens[-1][everything.corners] * everything.barycentric[..., None]).sum(1)
        points[n, everything.landmarks, :2] = placed
    eyes = float(np.linalg.norm(points[:, 473, :2] - points[:, 468, :2], axis=1).mean())
    points[..., :2] += NOISE * eyes * rng.standard_normal(points[..., :2].shape)
    drift = np.sin(np.arange(FRAMES)[:, None] * np.array([0.9, 1.3]))
    points[..., :2] += (DRIFT * eyes * drift)[:, None]
    scores = np.zeros((FRAMES, len(BLENDSHAPES)), np.float32)
    scores[:, BLENDSHAPES.index("jawOpen")] = np.clip(performance.jaw[:FRAMES] / 0.3, 0, 1)
    for side, name in enumerate(("eyeBlinkLeft", "eyeBlinkRight")):
        scores[:, BLENDSHAPES.index(name)] = np.clip(performance.eyelids[:FRAMES, side], 0, 1)
    landmarks = Landmarks(points, scores, np.ones(FRAMES, bool), (SIZE, SIZE), 25.0)
    pinhole = Pinhole(camera.fx, camera.fy, camera.cx, camera.cy)
    names = load_expression_names(demo_head_model, assets.num_expressions)
    fit = fit_landmarks(assets, names, embedding, landmarks, pinhole)
    return Scene(assets, pictures, pinhole, np.stack(screens), landmarks, everything, fit, eyes)


def pictures_of(scene: Scene, change=lambda image: image):
    shown = [change(picture.image) for picture in scene.pictures]
    return shown.__getitem__, [picture.alpha for picture in scene.pictures].__getitem__


def quiet(items, total, title):
    return items


def test_the_landmarks_are_met(scene: Scene) -> None:
    errors = scene.fit.term.errors(scene.fit.identity, scene.fit.motion)
    assert 100 * float(errors.mean()) / scene.eyes < 200 * NOISE
    assert scene.error(scene.fit.motion) < 100 * DRIFT
    for costs in scene.fit.costs:
        assert len(costs) > 1 and list(costs) == sorted(set(costs), reverse=True)
    assert float(scene.fit.identity.abs().max()) < 4.0
    assert not scene.fit.motion.neck.any()


def test_the_fit_repeats_to_the_bit(scene: Scene, demo_head_model: Path) -> None:
    names = load_expression_names(demo_head_model, scene.assets.num_expressions)
    seen = scene.landmarks
    few = replace(seen, points=seen.points[:4], scores=seen.scores[:4], detected=seen.detected[:4])
    fits = [fit_landmarks(scene.assets, names, scene.embedding, few, scene.camera) for _ in range(2)]
    assert torch.equal(fits[0].motion.R, fits[1].motion.R) and torch.equal(fits[0].identity, fits[1].identity)


def test_pictures_bring_frames_nearer_to_the_truth(scene: Scene) -> None:
    done = fit_pictures(scene.assets, scene.fit, scene.camera, *pictures_of(scene), quiet)
    assert done.is_taken and done.after > done.before + 2.0
    assert scene.error(done.motion) < 0.5 * scene.error(scene.fit.motion)


def test_pictures_that_say_nothing_are_not_believed(scene: Scene) -> None:
    rng = np.random.default_rng(0)
    noise = pictures_of(scene, lambda image: rng.integers(0, 256, image.shape).astype(np.uint8))
    done = fit_pictures(scene.assets, scene.fit, scene.camera, *noise, quiet)
    assert not done.is_taken and done.motion is scene.fit.motion


def test_what_the_held_out_points_gain_little_by_is_not_taken(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    figures = iter((30.0, 31.9))
    monkeypatch.setattr(photometric_fit, "_psnr", lambda *_: next(figures))
    done = fit_pictures(scene.assets, scene.fit, scene.camera, *pictures_of(scene), quiet)
    assert not done.is_taken and done.motion is scene.fit.motion


def test_tracks_place_the_head_where_the_fit_has_it(scene: Scene) -> None:
    clip, fit = Clip(scene.landmarks, tuple(scene.camera), [], []), scene.fit
    tracks = as_tracks(fit, fit.motion, clip, scene.assets.num_expressions)
    assert list(tracks) == list(range(FRAMES))
    expected = scene.camera.project(to_camera(fit.motion, fit.term.points.positions(fit.identity, fit.motion))).numpy()
    row_of = {int(landmark): row for row, landmark in enumerate(scene.embedding.landmarks)}
    rows = [row_of[int(landmark)] for landmark in fit.term.landmarks]
    head = HeadModel(scene.assets, torch.from_numpy(tracks[0].shape).float())
    for n in (0, 7, FRAMES - 1):
        screen = project_head(head, tracks[n], tracks[n].intrinsics, SIZE, SIZE)[:, :2]
        placed = (screen[scene.embedding.corners] * scene.embedding.barycentric[..., None]).sum(1)
        np.testing.assert_allclose(placed[rows], expected[n], atol=0.01)
