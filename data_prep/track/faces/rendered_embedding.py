"""A landmark embedding for any head model: render random heads of it, run the landmarker, and see where its points lie.

Each landmark goes to the vertex whose projections lie nearest to it (least median distance over the pictures), then to the
point of an adjacent triangle that does so best.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, UInt8

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
    """The 468 landmarks of the face mesh on `assets`, made now and kept for `cached_embedding`.

    Raises UserError when the landmarker finds no faces in the pictures of the head model.
    """
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


def make_embedding(assets: HeadAssets, landmarker: Landmarker) -> LandmarkEmbedding:
    """The embedding as `rendered_embedding` gives it, made now."""
    screens, seen, landmarks = [], [], []
    for head in render_tinted_heads(assets, HEADS):
        points = landmarker(head.image)
        if points is not None:
            screens.append(head.screen[:, :2].astype(np.float32))
            seen.append(head.is_visible)
            landmarks.append(points[:NUM_MESH, :2])
    if len(landmarks) < FEWEST:
        raise UserError(
            f"the landmarker found a face in {len(landmarks)} of {HEADS} pictures of the head model; put FLAME's "
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
    places = np.ascontiguousarray(screens[:, candidates].T)  # [2, C, P]
    corners, weights = [], []
    for landmark in np.moveaxis(landmarks, 1, 0):  # [P, 2]
        distance = np.hypot(*(places - landmark.T[:, None]))
        nearest = candidates[np.argsort(np.median(distance, axis=1))[:_NEIGHBOURS]]
        around = triangles[np.isin(triangles, nearest).any(1)]
        if not len(around):  # a vertex of no usable triangle: the vertex itself
            corners.append([nearest[0]] * 3)
            weights.append(np.array([1.0, 0.0, 0.0]))
            continue
        fitted, error = _fitted(screens[:, around].swapaxes(0, 1).astype(np.float64), landmark)
        best = int(np.argmin(error))
        corners.append(around[best])
        weights.append(fitted[best])
    return LandmarkEmbedding(np.arange(len(corners)), np.asarray(corners, np.int64), np.asarray(weights, np.float64))


def _fitted(
    corners: Float64[np.ndarray, "K P 3 2"], landmark: Float32[np.ndarray, "P 2"]
) -> tuple[Float64[np.ndarray, "K 3"], Float64[np.ndarray, " K"]]:
    """For each of K triangles barycentric weights >= 0 that bring its corners nearest to the landmark, and their median
    distance.

    Reweighted least squares for the sum of distances, which outliers do not decide.
    """
    edges = corners[:, :, 1:] - corners[:, :, :1]  # [K, P, 2, 2]
    offset = landmark - corners[:, :, 0]
    products = np.einsum("kpac,kpbc->kpab", edges, edges)
    sides = np.einsum("kpac,kpc->kpa", edges, offset)
    weight = np.ones(offset.shape[:2])
    for _ in range(_ITERATIONS):
        A = np.einsum("kp,kpab->kab", weight, products)
        b = np.einsum("kp,kpa->ka", weight, sides)
        inner = _on_triangle(np.einsum("kab,kb->ka", np.linalg.pinv(A, 1e-9, hermitian=True), b))
        distance = np.linalg.norm(offset - np.einsum("ka,kpac->kpc", inner, edges), axis=-1)
        weight = 1.0 / np.maximum(distance, 1e-2)
    return _with_first(inner), np.median(distance, axis=1)


def _on_triangle(inner: Float64[np.ndarray, "K 2"]) -> Float64[np.ndarray, "K 2"]:
    """The second and third barycentric weight, brought into the triangle."""
    weights = np.clip(_with_first(inner), 0.0, None)
    return (weights / weights.sum(axis=1, keepdims=True))[:, 1:]


def _with_first(inner: Float64[np.ndarray, "K 2"]) -> Float64[np.ndarray, "K 3"]:
    return np.concatenate((1.0 - inner.sum(axis=1, keepdims=True), inner), axis=1)
