"""First colours: what the training frames show where each Gaussian is."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.data.split import evenly_spread
from avatar.data.subject import Subject
from avatar.gaussians.base_model import Avatar
from avatar.head.rasterize import rasterize_mesh
from avatar.head.sample_image import sample_image
from avatar.splat.sh import C0
from avatar.types import Frame

FRAMES = 16  # evenly spread over the training frames: enough for every head turn to take part
DEPTH_TOLERANCE = 0.003  # metres behind the nearest surface at which a point still counts as seen


@torch.no_grad()
def colour_from_frames(avatar: Avatar, subject: Subject, size: int | None, frames: int = FRAMES) -> int:
    """Set the base colour of each Gaussian to the mean that `frames` training frames show at its place.

    A frame counts by the cosine between the surface's normal and the line of sight, squared, times the matte, and not at
    all where the mesh hides the place. Gaussians that no frame shows keep their colour. Returns how many were coloured.
    """
    total, weight = torch.zeros(len(avatar), 3), torch.zeros(len(avatar))
    for index in evenly_spread(subject.split.train, frames):
        colours, seen = seen_colours(avatar, subject.frame(index, size))
        total += colours * seen[:, None]
        weight += seen
    coloured = weight > 1e-3
    mean = total[coloured] / weight[coloured, None]
    avatar.sh_dc[coloured, 0] = (mean - 0.5) / C0
    return int(coloured.sum())


def seen_colours(avatar: Avatar, frame: Frame) -> tuple[Float[Tensor, "N 3"], Float[Tensor, " N"]]:
    """The frame's colour at each Gaussian's place on the mesh, and how far the frame shows that place, in [0, 1]."""
    vertices = avatar.mesh.vertices(frame.params)
    points = avatar.embedding.points(vertices)
    camera = frame.camera
    screen = camera.project(points)
    corners = vertices[avatar.embedding.corners]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    eye = -camera.R_cam_world.T @ camera.t_cam_world
    facing = torch.nn.functional.cosine_similarity(normals, eye - points, dim=-1).clamp(min=0)

    raster = rasterize_mesh(camera.project(vertices).numpy(), avatar.mesh.faces.numpy(), camera.height, camera.width)
    surface = torch.from_numpy(raster.depth).where(torch.from_numpy(raster.face_id) >= 0, torch.inf)
    nearest = sample_image(surface[..., None], screen, "nearest")[:, 0]  # 0 outside the image: nothing is seen there
    in_front = (screen[:, 2] > 0) & (screen[:, 2] <= nearest + DEPTH_TOLERANCE)
    matte = (frame.alpha * frame.head_mask)[..., None]
    pixels = sample_image(torch.cat((frame.image, matte), dim=-1), screen, "bilinear")
    return pixels[:, :3], facing.square() * pixels[:, 3] * in_front
