"""The fitted gaze of a demo person who rolls the eyes, looks down with open lids and winks; without MediaPipe."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from spoken_scene import SEED, SIZE, Scene, spoken_scene

from avatar.demo.performance import perform
from data_prep.track.faces.landmark_groups import IRISES
from data_prep.track.faces.landmarks import BLENDSHAPES, CLOSED_SCORE, Landmarks
from data_prep.track.fit import photometric_fit
from data_prep.track.fit.fit_clip import as_tracks
from data_prep.track.fit.focal import Focal
from data_prep.track.fit.frame_poses import Motion
from data_prep.track.fit.landmark_fit import LandmarkFit, fit_landmarks
from data_prep.track.fit.levenberg_marquardt import minimise
from data_prep.track.fit.result import Fit
from data_prep.track.quality import grade_tracking, landmark_figures

FRAMES = 64
AT_512 = 512 / SIZE
Looked = tuple[Scene, LandmarkFit]
BLINKS = [BLENDSHAPES.index(name) for name in ("eyeBlinkLeft", "eyeBlinkRight")]
TRUE = perform(SEED, FRAMES, "gaze")
IS_OPEN = TRUE.eyelids < 0.1  # [T, 2]


@pytest.fixture(scope="module")
def looked(demo_head_model: Path) -> Looked:
    """The scene and its fit. Closed eyes have the scores that MediaPipe gives them, and irises that lie anywhere."""
    scene = spoken_scene(demo_head_model, FRAMES, "gaze")
    points, scores = scene.landmarks.points.copy(), scene.landmarks.scores.copy()
    scores[:, BLINKS] *= CLOSED_SCORE
    for side, iris in enumerate(IRISES):
        points[TRUE.eyelids[:, side] > 0.5, iris, :2] += 0.15 * scene.eyes
    scene = replace(scene, landmarks=replace(scene.landmarks, points=points, scores=scores))
    return scene, fit_landmarks(scene.assets, scene.embedding, scene.landmarks, scene.camera)


def off_irises(fit: LandmarkFit, motion: Motion) -> np.ndarray:
    """[T, 2] pixels at 512 between the irises of the fit and the detected ones."""
    columns = [int(np.flatnonzero(fit.term.landmarks == iris)[0]) for iris in IRISES]
    return fit.term.errors(fit.identity, motion)[:, columns].numpy() * AT_512


def without_pictures(fit: LandmarkFit) -> Motion:
    """What all terms but that of the pictures make of the motion in the photometric stage."""
    terms = (photometric_fit._quieter(fit.term), fit.priors, fit.smoothness)
    return minimise(terms, fit.identity, fit.motion, 6).motion


@pytest.mark.parametrize("stage", ["landmarks", "pictures"])
def test_irises_follow_their_landmarks_to_a_pixel(looked: Looked, stage: str) -> None:
    """Into the corners, up, down and around, in glances of an eighth of a second too."""
    _, fit = looked
    off = off_irises(fit, fit.motion if stage == "landmarks" else without_pictures(fit))[IS_OPEN]
    assert np.median(off) < 1.0 and np.percentile(off, 90) < 1.0


def test_the_gaze_is_the_true_one(looked: Looked) -> None:
    _, fit = looked
    both = IS_OPEN.all(1)
    off = fit.motion.gaze.unflatten(1, (2, 2)).mean(1).numpy() - TRUE.gaze
    off = np.degrees(off - off[both].mean(0))[both]
    assert np.abs(off).max() < 9.0


def test_a_winking_eye_looks_where_the_other_looks(looked: Looked) -> None:
    """Its iris is not seen; the lids that are closed are closed in the fit, and no others."""
    _, fit = looked
    winks = TRUE.eyelids.max(1) > 0.9
    assert winks.any()
    left, right = fit.motion.gaze[torch.from_numpy(winks)].split(2, dim=1)
    assert float(torch.rad2deg((left - right).abs()).max()) < 10.0
    closed = fit.motion.eyelids.numpy()[winks]
    assert (closed[TRUE.eyelids[winks] > 0.9] > closed[TRUE.eyelids[winks] < 0.1].max() + 0.2).all()


def test_eyes_that_disagree_are_not_forced_together(looked: Looked) -> None:
    scene, _ = looked
    points = scene.landmarks.points.copy()
    points[:, IRISES[0], 0] += 0.04 * scene.eyes
    cross = replace(scene.landmarks, points=points)
    fit = fit_landmarks(scene.assets, scene.embedding, cross, scene.camera)
    assert np.median(off_irises(fit, fit.motion)[IS_OPEN]) < 1.0


def test_the_table_tells_of_irises_that_do_not_follow(looked: Looked) -> None:
    scene, fit = looked

    def grades(landmarks: Landmarks, motion: Motion = fit.motion) -> list[str | None]:
        tracks = as_tracks(fit, motion, scene.camera, landmarks.size, scene.assets.num_expressions)
        figures = landmark_figures(scene.assets, Fit(tracks, {}), landmarks, scene.embedding)
        quality = grade_tracking(
            landmarks, len(landmarks), Fit(tracks, figures), [1.0], None, Focal(1.0, "given", False)
        )
        return [figure.grade for figure in quality.figures if "irises" in figure.name]

    assert grades(scene.landmarks) == ["good"]
    assert grades(scene.landmarks, replace(fit.motion, gaze=torch.zeros_like(fit.motion.gaze))) == ["poor"]
    closed = scene.landmarks.scores.copy()
    closed[:, BLINKS] = CLOSED_SCORE
    assert grades(replace(scene.landmarks, scores=closed)) == []
