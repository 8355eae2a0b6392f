"""The focal length by a turning head, on demo people of known cameras; without MediaPipe."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from avatar.demo import motion
from avatar.demo.identity import sample_identity
from avatar.demo.motion import Motion, frame_camera, frame_params, perform
from avatar.head.assets import HeadAssets, load_head_assets
from avatar.head.model import HeadModel
from avatar.head.rasterize import rasterize_mesh
from data_prep.progress import silent
from data_prep.track import tracking_stages
from data_prep.track.faces.embedding import LandmarkEmbedding, iris_embedding
from data_prep.track.faces.landmark_groups import FEATURES
from data_prep.track.faces.landmarks import BLENDSHAPES, NUM_POINTS, Landmarks
from data_prep.track.fit import focal_estimate
from data_prep.track.fit.focal import Focal
from data_prep.track.fit.focal_estimate import NotTold, different, estimate_focal
from data_prep.track.fit.result import Clip
from data_prep.track.stage_folder import StageFolder
from data_prep.track.tracking_stages import Choices

SIZE, SEED, FRAMES, EVERY = 256, 1, 20, 9
NOISE = 0.012  # of the distance between the eyes: the landmarks' own
Paint = Callable[[np.ndarray], np.ndarray]
"""Image [H, W, 3] and what became of it."""


@pytest.fixture(scope="module")
def assets(demo_head_model: Path) -> HeadAssets:
    return load_head_assets(demo_head_model)


@pytest.fixture(scope="module")
def embedding(assets: HeadAssets) -> LandmarkEmbedding:
    chosen = np.random.default_rng(0).choice(assets.regions["face"].numpy(), len(FEATURES), replace=False)
    weights = np.tile([1.0, 0.0, 0.0], (len(chosen), 1))
    of_face = LandmarkEmbedding(np.array(FEATURES), np.repeat(chosen[:, None], 3, axis=1), weights)
    return of_face.with_others(iris_embedding(assets))


def clip_of(
    assets: HeadAssets, embedding: LandmarkEmbedding, moves: Motion, paint: Paint = lambda image: image
) -> tuple[Clip, float]:
    """A person with a smooth texture on the skin, with `intrinsics` of the usual camera; and the true focal length."""
    head = HeadModel(assets, torch.from_numpy(sample_identity(SEED).shape).float())
    performance, rng = perform(SEED, FRAMES * EVERY, moves), np.random.default_rng(0)
    waves = rng.normal(size=(3, 40)) * 150
    texture = 128 + 14 * np.sin(assets.template.numpy() @ waves + rng.uniform(0, 6, 40)).sum(1)
    points, scores = np.zeros((FRAMES, NUM_POINTS, 3), np.float32), np.zeros((FRAMES, len(BLENDSHAPES)), np.float32)
    images, mattes, camera = [], [], frame_camera(performance, 0, SIZE)
    for n, frame in enumerate(range(0, FRAMES * EVERY, EVERY)):
        camera = frame_camera(performance, frame, SIZE)
        with torch.no_grad():
            screen = camera.project(head.vertices(frame_params(performance, frame))).numpy()
        raster = rasterize_mesh(screen, head.faces.numpy(), SIZE, SIZE)
        shown = (texture[head.faces.numpy()[raster.face_id]] * raster.barycentric).sum(-1)
        grey = np.where(raster.face_id >= 0, shown, 90.0) + rng.normal(0, 2, (SIZE, SIZE))
        images.append(paint(np.repeat(grey.clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)))
        mattes.append(np.where(raster.face_id >= 0, np.uint8(255), np.uint8(0)))
        points[n, embedding.landmarks, :2] = (screen[:, :2][embedding.corners] * embedding.barycentric[..., None]).sum(
            1
        )
        scores[n, BLENDSHAPES.index("jawOpen")] = np.clip(performance.jaw[frame] / 0.3, 0, 1)
        for side, name in enumerate(("eyeBlinkLeft", "eyeBlinkRight")):
            scores[n, BLENDSHAPES.index(name)] = np.clip(performance.eyelids[frame, side], 0, 1)
    eyes = float(np.linalg.norm(points[:, 473, :2] - points[:, 468, :2], axis=1).max())
    points[..., :2] += NOISE * eyes * rng.standard_normal(points[..., :2].shape)
    landmarks = Landmarks(points, scores, np.ones(FRAMES, bool), (SIZE, SIZE), 25.0 / EVERY)
    usual = SIZE / motion.FIELD_OF_VIEW_HEIGHT
    intrinsics = usual, usual, camera.cx, camera.cy
    return Clip(landmarks, intrinsics, images.__getitem__, mattes.__getitem__), camera.fx


@pytest.mark.parametrize("distance", [0.7, 1.7, *(pytest.param(d, marks=pytest.mark.slow) for d in (0.85, 1.0, 1.3))])
def test_a_turning_head_tells_the_focal_length(
    distance: float, assets: HeadAssets, embedding: LandmarkEmbedding, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(motion, "CAMERA_DISTANCE", distance)
    clip, true = clip_of(assets, embedding, "turn")
    share, uncertainty = estimate_focal(assets, embedding, clip)
    assert share * clip.intrinsics[0] == pytest.approx(true, rel=0.15)
    assert 0.0 < uncertainty <= 0.15


def test_a_head_that_does_not_turn_does_not_tell_it(assets: HeadAssets, embedding: LandmarkEmbedding) -> None:
    with pytest.raises(NotTold, match="the head turns by [0-9]+ degrees, and 60 are needed"):
        estimate_focal(assets, embedding, clip_of(assets, embedding, "speech")[0])


def test_pictures_of_noise_do_not_tell_it(assets: HeadAssets, embedding: LandmarkEmbedding) -> None:
    rng = np.random.default_rng(0)
    clip, _ = clip_of(assets, embedding, "turn", lambda image: rng.integers(0, 256, image.shape).astype(np.uint8))
    with pytest.raises(NotTold):
        estimate_focal(assets, embedding, clip)


def test_mattes_without_the_face_do_not_tell_it(assets: HeadAssets, embedding: LandmarkEmbedding) -> None:
    clip, _ = clip_of(assets, embedding, "turn")
    with pytest.raises(NotTold, match="too little of the face"):
        estimate_focal(assets, embedding, replace(clip, mattes=lambda number: np.zeros_like(clip.mattes(number))))


def test_an_estimate_that_the_identity_prior_decides_is_not_taken(
    assets: HeadAssets, embedding: LandmarkEmbedding, monkeypatch: pytest.MonkeyPatch
) -> None:
    clip, _ = clip_of(assets, embedding, "turn")
    monkeypatch.setattr(focal_estimate, "OTHER_WEIGHTS", (1e-4, 1e4))
    monkeypatch.setattr(focal_estimate, "MOST_UNCERTAINTY", 0.01)
    with pytest.raises(NotTold, match="changes by [0-9]+ %"):
        estimate_focal(assets, embedding, clip)


def test_the_frames_that_differ_most_are_chosen() -> None:
    angles = np.array([[0.0, 0.0], [0.1, 0.0], [30.0, 0.0], [0.0, 0.2], [-30.0, 0.0], [0.0, 12.0]])
    assert different(angles, 4).tolist() == [0, 2, 4, 5]
    assert different(angles, 99).tolist() == [0, 1, 2, 3, 4, 5]


@pytest.fixture
def ask(
    tmp_path: Path, assets: HeadAssets, demo_head_model: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[Callable[..., object]], Focal]:
    """Runs the stage with this in place of the estimate."""
    monkeypatch.setattr(tracking_stages, "find_embedding", lambda *_: None)
    frame = np.zeros((1, NUM_POINTS, 3), np.float32), np.zeros((1, len(BLENDSHAPES)), np.float32)
    landmarks, assumed = Landmarks(*frame, np.ones(1, bool), (64, 64), 25.0), Focal(800.0, "assumed: as ever", True)

    def run(estimate: Callable[..., object]) -> Focal:
        monkeypatch.setattr(tracking_stages, "estimate_focal", estimate)
        nothing: Any = None  # footage, which this stage does not read
        work = tracking_stages.TrackingStages(StageFolder(tmp_path), nothing, Choices(), assets, silent)
        return work.focal(landmarks, assumed, (400.0, 400.0, 32.0, 32.0), demo_head_model, [])

    return run


def test_the_estimate_is_taken_with_its_uncertainty_and_kept(ask: Callable[..., Focal]) -> None:
    told = ask(lambda *_: (1.25, 0.12))
    assert told == (1000.0, "estimated from the turning head (± 120 pixels)", False)
    assert ask(lambda *_: pytest.fail("the stage is made again")) == told


def test_the_assumption_stays_where_the_clip_does_not_tell(ask: Callable[..., Focal]) -> None:
    def refuse(*_: object) -> None:
        raise NotTold("the head turns by 7 degrees, and 60 are needed")

    focal = ask(refuse)
    assert focal.pixels == 800.0 and focal.is_assumed
    assert "assumed: as ever" in focal.source and "turns by 7 degrees" in focal.source
    assert ask(lambda *_: pytest.fail("the stage is made again")) == focal
