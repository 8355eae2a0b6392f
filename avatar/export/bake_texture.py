"""An avatar's look as a texture: what is seen of each texel from several sides, the more squarely the more it counts."""

from __future__ import annotations

from typing import cast

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from avatar.gaussians.mesh_embedding import Embedding
from avatar.gaussians.uv import painted, uv_texels
from avatar.gaussians.uv_base_model import UVAvatar
from avatar.head.rasterize import rasterize_mesh
from avatar.head.sample_image import sample_image
from avatar.motion.orbit import orbited
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.splat.sh import C0
from avatar.types import Camera, HeadParams

YAWS, PITCHES = (-60.0, -30.0, 0.0, 30.0, 60.0), (-25.0, 0.0, 25.0)  # degrees from the camera at rest
SHARPNESS = 2  # power of the cosine between a texel's normal and the ray: squarely seen texels win
# Factor of a view's weight for every degree from the front: other views only fill, because what stands off the mesh, such
# as glasses, lies elsewhere on it in each, and because the training video shows the sides less.
ASIDE = 0.8
SOLID = 0.7  # least alpha of a pixel that counts; what shines through from behind is taken out
BEHIND = 0.003  # metres by which a texel may lie behind the mesh and still be seen
PICTURE = 2  # pixels of a picture for each of the texture, sideways


def bake_texture(trained: TrainedAvatar, params: HeadParams, size: int) -> UInt8[np.ndarray, "S S 3"]:
    """The map of a face as posed, rows from the top. What no side sees takes the Gaussians' own colour there."""
    texels = uv_texels(trained.assets, size)
    embedding = Embedding(trained.assets, texels)
    vertices = trained.avatar.vertices(params)
    points = embedding.points(vertices)
    normals = _normals(vertices, trained.assets.faces)[texels.face]
    colours, weights = torch.zeros(len(points), 3), torch.zeros(len(points))
    front = trained.rest_camera(min(PICTURE * size, 1024))
    for yaw in YAWS:
        for pitch in PITCHES:
            camera = orbited(front, yaw, pitch)
            rendering = trained.render(params, camera)
            own = rendering.image - (1 - rendering.alpha[..., None]) * trained.background
            found = sample_image(
                torch.cat((own, rendering.alpha[..., None]), dim=2), camera.project(points), "bilinear"
            )
            weight = ASIDE ** max(abs(yaw), abs(pitch)) * (found[:, 3] > SOLID)
            weight = weight * _seen(trained, vertices, points, normals, camera)
            colours += weight[:, None] * found[:, :3] / found[:, 3:].clamp(min=SOLID)
            weights += weight
    texture, is_known = np.zeros((size, size, 3), np.float32), np.zeros((size, size), bool)
    row, column = texels.row.numpy(), texels.column.numpy()
    known = (weights > 0).numpy()
    texture[row, column] = (colours / weights.clamp(min=1e-30)[:, None]).numpy()
    is_known[row[known], column[known]] = True
    _fill_from_gaussians(trained, texture, is_known)
    pixels = (texture.clip(0, 1) * 255 + 0.5).astype(np.uint8)
    # Around the charts too: a viewer's filter reads over their edges.
    return _spread(pixels, is_known)


def _seen(
    trained: TrainedAvatar,
    vertices: Float[Tensor, "V 3"],
    points: Float[Tensor, "N 3"],
    normals: Float[Tensor, "N 3"],
    camera: Camera,
) -> Float[Tensor, " N"]:
    """How squarely each point is seen, 0 where it is hidden or outside."""
    faces = trained.assets.faces.numpy()
    raster = rasterize_mesh(camera.project(vertices).numpy(), faces, camera.height, camera.width)
    x, y, depth = camera.project(points).unbind(dim=1)
    inside = (x > 1) & (y > 1) & (x < camera.width - 1) & (y < camera.height - 1)
    column, row = x.long().clamp(0, camera.width - 1), y.long().clamp(0, camera.height - 1)
    nearest = torch.from_numpy(raster.depth)[row, column]
    eye = -camera.R_cam_world.T @ camera.t_cam_world
    facing = (torch.nn.functional.normalize(eye - points, dim=1) * normals).sum(dim=1)
    visible = inside & (depth < nearest + BEHIND) & (facing > 0.05)
    return visible * facing.clamp(min=0) ** SHARPNESS


def _normals(vertices: Float[Tensor, "V 3"], faces: Tensor) -> Float[Tensor, "F 3"]:
    a, b, c = vertices[faces].unbind(dim=1)
    return torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=1)


def _fill_from_gaussians(trained: TrainedAvatar, texture: np.ndarray, is_known: np.ndarray) -> None:
    """Give texels that nobody has seen the mean colour of the Gaussian of that place."""
    model = cast(UVAvatar, trained.avatar)  # others are refused before
    with torch.no_grad():
        values = (model.sh_dc[:, 0] * C0 + 0.5).clamp(0, 1).numpy()
    coarse, covered = painted(model.embedding.texels, values)
    size = len(texture)
    fine = cv2.resize(coarse, (size, size), interpolation=cv2.INTER_NEAREST)
    has = cv2.resize(covered.astype(np.uint8), (size, size), interpolation=cv2.INTER_NEAREST).astype(bool)
    take = has & ~is_known
    texture[take] = fine[take]
    is_known |= take


def _spread(pixels: UInt8[np.ndarray, "S S 3"], is_known: np.ndarray) -> UInt8[np.ndarray, "S S 3"]:
    """The nearest known texel's colour everywhere else."""
    _, labels = cv2.distanceTransformWithLabels(
        (~is_known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    labels = np.asarray(labels, np.int64)
    of_label = np.zeros((int(labels.max()) + 1, 3), np.uint8)
    of_label[labels[is_known]] = pixels[is_known]
    return of_label[labels]
