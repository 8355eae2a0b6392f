"""Gradients of every term of the fit against differences of its cost, column by column, in float64."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from heads import EXPRESSIONS, grid_head

from avatar.head.expression_names import ExpressionNames
from data_prep.track.faces.landmarks import BLENDSHAPES, NUM_POINTS, Landmarks
from data_prep.track.fit.camera import Pinhole, to_camera
from data_prep.track.fit.crops import BlurredCrops, cut_out
from data_prep.track.fit.frame_poses import NUM_FIXED, Motion, at_rest, rotations
from data_prep.track.fit.landmark_term import LandmarkTerm
from data_prep.track.fit.levenberg_marquardt import Term
from data_prep.track.fit.normal_equations import NormalEquations
from data_prep.track.fit.photometric_term import PhotometricTerm, SkinValues
from data_prep.track.fit.priors import make_priors
from data_prep.track.fit.smoothness import make_smoothness
from data_prep.track.fit.surface import SurfacePoints

T, N, IDENTITIES = 5, 9, 3
CAMERA = Pinhole(300.0, 310.0, 64.0, 60.0)
IDENTITY = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
COLUMNS = NUM_FIXED + EXPRESSIONS


def noise(*shape: int, seed: int = 0, scale: float = 1.0) -> torch.Tensor:
    return scale * torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def some_motion() -> Motion:
    """In front of the camera, whose z points away from it."""
    t = torch.tensor([0.0, 0.0, 0.8], dtype=torch.float64) + noise(T, 3, seed=1, scale=0.01)
    parts = [noise(T, columns, seed=2 + columns, scale=0.2) for columns in (3, 4, 2, EXPRESSIONS)]
    return Motion(rotations(noise(T, 3, seed=2, scale=0.2)), t, *parts)


def some_points() -> SurfacePoints:
    assets = grid_head()
    corners = assets.faces[torch.randperm(len(assets.faces), generator=torch.Generator().manual_seed(4))[:N]]
    weights = noise(N, 3, seed=5).abs()
    every = torch.arange(EXPRESSIONS)
    return SurfacePoints(assets, corners, weights / weights.sum(1, keepdim=True), IDENTITIES, every)


def landmark_term() -> LandmarkTerm:
    points, motion = some_points(), some_motion()
    seen = CAMERA.project(to_camera(motion, points.positions(IDENTITY, motion)))
    return LandmarkTerm(
        landmarks=np.arange(N), points=points, camera=CAMERA, observed=seen + noise(T, N, 2, seed=6, scale=3.0),
        weights=noise(T, N, seed=7).abs(), unit=noise(T, seed=8).abs() + 0.5, pairs=torch.tensor([[0, 1], [4, 2]]),
        pair_weights=noise(T, 2, seed=9).abs(),
    )  # fmt: skip


def smoothness() -> Term:
    frames = torch.tensor([0, 1, 2, 4, 5])  # one is missing
    return make_smoothness(grid_head(), frames, 30.0, EXPRESSIONS, statistical=False)


def priors() -> Term:
    generator = np.random.default_rng(0)
    scores = generator.random((T, len(BLENDSHAPES))).astype(np.float32)
    points = np.zeros((T, NUM_POINTS, 3), np.float32)
    landmarks = Landmarks(points, scores, np.ones(T, bool), (128, 120), 25.0)
    names = ExpressionNames(tuple(f"e{i}" for i in range(EXPRESSIONS)))
    return make_priors(landmarks, names, torch.arange(EXPRESSIONS), statistical=False)


def photometric_term() -> PhotometricTerm:
    """Waves of some pixels' length, smooth enough for the differences by which the images' slopes are taken."""
    points, motion = some_points(), some_motion()
    y, x = np.mgrid[0:120, 0:128]
    wave = 127 + 60 * np.sin(x / 12.0) + 60 * np.cos(y / 11.0)
    images = [np.repeat(np.rint(wave + 2 * k).astype(np.uint8)[..., None], 3, axis=2) for k in range(T)]
    mattes = np.full((T, 120, 128), 255, np.uint8)
    box = np.tile([8.0, 8.0, 120.0, 112.0], (T, 1))
    crops = cut_out(lambda k: images[k], lambda k: mattes[k], range(T), box, 1.0)
    blurred = BlurredCrops(crops, 2.0)
    values, _ = blurred.sample(CAMERA.project(to_camera(motion, points.positions(IDENTITY, motion))), slice(0, T))
    wanted = values + noise(T, N, seed=11, scale=0.05)
    return PhotometricTerm(SkinValues(points, CAMERA, blurred), wanted, noise(T, N, seed=12).abs())


def gradients(term: Term, step: float) -> tuple[torch.Tensor, torch.Tensor]:
    """The term's own [T, D], and central differences of its cost."""
    motion = some_motion()
    own = NormalEquations.zeros(T, COLUMNS, 0)
    term.add_to(own, IDENTITY, motion)
    differences = torch.zeros(T, COLUMNS, dtype=torch.float64)
    for t in range(T):
        for column in range(COLUMNS):
            moved = torch.zeros(T, COLUMNS, dtype=torch.float64)
            moved[t, column] = step
            there, back = (term.cost(IDENTITY, motion.moved(sign * moved)) for sign in (1, -1))
            differences[t, column] = (there - back) / (2 * step)
    return own.gradient, differences


@pytest.mark.parametrize("make", [landmark_term, smoothness, priors])
def test_gradients(make) -> None:
    own, differences = gradients(make(), 1e-6)
    assert float(differences.abs().max()) > 0
    torch.testing.assert_close(own, differences, rtol=2e-5, atol=2e-5 * float(differences.abs().max()))


def test_photometric_gradient() -> None:
    """The images' slopes are differences over a pixel, so the agreement is not to the last digit."""
    own, differences = gradients(photometric_term(), 1e-4)
    assert float((own * differences).sum() / (own.norm() * differences.norm())) > 0.999
    assert float(own.norm() / differences.norm()) == pytest.approx(1.0, abs=0.03)


def test_gradient_by_the_identity() -> None:
    term, motion, step = landmark_term(), some_motion(), 1e-5
    own = NormalEquations.zeros(T, COLUMNS, IDENTITIES)
    term.add_to(own, IDENTITY, motion)
    moved = step * torch.eye(IDENTITIES, dtype=torch.float64)
    differences = torch.tensor(
        [(term.cost(IDENTITY + d, motion) - term.cost(IDENTITY - d, motion)) / (2 * step) for d in moved],
        dtype=torch.float64,
    )
    torch.testing.assert_close(own.shared_gradient, differences, rtol=0, atol=1e-5 * float(differences.abs().max()))


def test_some_landmarks_cost_what_they_cost_among_others() -> None:
    term, motion = landmark_term(), some_motion()
    rows = torch.tensor([0, 1, 2, 4, 7])  # with both ends of every pair
    others = torch.ones(N, dtype=torch.bool)
    others[rows] = False
    alone = replace(term, weights=torch.where(others, 0.0, term.weights))
    assert term.of(rows).cost(IDENTITY, motion) == pytest.approx(alone.cost(IDENTITY, motion), rel=1e-12)
    assert term.of(rows).landmarks.tolist() == rows.tolist()
    assert alone.cost(IDENTITY, motion) < term.cost(IDENTITY, motion)


def test_values_are_those_of_samples_with_derivatives() -> None:
    images = photometric_term().seen.images
    pixels = 60.0 + noise(2, 7, 2, seed=20, scale=40.0)  # some of them outside
    values, gradient = images.sample(pixels, slice(1, 3))
    assert torch.equal(images.values(pixels, slice(1, 3)), values) and gradient.any()
    assert not torch.equal(images.values(pixels, slice(2, 4)), values)


def test_kept_values_are_those_of_the_same_motion_and_identity() -> None:
    seen, motion = photometric_term().seen, some_motion()
    values = seen.at(IDENTITY, motion)
    assert seen.at(IDENTITY, motion) is values
    fresh = SkinValues(seen.points, seen.camera, seen.images)
    for identity, other in ((IDENTITY, replace(motion, t=motion.t + 0.01)), (IDENTITY + 0.5, motion)):
        assert not torch.equal(seen.at(identity, other), values)
        assert torch.equal(seen.at(identity, other), fresh.at(identity, other))
    assert torch.equal(seen.at(IDENTITY, motion), values)


def test_frames_that_do_not_follow_each_other_are_not_compared() -> None:
    term, motion = smoothness(), some_motion()
    jumped = replace(motion, jaw=motion.jaw + torch.tensor([0, 0, 0, 1.0, 1.0], dtype=torch.float64)[:, None])
    assert term.cost(IDENTITY, jumped) == pytest.approx(term.cost(IDENTITY, motion), rel=1e-9)


@pytest.mark.parametrize("part", ["jaw", "t"])
def test_the_same_motion_costs_the_same_at_any_frame_rate(part: str) -> None:
    """Twice as many frames a second differ half as much, and second differences a quarter as much."""

    def cost(fps: float) -> float:
        time = torch.arange(int(8 * fps), dtype=torch.float64) / fps
        wave = torch.stack([torch.sin(9.0 * time + k) for k in range(3)], dim=1)
        rest = at_rest(torch.eye(3, dtype=torch.float64).expand(len(time), 3, 3), 0.0 * wave, EXPRESSIONS)
        term = make_smoothness(grid_head(), torch.arange(len(time)), fps, EXPRESSIONS, statistical=False)
        return term.cost(IDENTITY, replace(rest, **{part: 0.1 * wave}))

    slow, usual, fast = (cost(fps) for fps in (20.0, 25.0, 60.0))
    assert slow == pytest.approx(usual, rel=0.05) and fast == pytest.approx(usual, rel=0.05) and usual > 0


def test_crops_lie_where_they_were_cut_out() -> None:
    """A ramp tells the place in the frame, at crops of half the frame's size and of its own."""
    ramp = np.tile(2 * np.arange(128, dtype=np.uint8), (96, 1))  # of column i, whose centre is at i + 0.5
    image, matte = np.repeat(ramp[..., None], 3, axis=2), np.full((96, 128), 255, np.uint8)
    places = torch.tensor([[[50.5, 40.5], [60.25, 45.0], [70.0, 50.0]]], dtype=torch.float64)
    for scale in (0.5, 1.0):
        crops = cut_out(lambda _: image, lambda _: matte, range(1), np.array([[40.0, 30.0, 80.0, 60.0]]), scale)
        found = 127.5 * BlurredCrops(crops, 0.5).values(places, slice(0, 1))
        torch.testing.assert_close(found, places[..., 0] - 0.5, rtol=0, atol=0.1)
        assert crops.matte.all()
