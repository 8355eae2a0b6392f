"""A face followed frame by frame, beside the fit of the whole clip and the truth; without MediaPipe."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from spoken_scene import FPS, SEED, SIZE, Scene, spoken_scene

from avatar.demo.identity import sample_identity
from avatar.demo.performance import frame_camera, frame_params, perform
from avatar.head.model import HeadModel
from data_prep.live.frame_fit import LOST_AFTER, FrameFit, _Fitted, _follows, _is_quick
from data_prep.track.faces.detect import Face
from data_prep.track.faces.landmarks import BLENDSHAPES, Landmarks
from data_prep.track.fit.frame_poses import Motion, at_rest
from data_prep.track.fit.landmark_fit import LandmarkFit, fit_landmarks
from data_prep.track.fit.levenberg_marquardt import concatenated

CALIBRATED, FRAMES = 24, 36  # the first ones are calibrated on, the others followed; the clip's fit knows all


@dataclass(frozen=True)
class Followed:
    scene: Scene
    clip: LandmarkFit
    calibration: LandmarkFit

    def face(self, n: int) -> Face:
        return Face(self.scene.landmarks.points[n], self.scene.landmarks.scores[n])

    def fitter(self) -> FrameFit:
        scene = self.scene
        return FrameFit(scene.assets, scene.embedding, self.calibration, scene.camera, (SIZE, SIZE))

    def follow(self, fit: FrameFit, frames: range, fps: float = FPS) -> Motion:
        motions = [fit.next(self.face(n), n / fps) for n in frames]
        return concatenated([motion for motion in motions if motion is not None])


def part(landmarks: Landmarks, frames: slice) -> Landmarks:
    return replace(
        landmarks,
        points=landmarks.points[frames],
        scores=landmarks.scores[frames],
        detected=landmarks.detected[frames],
    )


@pytest.fixture(scope="module")
def followed(demo_head_model: Path) -> Followed:
    scene = spoken_scene(demo_head_model, FRAMES)

    def fit(frames: slice) -> LandmarkFit:
        return fit_landmarks(scene.assets, scene.embedding, part(scene.landmarks, frames), scene.camera)

    return Followed(scene, fit(slice(0, FRAMES)), fit(slice(0, CALIBRATED)))


def test_it_is_near_the_fit_of_the_clip(followed: Followed) -> None:
    motion = followed.follow(followed.fitter(), range(FRAMES))
    new = slice(CALIBRATED, FRAMES)
    live, clip = motion[new], followed.clip.motion[new]
    error, reference = (
        followed.scene.error(fit, m, new) for fit, m in ((followed.calibration, live), (followed.clip, clip))
    )
    assert error < 1.4 * reference, "on frames that the calibration has not seen"
    spread = float(clip.expression.std(0).square().mean().sqrt())
    assert float((live.expression - clip.expression).square().mean().sqrt()) < spread
    assert float((live.jaw - clip.jaw).abs().max()) < 0.05
    assert float((live.eyelids - clip.eyelids).abs().max()) < 0.25
    assert float((live.gaze - clip.gaze).abs().max()) < 0.2
    turned = (live.R @ clip.R.transpose(1, 2)).diagonal(dim1=1, dim2=2).sum(1)
    assert float(torch.rad2deg(torch.arccos(((turned - 1) / 2).clamp(max=1))).max()) < 2.5


def test_a_few_steps_are_enough(followed: Followed, monkeypatch: pytest.MonkeyPatch) -> None:
    few = followed.follow(followed.fitter(), range(8))
    monkeypatch.setattr("data_prep.live.frame_fit.STEPS", 20)
    many = followed.follow(followed.fitter(), range(8))
    assert float((few.expression - many.expression).abs().max()) < 0.05
    assert not torch.equal(few.expression, many.expression)


def test_frames_hold_on_to_those_before(followed: Followed) -> None:
    """The same noisy frames alone jump about more than one after the other."""
    together = followed.follow(followed.fitter(), range(10))
    alone = concatenated([m for n in range(10) if (m := followed.fitter().next(followed.face(n), 0.0)) is not None])

    def unrest(motion: Motion) -> float:
        return float(motion.expression.diff(n=2, dim=0).square().mean())

    assert unrest(together) < 0.5 * unrest(alone)


def test_the_mouth_goes_to_the_side_that_the_calibration_has_not_seen(followed: Followed) -> None:
    """Its one coefficient is 1 to the left and -1 to the right."""
    scene, places = followed.scene, [BLENDSHAPES.index(name) for name in ("mouthLeft", "mouthRight")]
    scores = scene.landmarks.scores.copy()
    scores[:, places] = 0.02, 0.005
    calm = part(replace(scene.landmarks, scores=scores), slice(0, CALIBRATED))
    calibration = fit_landmarks(scene.assets, scene.embedding, calm, scene.camera)
    performance = perform(SEED, 40, "speech")
    head = HeadModel(scene.assets, torch.from_numpy(sample_identity(SEED).shape))
    params, camera = (frame_params(performance, 3), frame_camera(performance, 3, SIZE))
    coefficient = scene.names.index("mouth_left")
    params.expression[coefficient] = -0.9
    seen = camera.project(head.vertices(params)).numpy()[scene.embedding.corners, :2]
    points, own = scene.landmarks.points[3].copy(), scores[3].copy()
    points[scene.embedding.landmarks, :2] = (seen * scene.embedding.barycentric[..., None]).sum(1)
    own[places] = 0.0, 0.9
    fit = replace(followed, calibration=calibration).fitter()
    motion = [fit.next(Face(points, own), n / FPS) for n in range(6)][-1]
    assert motion is not None
    assert float(motion.expression[0, calibration.expressions == coefficient]) == pytest.approx(-0.9, abs=0.15)


def test_the_longer_between_frames_the_looser(followed: Followed) -> None:
    """Pictures that were dropped do not make a face late: what it may move grows with the time between."""
    far = followed.face(20)
    moved = []
    for wait in (0.02, 0.4):
        fit = followed.fitter()
        first = [fit.next(followed.face(0), k / 100) for k in range(2)][-1]
        then = fit.next(far, 0.01 + wait)
        assert first is not None and then is not None
        moved.append(float((then.expression - first.expression).norm()))
    assert moved[0] < 0.8 * moved[1]


def test_a_face_that_was_away_starts_anew(followed: Followed) -> None:
    fit = followed.fitter()
    followed.follow(fit, range(6))
    late = fit.next(followed.face(20), 5 / FPS + 2 * LOST_AFTER)
    fresh = followed.fitter().next(followed.face(20), 0.0)
    assert late is not None and fresh is not None
    assert torch.equal(late.expression, fresh.expression) and torch.equal(late.R, fresh.R)


def test_a_quick_head_is_not_lost(followed: Followed) -> None:
    """Across half the picture between two frames: farther than the robust loss reaches."""
    fit = followed.fitter()
    followed.follow(fit, range(3))
    face = followed.face(3)
    points = face.points.copy()
    points[:, :2] += np.array([0.5 * SIZE, 0.2 * SIZE], np.float32)
    moved = fit.next(face._replace(points=points), 3 / FPS)
    assert moved is not None
    term = replace(
        followed.calibration.term.take(slice(0, 1)),
        observed=torch.from_numpy(points[None, followed.calibration.term.landmarks, :2].astype(np.float64)),
    )
    assert float(term.errors(followed.calibration.identity, moved).mean()) < 0.1 * followed.scene.eyes


def test_a_head_is_expected_where_its_speed_takes_it() -> None:
    """At a metre a second it is no cut where it goes on so, and one where it jumps back; by the times of the pictures."""

    def at(x: float) -> Motion:
        eye = torch.eye(3, dtype=torch.float64)[None]
        return at_rest(eye, torch.tensor([[x, 0.0, 0.8]], dtype=torch.float64), 2)

    before = [_Fitted(at(0.0), 1.0), _Fitted(at(0.04), 1.04)]
    assert not _is_quick(before, at(0.08), 1.08) and not _is_quick(before, at(0.06), 1.06)
    assert _is_quick(before, at(0.0), 1.08) and _is_quick(before, at(0.04), 1.08)
    assert not _is_quick(before[1:], at(0.05), 1.08) and _is_quick(before[1:], at(0.08), 1.08)
    assert not _is_quick([], at(5.0), 1.0)


def test_smoothness_is_that_of_the_last_two_frames(followed: Followed) -> None:
    """Scaled by their rate, but never beyond that of a quick camera."""
    fit = followed.fitter()
    followed.follow(fit, range(5))
    assert [one.taken for one in fit._before] == pytest.approx([3 / FPS, 4 / FPS])
    nominal, last = fit._smoothness, fit._before[-1]

    def stiffness(wait: float) -> float:
        return float(
            _follows(nominal, [replace(last, taken=-wait), replace(last, taken=0.0)], wait).smoothness.second[0]
        )

    usual = float(nominal.second[0])
    assert stiffness(1 / FPS) == pytest.approx(usual) and stiffness(2 / FPS) == pytest.approx(usual / 8)
    assert stiffness(1e-4) == pytest.approx(stiffness(1 / 60)) and stiffness(9.0) == pytest.approx(stiffness(1 / 5))


def test_landmarks_that_are_no_face_do_no_harm(followed: Followed) -> None:
    fit = followed.fitter()
    followed.follow(fit, range(3))
    face = followed.face(3)
    for k, nothing in enumerate((np.zeros_like(face.points), np.full_like(face.points, 1e6), -face.points)):
        found = fit.next(face._replace(points=nothing), (3 + k) / FPS)
        assert found is None or torch.isfinite(found.coefficients()).all()
    after = fit.next(followed.face(20), 5 / FPS + 2 * LOST_AFTER)
    fresh = followed.fitter().next(followed.face(20), 0.0)
    assert after is not None and fresh is not None and torch.equal(after.expression, fresh.expression)
