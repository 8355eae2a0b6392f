"""Where the fit starts: each frame's pose from the landmarks of the head at rest."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avatar.errors import UserError
from data_prep.track.fit.camera import Pinhole

_BEHIND = 1e-3  # metres; a head nearer than this is not in front of the camera


def start_poses(
    points: Float[np.ndarray, "L 3"], observed: Float[np.ndarray, "T L 2"], camera: Pinhole
) -> tuple[Float[Tensor, "T 3 3"], Float[Tensor, "T 3"]]:
    """R and t of every frame by SQPnP, refined by Levenberg-Marquardt on the reprojection error.

    Source: Terzakis and Lourakis, "A consistently fast and globally optimal solution to the perspective-n-point problem"
    (2020), in OpenCV. A frame without a solution before the camera takes that of the frame before it, or of the first that
    has one. Raises UserError where none has one.
    """
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    poses: list[tuple[np.ndarray, np.ndarray] | None] = []
    points = np.ascontiguousarray(points, np.float64)
    for pixels in np.ascontiguousarray(observed, np.float64):
        poses.append(_solved(points, pixels, K) or (poses[-1] if poses else None))
    first = next((pose for pose in poses if pose is not None), None)
    if first is None:
        raise UserError(
            "no picture shows the landmarks as this lens sees a head: give the video's own --fov or --focal"
        )
    R, t = map(np.stack, zip(*(pose or first for pose in poses), strict=True))
    return torch.from_numpy(R), torch.from_numpy(t)


def _solved(points: np.ndarray, pixels: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    try:
        solved, turn, shift = cv2.solvePnP(points, pixels, K, None, flags=cv2.SOLVEPNP_SQPNP)
        if solved:
            turn, shift = cv2.solvePnPRefineLM(points, pixels, K, None, turn, shift)
    except cv2.error:  # the face is too small for this lens
        return None
    is_before = solved and np.isfinite(turn).all() and shift[2, 0] > _BEHIND
    return (cv2.Rodrigues(turn)[0], shift[:, 0]) if is_before else None
