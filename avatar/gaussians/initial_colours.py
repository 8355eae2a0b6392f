"""What training frames show at places on the mesh: first colours."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from avatar.data.frame import Frame
from avatar.gaussians.mesh_embedding import Embedding
from avatar.head.model import HeadModel
from avatar.head.rasterize import rasterize_mesh
from avatar.head.sample_image import sample_image

DEPTH_TOLERANCE = 0.003  # metres behind the nearest surface at which a point still counts as seen
LEAST_WEIGHT = 1e-3  # of all frames together, for a place to count as seen


def mean_colours(
    mesh: HeadModel, embedding: Embedding, frames: Iterable[Frame]
) -> tuple[Float[Tensor, "N 3"], Bool[Tensor, " N"]]:
    """The mean colour that the frames show at each place, and which places they show.

    A frame counts by the cosine between the surface's normal and the line of sight, squared, times the matte, and not at
    all where the mesh hides the place.
    """
    return mean_of(len(embedding), (seen_colours(mesh, embedding, frame) for frame in frames))


def mean_of(
    N: int, looks: Iterable[tuple[Float[Tensor, "N 3"], Float[Tensor, " N"]]]
) -> tuple[Float[Tensor, "N 3"], Bool[Tensor, " N"]]:
    """The mean of what `seen_at` gave for N points in some frames, and which points they show."""
    total, weight = torch.zeros(N, 3), torch.zeros(N)
    for colours, shown in looks:
        total += colours * shown[:, None]
        weight += shown
    seen = weight > LEAST_WEIGHT
    mean = torch.zeros_like(total)
    mean[seen] = total[seen] / weight[seen, None]
    return mean, seen


def seen_colours(
    mesh: HeadModel, embedding: Embedding, frame: Frame
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, " N"]]:
    """The frame's colour at each place on the mesh, and how far the frame shows that place, in [0, 1]."""
    vertices = mesh.vertices(frame.params)
    points = embedding.points(vertices)
    corners = vertices[embedding.corners]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return seen_at(points, normals, vertices, mesh.faces, frame)


def seen_at(
    points: Float[Tensor, "N 3"],
    normals: Float[Tensor, "N 3"],
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    frame: Frame,
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, " N"]]:
    """The frame's colour at points with these normals (of any length), and how far the frame shows each, in [0, 1].

    vertices, faces  a posed mesh that hides what is behind it, metres
    """
    camera = frame.camera
    screen = camera.project(points)
    eye = -camera.R_cam_world.T @ camera.t_cam_world
    facing = torch.nn.functional.cosine_similarity(normals, eye - points, dim=-1).clamp(min=0)

    raster = rasterize_mesh(camera.project(vertices).numpy(), faces.numpy(), camera.height, camera.width)
    surface = torch.from_numpy(raster.depth).where(torch.from_numpy(raster.face_id) >= 0, torch.inf)
    nearest = sample_image(surface[..., None], screen, "nearest")[:, 0]  # 0 outside the image: nothing is seen there
    in_front = (screen[:, 2] > 0) & (screen[:, 2] <= nearest + DEPTH_TOLERANCE)
    matte = (frame.alpha * frame.head_mask)[..., None]
    pixels = sample_image(torch.cat((frame.image, matte), dim=-1), screen, "bilinear")
    return pixels[:, :3], facing.square() * pixels[:, 3] * in_front
