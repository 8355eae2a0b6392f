"""The fit to landmarks and then to pictures, on the demo's person whose motion is known; without MediaPipe."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest
import torch
from spoken_scene import DRIFT, NOISE, SIZE, Scene, drawn, spoken_scene

from avatar.demo.render import RenderedFrame
from avatar.errors import UserError
from avatar.head.model import HeadModel
from data_prep.prepare.projection import project_head
from data_prep.progress import silent
from data_prep.track.faces.landmark_groups import LIPS, NOSE
from data_prep.track.fit import photometric_fit
from data_prep.track.fit.camera import to_camera
from data_prep.track.fit.fit_clip import as_tracks
from data_prep.track.fit.frame_poses import Motion, at_rest
from data_prep.track.fit.landmark_fit import LandmarkFit, eye_distance, fit_landmarks
from data_prep.track.fit.occlusion import COVERED_SHARE
from data_prep.track.fit.photometric_fit import fit_pictures
from data_prep.track.fit.surface import SurfacePoints

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
    fit = fit_landmarks(seen.assets, seen.embedding, seen.landmarks, seen.camera)
    return Fitted(seen, drawn(FRAMES), fit)


def pictures_of(scene: Fitted, change=lambda image: image):
    shown = [change(picture.image) for picture in scene.pictures]
    return shown.__getitem__, [picture.alpha for picture in scene.pictures].__getitem__


def test_the_landmarks_are_met(scene: Fitted) -> None:
    errors = scene.fit.term.errors(scene.fit.identity, scene.fit.motion)
    assert 100 * float(errors.mean()) / scene.seen.eyes < 200 * NOISE
    assert scene.error(scene.fit.motion) < 100 * DRIFT
    assert float(scene.fit.identity.abs().max()) < 4.0


def test_the_fit_repeats_to_the_bit(scene: Fitted) -> None:
    seen = scene.seen.landmarks
    few = replace(seen, points=seen.points[:4], scores=seen.scores[:4], detected=seen.detected[:4])
    fits = [fit_landmarks(scene.seen.assets, scene.seen.embedding, few, scene.seen.camera) for _ in range(2)]
    assert torch.equal(fits[0].motion.R, fits[1].motion.R) and torch.equal(fits[0].identity, fits[1].identity)


def test_pictures_bring_frames_nearer_to_the_truth(scene: Fitted, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(photometric_fit, "_FRAMES_AT_ONCE", 5)
    done = fit_pictures(scene.seen.assets, scene.fit, scene.seen.camera, *pictures_of(scene), silent)
    assert done.is_taken and done.after > done.before + 2.0
    assert scene.error(done.motion) < 0.5 * scene.error(scene.fit.motion)
    assert (done.covered <= COVERED_SHARE).all()


def test_a_light_that_moves_does_not_move_the_head(scene: Fitted) -> None:
    """A lamp wanders around the head. With a gain for each frame and nothing else, the error stays twice as large."""
    _, width = scene.pictures[0].alpha.shape
    turns = iter(np.sin(np.arange(FRAMES) * 0.9))

    def lit(image: np.ndarray) -> np.ndarray:
        slope = 1 + 0.35 * next(turns) * np.linspace(-1, 1, width)[:, None]
        return np.clip(image * slope, 0, 255).astype(np.uint8)

    done = fit_pictures(scene.seen.assets, scene.fit, scene.seen.camera, *pictures_of(scene, lit), silent)
    assert done.is_taken and scene.error(done.motion) < 0.3 * scene.error(scene.fit.motion)


def test_pictures_that_say_nothing_are_not_believed(scene: Fitted) -> None:
    rng = np.random.default_rng(0)
    noise = pictures_of(scene, lambda image: rng.integers(0, 256, image.shape).astype(np.uint8))
    done = fit_pictures(scene.seen.assets, scene.fit, scene.seen.camera, *noise, silent)
    assert not done.is_taken and done.motion is scene.fit.motion


def test_hands_before_the_face_are_found(scene: Fitted) -> None:
    """Four fingers of the skin's colour lie over cheek and mouth in five frames of sixteen."""
    covered = [2, 3, 4, 11, 12]
    images, mattes = pictures_of(scene)
    hands = [images(row).copy() for row in range(FRAMES)]
    for row in covered:
        points, eyes = scene.seen.landmarks.points[row, :, :2], scene.seen.eyes
        x, y = points[list(LIPS)].mean(0)
        skin = hands[row][int(points[list(NOSE), 1].mean()), int(points[list(NOSE), 0].mean())]
        for finger in range(4):
            tip = int(x + (0.25 * finger - 0.6) * eyes), int(y - (0.7 - 0.1 * abs(finger - 1.5)) * eyes)
            root = int(tip[0] - 0.3 * eyes), int(y + 0.9 * eyes)
            for width, share in ((0.24, 0.5), (0.2, 0.9)):  # with a dark edge
                cv2.line(hands[row], root, tip, (share * skin).tolist(), int(width * eyes), cv2.LINE_AA)
    found = fit_pictures(scene.seen.assets, scene.fit, scene.seen.camera, hands.__getitem__, mattes, silent)
    assert (found.covered > COVERED_SHARE).nonzero().flatten().tolist() == covered
    assert scene.error(found.motion) < 0.33 * scene.error(scene.fit.motion)  # what they cover counts less


def test_mattes_without_the_face_are_refused_and_no_figure_is_made_of_nothing(scene: Fitted) -> None:
    images, mattes = pictures_of(scene)
    with pytest.raises(UserError, match="the mattes show nothing of the face"):
        fit_pictures(
            scene.seen.assets, scene.fit, scene.seen.camera, images, lambda row: np.zeros_like(mattes(row)), silent
        )


def test_points_that_do_not_keep_their_colour_count_little() -> None:
    spread = torch.tensor([0.01, 0.02, 0.02, 0.2, 0.04], dtype=torch.float64)
    residuals = spread * torch.tensor([1.0, -1.0, 1.0, -1.0], dtype=torch.float64)[:, None]
    weights = torch.ones(4, 5, dtype=torch.float64)
    trust = photometric_fit._trust(residuals, weights)
    torch.testing.assert_close(trust, torch.tensor([1.0, 1.0, 1.0, 0.01, 0.25], dtype=torch.float64))
    weights[:, 4] = 0.0  # points that nobody sees do not shift the middle
    assert photometric_fit._trust(residuals, weights)[3] == pytest.approx(0.01)


def test_points_at_the_mouth_are_told(scene: Fitted) -> None:
    assets, fit = scene.seen.assets, scene.fit
    every = torch.arange(assets.num_vertices)[:, None].expand(-1, 3)
    alone = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64).expand(len(every), 3)
    vertices = SurfacePoints(assets, every, alone, len(fit.identity), fit.expressions)
    lips = fit.term.points.of(torch.from_numpy(np.flatnonzero(np.isin(fit.term.landmarks, LIPS))))
    pose = torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 3, dtype=torch.float64)
    rest = at_rest(*pose, len(fit.expressions))
    apart = torch.cdist(vertices.positions(fit.identity, rest)[0], lips.positions(fit.identity, rest)[0]).amin(1)
    near = photometric_fit._near(assets, fit, vertices, LIPS, 0.25)
    assert near.any() and torch.equal(near, apart < 0.25 * eye_distance(assets))
    without = replace(fit, term=replace(fit.term, landmarks=np.zeros_like(fit.term.landmarks) + 4))
    assert not photometric_fit._near(assets, without, vertices, LIPS, 0.25).any()


def test_one_bad_point_does_not_decide_what_is_taken() -> None:
    texture = torch.linspace(0.2, 0.8, 21, dtype=torch.float64).expand(6, -1)
    wave = torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, -1.0], dtype=torch.float64)[:, None]
    values, weights = texture + 0.01 * wave, torch.ones(6, 21, dtype=torch.float64)
    even = torch.ones(21, 1, dtype=torch.float64)
    worse = values.clone()
    worse[:, 3] += 0.2 * wave[:, 0]  # a mean over the points would fall by 20 dB; only the gains feel it
    assert photometric_fit._psnr(worse, weights, even) == pytest.approx(
        photometric_fit._psnr(values, weights, even), abs=2.0
    )
    assert (
        photometric_fit._psnr(texture + 0.02 * wave, weights, even) < photometric_fit._psnr(values, weights, even) - 5.0
    )


def test_points_that_judge_the_fit_are_not_fitted_to(scene: Fitted, monkeypatch: pytest.MonkeyPatch) -> None:
    chosen: list[torch.Tensor] = []
    own = photometric_fit._Skin.subset

    def subset(self: object, which: torch.Tensor) -> object:
        chosen.append(which)
        return own(self, which)  # type: ignore[arg-type]

    monkeypatch.setattr(photometric_fit._Skin, "subset", subset)
    monkeypatch.setattr(photometric_fit, "ROUNDS", 1)
    monkeypatch.setattr(photometric_fit, "minimise", lambda terms, identity, motion, *_, **__: Fitting(motion))
    fit_pictures(scene.seen.assets, scene.fit, scene.seen.camera, *pictures_of(scene), silent)
    held, *compared = chosen
    assert held.any() and len(compared) == len(photometric_fit.BLURS)
    assert all(part.any() and not (part & held).any() for part in compared)


class Fitting(NamedTuple):
    motion: Motion


def test_what_the_held_out_points_gain_little_by_is_not_taken(scene: Fitted, monkeypatch: pytest.MonkeyPatch) -> None:
    figures = iter((30.0, 30.9))
    monkeypatch.setattr(photometric_fit, "_psnr", lambda *_: next(figures))
    done = fit_pictures(scene.seen.assets, scene.fit, scene.seen.camera, *pictures_of(scene), silent)
    assert not done.is_taken and done.motion is scene.fit.motion


def test_tracks_place_the_head_where_the_fit_has_it(scene: Fitted) -> None:
    seen, fit = scene.seen, scene.fit
    tracks = as_tracks(fit, fit.motion, seen.camera, seen.landmarks.size, seen.assets.num_expressions)
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
