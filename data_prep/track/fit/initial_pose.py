"""Where the fit starts: each frame's pose from the landmarks of the head at rest."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from data_prep.track.fit.camera import Pinhole

_BEHIND = 1e-3  # metres; a head nearer than this is not in front of the camera


def start_poses(
    points: Float[np.ndarray, "L 3"], observed: Float[np.ndarray, "T L 2"], camera: Pinhole
) -> tuple[Float[Tensor, "T 3 3"], Float[Tensor, "T 3"]]:
    """R and t of every frame by SQPnP, refined by Levenberg-Marquardt on the reprojection error.

    Source: Terzakis and Lourakis, "A consistently fast and globally optimal solution to the perspective-n-point problem"
    (2020), in OpenCV. A frame whose solution lies behind the camera takes that of the frame before it.
    """
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    R, t = np.tile(np.diag([1.0, -1.0, -1.0]), (len(observed), 1, 1)), np.tile([0.0, 0.0, 1.0], (len(observed), 1))
    last = None
    points = np.ascontiguousarray(points, np.float64)
    for frame, pixels in enumerate(np.ascontiguousarray(observed, np.float64)):
        solved, turn, shift = cv2.solvePnP(points, pixels, K, None, flags=cv2.SOLVEPNP_SQPNP)
        if solved:
            turn, shift = cv2.solvePnPRefineLM(points, pixels, K, None, turn, shift)
        if solved and np.isfinite(turn).all() and shift[2, 0] > _BEHIND:
            last = (cv2.Rodrigues(turn)[0], shift[:, 0])
        if last is not None:
            R[frame], t[frame] = last
    return torch.from_numpy(R), torch.from_numpy(t)
