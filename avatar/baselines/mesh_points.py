"""Points that lie on a mesh, or at a height over it, and can walk from triangle to triangle.

A point is embedded as (triangle k, place in it, height h) and is posed with the mesh as

    p = V(k, b) + h N(k, b)

V(k, b) interpolates the triangle's posed corners by the place's barycentric coordinates b, N(k, b) its vertices' normals
(a Phong surface). Source: Shao et al., SplattingAvatar (CVPR 2024), as its abstract and HyperGaussians (CVPR 2026) describe
it.

The place is kept in metres, in the plane of the triangle of the neutral mesh: corner 0 at the origin, corner 1 on the
first axis. So a learning rate means the same in small and large triangles. A place that has left its triangle is carried
over the edge as if the two triangles were unfolded into one plane, which is a rotation and a shift; over the mesh's rim
nothing goes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np
import torch
from jaxtyping import Float, Int
from kornia.geometry.conversions import rotation_matrix_to_quaternion
from torch import Tensor, nn
from torch.nn.functional import normalize

from avatar.gaussians.apply_offsets import quaternion_product
from avatar.head.normals import vertex_normals
from avatar.tensors import take_rows

MOST_CROSSINGS = 8  # of edges at once; a place that is then outside still is set on the rim of its triangle
LEAST_HEIGHT = 1e-7  # metres, of a triangle: a degenerate one takes part as one of this height


class MeshPoints(nn.Module):
    """N points on a mesh of F triangles; `learned`: places are trained."""

    face: Int[Tensor, " N"]
    place: Float[Tensor, "N 3"]  # metres: x and y in the triangle's plane, height
    _faces: Int[Tensor, "F 3"]
    _corners: Float[Tensor, "F 3 2"]  # of the neutral triangles, as `flat_corners` lays them
    _across: Int[Tensor, "F 3"]  # with _turn and _shift: what lies over the edges, as `unfolding` says
    _turn: Float[Tensor, "F 3 2 2"]
    _shift: Float[Tensor, "F 3 2"]
    _inverse_frames: Float[Tensor, "F 4"]  # from the orientations of the neutral triangles

    def __init__(self, num_points: int, *, learned: bool) -> None:
        super().__init__()
        self.register_buffer("face", torch.zeros(num_points, dtype=torch.long))
        place = torch.zeros(num_points, 3)  # x, y, height
        self.register_load_state_dict_post_hook(lambda points, _: points.check())
        self.register_parameter("place", nn.Parameter(place)) if learned else self.register_buffer("place", place)

    @torch.no_grad()
    def bind(
        self,
        faces: Int[Tensor, "F 3"],
        neutral: Float[Tensor, "V 3"],
        face: Int[Tensor, " N"],
        barycentric: Float[Tensor, "N 3"],
    ) -> Self:
        """Put the points on a mesh; places are measured on its vertices `neutral`, metres.

        face         each point's triangle at first
        barycentric  its place there, sums of 1
        """
        corners = flat_corners(neutral[faces])
        constants = dict(zip(("across", "turn", "shift"), unfolding(faces, corners), strict=True))
        inverse = frame_quats(neutral[faces]) * neutral.new_tensor((1, -1, -1, -1))
        constants |= {"faces": faces, "corners": corners, "inverse_frames": inverse}
        for name, value in constants.items():
            self.register_buffer(f"_{name}", value, persistent=False)
        self.face.copy_(face)
        self.place[:, :2] = torch.einsum("nc,ncd->nd", barycentric, corners[face])
        return self

    def barycentric(self) -> Float[Tensor, "N 3"]:
        """Of the places; outside a triangle one or two are negative."""
        return barycentric_of(self.place[:, :2], self._corners[self.face])

    def points(self, vertices: Float[Tensor, "V 3"]) -> Float[Tensor, "N 3"]:
        """The points on the posed mesh, metres."""
        corners, weights = self._faces[self.face], self.barycentric()[..., None]
        normals = vertex_normals(vertices, self._faces)
        surface, normal = ((take_rows(values, corners) * weights).sum(dim=1) for values in (vertices, normals))
        return surface + self.place[:, 2:] * normalize(normal, dim=-1)

    def turns(self, vertices: Float[Tensor, "V 3"]) -> Float[Tensor, "N 4"]:
        """The rotation of each point's triangle from the neutral to the posed mesh, (w, x, y, z)."""
        inverse = self._inverse_frames[self.face]
        return quaternion_product(frame_quats(take_rows(vertices, self._faces[self.face])), inverse)

    @torch.no_grad()
    def walk(self, carried: Sequence[Float[Tensor, "N 3"]] = ()) -> int:
        """Carry every place that has left its triangle into the one where it is; returns how many had.

        `carried` are tensors of directions in the triangles' planes, such as an optimizer's momentum, that turn along.
        """
        left = 0
        for crossing in range(MOST_CROSSINGS + 1):
            barycentric = self.barycentric()
            outside = (barycentric.amin(dim=1) < 0).nonzero()[:, 0]
            left = left or len(outside)
            if len(outside) == 0:
                break
            face, side = self.face[outside], barycentric[outside].argmin(dim=1)
            across = self._across[face, side]
            stays = (across < 0) | (crossing == MOST_CROSSINGS)
            self._set_on_rim(outside[stays], barycentric[outside[stays]])
            moves, face, side = outside[~stays], face[~stays], side[~stays]
            turn = self._turn[face, side]
            for directions in carried:
                directions[moves, :2] = torch.einsum("nij,nj->ni", turn, directions[moves, :2])
            place = torch.einsum("nij,nj->ni", turn, self.place[moves, :2]) + self._shift[face, side]
            self.place[moves, :2] = place
            self.face[moves] = across[~stays]
        return left

    def _set_on_rim(self, which: Int[Tensor, " M"], barycentric: Float[Tensor, "M 3"]) -> None:
        inside = barycentric.clamp(min=0)
        inside = inside / inside.sum(dim=1, keepdim=True)
        self.place[which, :2] = torch.einsum("nc,ncd->nd", inside, self._corners[self.face[which]])

    def check(self) -> None:
        """Raises ValueError for a point on a triangle that there is not."""
        if bool(((self.face < 0) | (self.face >= len(self._faces))).any()):
            raise ValueError(f"has points on triangles that its head model of {len(self._faces)} does not have")


def flat_corners(corners: Float[Tensor, "F 3 3"]) -> Float[Tensor, "F 3 2"]:
    """Triangles in their own planes: corner 0 at the origin, corner 1 on the first axis, corner 2 on its positive side."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    length = first.norm(dim=-1).clamp(min=LEAST_HEIGHT)
    along = (first * second).sum(dim=-1) / length
    height = (second.square().sum(dim=-1) - along.square()).clamp(min=0).sqrt().clamp(min=LEAST_HEIGHT)
    zero = torch.zeros_like(length)
    flat = (zero, zero), (length, zero), (along, height)
    return torch.stack([torch.stack(corner, dim=-1) for corner in flat], dim=1)


def barycentric_of(place: Float[Tensor, "N 2"], corners: Float[Tensor, "N 3 2"]) -> Float[Tensor, "N 3"]:
    """In triangles as `flat_corners` lays them."""
    length, (along, height) = corners[:, 1, 0], corners[:, 2].unbind(-1)
    third = place[:, 1] / height
    second = (place[:, 0] - third * along) / length
    return torch.stack((1 - second - third, second, third), dim=-1)


def unfolding(
    faces: Int[Tensor, "F 3"], corners: Float[Tensor, "F 3 2"]
) -> tuple[Int[Tensor, "F 3"], Float[Tensor, "F 3 2 2"], Float[Tensor, "F 3 2"]]:
    """What lies across each triangle's edges, edge k being opposite corner k: the triangle (-1: none), and the rotation and
    shift that take places in this triangle's plane to places in that one's."""
    table = faces.cpu().numpy()
    F = len(table)
    ends = np.stack((np.roll(table, -1, axis=1), np.roll(table, -2, axis=1)), axis=-1).reshape(-1, 2)  # of edge 3 f + k
    key = np.sort(ends, axis=1)
    order = np.lexsort((key[:, 1], key[:, 0]))
    # Neighbours of one orientation run along their edge in opposite directions; others cannot be unfolded by a rotation.
    same = (ends[order[1:]] == ends[order[:-1]][:, ::-1]).all(axis=1)
    partner = np.full(3 * F, -1)
    partner[order[:-1][same]], partner[order[1:][same]] = order[1:][same], order[:-1][same]
    across = torch.from_numpy(np.where(partner >= 0, partner // 3, -1).reshape(F, 3)).to(faces.device)

    start, stop = corners.roll(-1, 1).reshape(-1, 2), corners.roll(-2, 1).reshape(-1, 2)
    other = torch.from_numpy(np.maximum(partner, 0)).to(faces.device)
    there_start, there_stop = stop[other], start[other]
    here, there = normalize(stop - start, dim=-1), normalize(there_stop - there_start, dim=-1)
    cosine, sine = (here * there).sum(dim=-1), here[:, 0] * there[:, 1] - here[:, 1] * there[:, 0]
    turn = torch.stack((torch.stack((cosine, -sine), -1), torch.stack((sine, cosine), -1)), -2)
    middle, there_middle = (start + stop) / 2, (there_start + there_stop) / 2
    shift = there_middle - torch.einsum("eij,ej->ei", turn, middle)
    return across, turn.reshape(F, 3, 2, 2), shift.reshape(F, 3, 2)


def frame_quats(corners: Float[Tensor, "N 3 3"]) -> Float[Tensor, "N 4"]:
    """The orientation of triangles: first axis along the first edge, third along the normal; (w, x, y, z)."""
    first = normalize(corners[:, 1] - corners[:, 0], dim=-1)
    normal = normalize(torch.linalg.cross(first, corners[:, 2] - corners[:, 0]), dim=-1)
    return rotation_matrix_to_quaternion(torch.stack((first, torch.linalg.cross(normal, first), normal), dim=-1))
