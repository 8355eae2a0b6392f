"""Where on a head model MediaPipe's landmarks lie."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from avatar.errors import UserError
from avatar.files.pickles import load_npz, save_npz
from avatar.files.read import is_there
from avatar.head.assets import HeadAssets
from avatar.head.find_head_model import find_model_file
from avatar.head.model import LEFT_EYE, RIGHT_EYE
from data_prep.track.faces.landmark_groups import LEFT_IRIS, NUM_MESH, RIGHT_IRIS

OFFICIAL_FILE = "mediapipe_landmark_embedding.npz"  # of FLAME's downloads


@dataclass(frozen=True)
class LandmarkEmbedding:
    """L landmarks as points of a head model's triangles."""

    landmarks: Int[np.ndarray, " L"]  # MediaPipe's numbers
    corners: Int[np.ndarray, "L 3"]  # vertices
    barycentric: Float[np.ndarray, "L 3"]

    def __len__(self) -> int:
        return len(self.landmarks)

    def with_others(self, others: LandmarkEmbedding) -> LandmarkEmbedding:
        """These landmarks, and those of `others` that are not among them."""
        new = ~np.isin(others.landmarks, self.landmarks)
        return LandmarkEmbedding(
            np.concatenate((self.landmarks, others.landmarks[new])),
            np.concatenate((self.corners, others.corners[new])),
            np.concatenate((self.barycentric, others.barycentric[new])),
        )


def official_file(head: Path) -> Path:
    """Where the embedding of a head model (file or folder) would lie."""
    return find_model_file(head).parent / OFFICIAL_FILE


def official_embedding(head: Path, assets: HeadAssets) -> LandmarkEmbedding | None:
    """The embedding that lies beside a head model (file or folder); None where there is none.

    Its 105 points are contours of eyes, brows, nose and lips. Raises UserError for a file that does not fit the model.
    """
    path = official_file(head)
    if not is_there(path):
        return None
    arrays = load_npz(path)
    missing = [key for key in ("lmk_face_idx", "lmk_b_coords", "landmark_indices") if key not in arrays]
    if missing:
        raise UserError(
            f"{path} is not FLAME's MediaPipe embedding: it lacks {', '.join(missing)}; remove or replace it"
        )
    return checked_embedding(
        path, arrays["landmark_indices"], arrays["lmk_face_idx"], arrays["lmk_b_coords"], assets.faces.numpy()
    )


def checked_embedding(
    path: Path, landmarks: np.ndarray, triangles: np.ndarray, barycentric: np.ndarray, faces: np.ndarray
) -> LandmarkEmbedding:
    """Raises UserError, naming the file, where numbers are out of range or do not belong together."""
    L = landmarks.size
    if L == 0 or triangles.size != L or barycentric.size != 3 * L:
        raise UserError(
            f"{path} holds {L} landmarks, {triangles.size} triangles and {barycentric.size} weights; remove or replace it"
        )
    for name, values, count in (("a landmark", landmarks, NUM_MESH), ("a triangle", triangles, len(faces))):
        if values.dtype.kind not in "iu" or values.min() < 0 or values.max() >= count:
            raise UserError(f"{path} names {name} that does not exist (there are {count}); remove or replace it")
    with np.errstate(invalid="ignore", over="ignore"):  # refused below, and needs no warning before that
        weights = barycentric.reshape(L, 3).astype(np.float64)
    if not np.isfinite(weights).all() or np.abs(weights.sum(1) - 1).max() > 1e-2:
        raise UserError(f"{path} holds barycentric weights that do not sum to one; remove or replace it")
    return LandmarkEmbedding(landmarks.ravel().astype(np.int64), faces[triangles.ravel()].astype(np.int64), weights)


def iris_embedding(assets: HeadAssets) -> LandmarkEmbedding:
    """The centres of the irises: the point of each eyeball that looks ahead when the eye is at rest.

    Empty for a head model whose eyes have no vertices of their own.
    """
    at = (assets.joint_regressor @ assets.template).numpy()
    template, weights = assets.template.numpy(), assets.weights.numpy()
    landmarks, corners = [], []
    for landmark, joint in ((LEFT_IRIS, LEFT_EYE), (RIGHT_IRIS, RIGHT_EYE)):
        ball = np.flatnonzero(weights[:, joint] > 0.5)
        if len(ball) == 0:
            continue
        forward = (template[ball] - at[joint]) @ np.array([0.0, 0.0, 1.0])
        aside = np.linalg.norm((template[ball] - at[joint])[:, :2], axis=1)
        in_front = np.where(forward > 0, aside, np.inf)  # the straightest ahead, not the highest: corneas bulge
        landmarks.append(landmark)
        corners.append([int(ball[in_front.argmin()])] * 3)
    weights_of = np.tile([1.0, 0.0, 0.0], (len(landmarks), 1))
    return LandmarkEmbedding(np.array(landmarks, np.int64), np.array(corners, np.int64).reshape(-1, 3), weights_of)


def save_embedding(path: Path, embedding: LandmarkEmbedding) -> None:
    save_npz(path, {name: getattr(embedding, name) for name in ("landmarks", "corners", "barycentric")})


def load_embedding(path: Path, assets: HeadAssets) -> LandmarkEmbedding | None:
    """What `save_embedding` wrote for this head model; None where it is missing or damaged, since it can be made again."""
    try:
        arrays = load_npz(path)
        found = LandmarkEmbedding(arrays["landmarks"], arrays["corners"], arrays["barycentric"])
        L = len(found.landmarks)
        fits = found.corners.shape == found.barycentric.shape == (L, 3) and L > 0
        in_range = fits and found.corners.min() >= 0 and found.corners.max() < assets.num_vertices
        return found if in_range and np.isfinite(found.barycentric).all() else None
    except (UserError, KeyError, ValueError, TypeError):
        return None


def as_points(embedding: LandmarkEmbedding) -> tuple[Int[Tensor, "L 3"], Float[Tensor, "L 3"]]:
    return torch.from_numpy(embedding.corners), torch.from_numpy(embedding.barycentric)
