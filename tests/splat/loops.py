"""The splatter once more, as loops over pixels and splats in numpy, from the textbook form with an inverted covariance.

Written apart from both backends (no whitening, no tiles, no chunks, no shared formula but the definition), to check them.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation
from splat.scenes import Scene

from avatar.splat.sh import sh_basis


def splat_by_loops(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Image [H, W, 3] and alpha [H, W] in float64."""
    camera, o = scene.camera, scene.options
    alpha_min = float(np.float32(o.get("alpha_min", 1 / 255)))
    alpha_max, t_min = float(np.float32(o.get("alpha_max", 0.999))), float(np.float32(o.get("t_min", 1e-4)))
    R, t = camera.R_cam_world.double().numpy(), camera.t_cam_world.double().numpy()
    splats = []
    for i, fields in enumerate(zip(*(f.double().numpy() for f in scene.gaussians), strict=True)):
        mean, quat, scales, opacity, sh = fields
        p = R @ mean + t
        if p[2] < o.get("near", 0.01) or opacity < alpha_min:
            continue
        limits = []
        for axis, (f, c, size) in enumerate(
            ((camera.fx, camera.cx, camera.width), (camera.fy, camera.cy, camera.height))
        ):
            margin = 0.3 * 0.5 * size / f
            limits.append(min(max(p[axis] / p[2], -c / f - margin), (size - c) / f + margin))
        J = np.array(
            [
                [camera.fx / p[2], 0, -camera.fx * limits[0] / p[2]],
                [0, camera.fy / p[2], -camera.fy * limits[1] / p[2]],
            ]
        )
        rotation = Rotation.from_quat(np.roll(quat, -1)).as_matrix()
        world = rotation @ np.diag(scales**2) @ rotation.T
        flat = J @ R @ world @ R.T @ J.T
        covariance = flat + o.get("blur", 0.3) * np.eye(2)
        if o.get("antialiased", False):
            opacity = opacity * math.sqrt(max(np.linalg.det(flat) / np.linalg.det(covariance), 0.0))
        degree = o.get("sh_degree", math.isqrt(len(sh)) - 1)
        direction = mean + R.T @ t
        basis = sh_basis(scene.gaussians.means.new_tensor(direction / np.linalg.norm(direction)).double()[None], degree)
        colour = np.maximum(basis[0].numpy() @ sh[: basis.shape[1]] + 0.5, 0)
        centre = np.array(
            [camera.fx * p[0] / p[2] + camera.cx, camera.fy * p[1] / p[2] + camera.cy],
        )
        splats.append((p[2], i, centre, np.linalg.inv(covariance), opacity, colour))
    splats.sort(key=lambda s: s[:2])

    image = np.empty((camera.height, camera.width, 3))
    alphas = np.empty((camera.height, camera.width))
    for row in range(camera.height):
        for column in range(camera.width):
            colour, transmittance = np.zeros(3), 1.0
            for _, _, centre, conic, opacity, splat_colour in splats:
                d = np.array([column + 0.5, row + 0.5]) - centre
                alpha = min(opacity * math.exp(-0.5 * d @ conic @ d), alpha_max)
                if alpha < alpha_min:
                    continue
                if transmittance * (1 - alpha) < t_min:
                    break
                colour += transmittance * alpha * splat_colour
                transmittance *= 1 - alpha
            image[row, column] = colour + transmittance * scene.background.double().numpy()
            alphas[row, column] = 1 - transmittance
    return image, alphas
