"""The demo's person, speaking, as a face landmarker would see it; MediaPipe is not needed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from avatar.demo.identity import sample_identity
from avatar.demo.performance import Motion as Performed
from avatar.demo.performance import frame_camera, frame_params, perform
from avatar.demo.render import RenderedFrame, render_frame
from avatar.head.assets import HeadAssets, load_head_assets
from avatar.head.expression_names import ExpressionNames, load_expression_names
from avatar.head.model import HeadModel
from data_prep.track.faces.embedding import LandmarkEmbedding, iris_embedding
from data_prep.track.faces.landmark_groups import FEATURES
from data_prep.track.faces.landmarks import BLENDSHAPES, NUM_POINTS, Landmarks
from data_prep.track.fit.camera import Pinhole, to_camera
from data_prep.track.fit.frame_poses import Motion
from data_prep.track.fit.landmark_fit import LandmarkFit
from data_prep.track.fit.surface import SurfacePoints

SIZE, SEED, FPS = 160, 1, 25.0
NOISE = 0.012  # of the distance between the eyes: the landmarks' own
DRIFT = 0.03  # all landmarks of a frame together, as detectors err


@dataclass(frozen=True)
class Scene:
    assets: HeadAssets
    names: ExpressionNames
    camera: Pinhole
    screens: np.ndarray  # [T, V, 2] true vertices in pixels
    landmarks: Landmarks
    embedding: LandmarkEmbedding
    eyes: float  # pixels between the irises

    def error(self, fit: LandmarkFit, motion: Motion, frames: slice = slice(None)) -> float:
        """Of the face's vertices against the truth, but for what is the same in all frames; per cent of the eyes'."""
        face = self.assets.regions["face"]
        alone = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64).expand(len(face), 3)
        points = SurfacePoints(self.assets, face[:, None].expand(-1, 3), alone, len(fit.identity), fit.expressions)
        placed = self.camera.project(to_camera(motion, points.positions(fit.identity, motion))).numpy()
        residual = placed - self.screens[frames][:, face.numpy()]
        return 100 * float(np.linalg.norm(residual - residual.mean(0), axis=-1).mean()) / self.eyes


def spoken_scene(head_model: Path, frames: int, motion: Performed = "speech") -> Scene:
    assets = load_head_assets(head_model)
    head = HeadModel(assets, torch.from_numpy(sample_identity(SEED).shape).float())
    performance, rng = perform(SEED, max(frames, 40), motion), np.random.default_rng(0)
    face = assets.regions["face"].numpy()
    chosen = rng.choice(face, len(FEATURES), replace=False)
    embedding = LandmarkEmbedding(
        np.array(FEATURES), np.repeat(chosen[:, None], 3, axis=1), np.tile([1.0, 0.0, 0.0], (len(chosen), 1))
    )
    everything = embedding.with_others(iris_embedding(assets))
    screens = []
    points = np.zeros((frames, NUM_POINTS, 3), np.float32)
    for n in range(frames):
        params, camera = frame_params(performance, n), frame_camera(performance, n, SIZE)
        with torch.no_grad():
            screens.append(camera.project(head.vertices(params)).numpy()[:, :2])
        placed = (screens[-1][everything.corners] * everything.barycentric[..., None]).sum(1)
        points[n, everything.landmarks, :2] = placed
    eyes = float(np.linalg.norm(points[:, 473, :2] - points[:, 468, :2], axis=1).mean())
    points[..., :2] += NOISE * eyes * rng.standard_normal(points[..., :2].shape)
    drift = np.sin(np.arange(frames)[:, None] * np.array([0.9, 1.3]))
    points[..., :2] += (DRIFT * eyes * drift)[:, None]
    scores = np.zeros((frames, len(BLENDSHAPES)), np.float32)
    scores[:, BLENDSHAPES.index("jawOpen")] = np.clip(performance.jaw[:frames] / 0.3, 0, 1)
    for side, name in enumerate(("eyeBlinkLeft", "eyeBlinkRight")):
        scores[:, BLENDSHAPES.index(name)] = np.clip(performance.eyelids[:frames, side], 0, 1)
    landmarks = Landmarks(points, scores, np.ones(frames, bool), (SIZE, SIZE), FPS)
    names = load_expression_names(head_model, assets.num_expressions)
    pinhole = Pinhole(camera.fx, camera.fy, camera.cx, camera.cy)
    return Scene(assets, names, pinhole, np.stack(screens), landmarks, everything, eyes)


def drawn(frames: int) -> list[RenderedFrame]:
    """The pictures of these frames."""
    performance = perform(SEED, 40, "speech")
    return [render_frame(SEED, frame_params(performance, n), frame_camera(performance, n, SIZE)) for n in range(frames)]
