"""A landmark embedding for any head model: render random heads of it, run the landmarker, and see where its points lie.

Each landmark goes to the vertex whose projections lie nearest to it (least median distance over the pictures), then to the
point of an adjacent triangle that does so best.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from avatar.errors import UserError
from avatar.files.environment import cache_folder
from avatar.files.third_party import FACE_LANDMARKER
from avatar.head.assets import HeadAssets
from avatar.head.model import LEFT_EYE, RIGHT_EYE
from data_prep.track.faces.embedding import LandmarkEmbedding, load_embedding, save_embedding
from data_prep.track.faces.landmark_groups import NUM_MESH
from data_prep.track.faces.synthetic_heads import render_tinted_heads

Landmarker = Callable[[UInt8[np.ndarray, "H W 3"]], Float32[np.ndarray, "478 3"] | None]
"""One picture in, its landmarks in pixels out; None where there is no face."""

HEADS = 80
FEWEST = 20  # pictures with a face, below which nothing is learned
RECIPE = 1  # counts changes of the pictures and of the search; a cached embedding is of one recipe
_SEEN_SHARE = 0.35  # of the pictures in which a vertex must be visible to be a candidate
_NEIGHBOURS = 6  # vertices whose triangles are tried for a landmark
_ITERATIONS = 20


def rendered_embedding(
    assets: HeadAssets, landmarker: Landmarker, say: Callable[[str], object] = lambda _: None
) -> LandmarkEmbedding:
    """The 468 landmarks of the face mesh on `assets`, from the cache where it was made before.

    Raises UserError when the landmarker finds no faces in the pictures of the head model.
    """
    found = cached_embedding(assets)
    if found is None:
        say("looking for the landmarks on the head model (once for each head model)")
        found = make_embedding(assets, landmarker)
        save_embedding(_place(assets), found)
    return found


def cached_embedding(assets: HeadAssets) -> LandmarkEmbedding | None:
    """What `rendered_embedding` made before, if it did."""
    return load_embedding(_place(assets), assets)


def _place(assets: HeadAssets) -> Path:
    name = f"{assets.fingerprint[:16]}-{FACE_LANDMARKER.sha256[:8]}-{RECIPE}.npz"
    return cache_folder() / "embeddings" / name


def make_embedding(assets: HeadAssets, landmarker: Landmarker, heads: int = HEADS) -> LandmarkEmbedding:
    """The embedding as `rendered_embedding` gives it, made now."""
    screens, seen, landmarks = [], [], []
    for head in render_tinted_heads(assets, heads):
        points = landmarker(head.image)
        if points is not None:
            screens.append(head.screen[:, :2].astype(np.float32))
            seen.append(head.is_visible)
            landmarks.append(points[:NUM_MESH, :2])
    if len(landmarks) < min(FEWEST, heads):
        raise UserError(
            f"the landmarker found a face in {len(landmarks)} of {heads} pictures of the head model; put FLAME's "
            "mediapipe_landmark_embedding.npz beside it, or use another head model"
        )
    return locate(assets, np.stack(screens), np.stack(seen), np.stack(landmarks))


def locate(
    assets: HeadAssets,
    screens: Float32[np.ndarray, "P V 2"],
    seen: np.ndarray,
    landmarks: Float32[np.ndarray, "P L 2"],
) -> LandmarkEmbedding:
    """The points of the head model that lie under `landmarks` in P pictures; `seen` [P, V] says what is visible."""
    faces = assets.faces.numpy()
    is_eyeball = (assets.weights[:, [LEFT_EYE, RIGHT_EYE]] > 0.5).any(1).numpy()
    candidates = np.flatnonzero((seen.mean(0) >= _SEEN_SHARE) & ~is_eyeball)
    usable = np.zeros(len(is_eyeball), bool)
    usable[candidates] = True
    triangles = faces[usable[faces].all(1)]
    corners, weights = [], []
    for k in range(landmarks.shape[1]):
        distance = np.linalg.norm(screens[:, candidates] - landmarks[:, k, None], axis=-1)  # [P, C]
        nearest = candidates[np.argsort(np.median(distance, axis=0))[:_NEIGHBOURS]]
        around = triangles[np.isin(triangles, nearest).any(1)]
        own = [_fitted(screens[:, triangle].astype(np.float64), landmarks[:, k]) for triangle in around]
        if not own:  # a vertex of no usable triangle: the vertex itself
            corners.append([nearest[0]] * 3)
            weights.append(np.array([1.0, 0.0, 0.0]))
            continue
        best = int(np.argmin([error for _, error in own]))
        corners.append(around[best])
        weights.append(own[best][0])
    return LandmarkEmbedding(
        np.arange(landmarks.shape[1]), np.asarray(corners, np.int64), np.asarray(weights, np.float64)
    )


def _fitted(corners: np.ndarray, landmark: np.ndarray) -> tuple[np.ndarray, float]:
    """Barycentric weights [3] >= 0 that bring corners [P, 3, 2] nearest to a landmark [P, 2], and their median distance.

    Reweighted least squares for the sum of distances, which outliers do not decide.
    """
    edges = corners[:, 1:] - corners[:, :1]  # [P, 2, 2]
    offset = landmark - corners[:, 0]
    weight = np.ones(len(corners))
    inner = np.full(2, 1 / 3)
    for _ in range(_ITERATIONS):
        A = np.einsum("p,pac,pbc->ab", weight, edges, edges)
        b = np.einsum("p,pac,pc->a", weight, edges, offset)
        inner = np.linalg.lstsq(A, b, rcond=1e-9)[0]
        inner = _on_triangle(inner)
        distance = np.linalg.norm(offset - np.einsum("a,pac->pc", inner, edges), axis=-1)
        weight = 1.0 / np.maximum(distance, 1e-2)
    return np.array([1.0 - inner.sum(), *inner]), float(np.median(distance))


def _on_triangle(inner: np.ndarray) -> np.ndarray:
    """The second and third barycentric weight, brought into the triangle."""
    weights = np.clip(np.array([1.0 - inner.sum(), *inner]), 0.0, None)
    return (weights / weights.sum())[1:]
