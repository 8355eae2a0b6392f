"""Gaussians in the PLY files of 3D Gaussian splatting, which viewers and editors of splats read.

x y z, nx ny nz (zero), f_dc_0..2, f_rest_0..44 (channel by channel, padded with zeros to degree 3), opacity (logit),
scale_0..2 (natural logarithm, metres), rot_0..3 (w x y z); float32, little-endian. Most viewers take -y as up, as after
training on COLMAP's cameras. The head's pose is in the camera and therefore not in the file.
"""

from __future__ import annotations

from math import sqrt
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avatar.errors import UserError
from avatar.gaussians.apply_offsets import quaternion_product
from avatar.splat.sh import MAX_DEGREE, sh_basis, sh_degree_of
from avatar.types import Gaussians

Up = Literal["-y", "y", "z"]
TURNS: dict[Up, tuple[float, ...]] = {  # of head space, where y is up and z to the front
    "-y": (0.0, 0.0, 0.0, 1.0),  # by 180 degrees about z
    "y": (1.0, 0.0, 0.0, 0.0),
    "z": (sqrt(0.5), sqrt(0.5), 0.0, 0.0),  # by 90 degrees about x: the face looks along -y
}

REST = (MAX_DEGREE + 1) ** 2 - 1
FIELDS = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
    *(f"f_rest_{i}" for i in range(3 * REST)),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
LEAST_OPACITY = 1e-6  # a logit must be finite


def encode_ply(gaussians: Gaussians, comment: str = "", up: Up = "-y") -> bytes:
    """The file's bytes. `comment` is text for people, kept in the header; `up` is the axis that the viewer takes as up.

    Raises UserError for values that are not finite: finite parameters can stand for infinite sizes.
    """
    gaussians = turned(gaussians, torch.tensor(TURNS[up], dtype=torch.float64))
    N, coefficients = gaussians.sh.shape[:2]
    rest = torch.zeros(N, REST, 3)
    rest[:, : coefficients - 1] = gaussians.sh[:, 1:]
    columns: list[Tensor] = [
        gaussians.means,
        torch.zeros(N, 3),
        gaussians.sh[:, 0],
        rest.permute(0, 2, 1).reshape(N, 3 * REST),
        torch.logit(gaussians.opacities.double(), eps=LEAST_OPACITY).float()[:, None],
        gaussians.scales.log(),
        torch.nn.functional.normalize(gaussians.quats, dim=1),
    ]
    values = torch.cat(columns, dim=1).numpy().astype("<f4")
    if not (finite := np.isfinite(values)).all():
        row, field = np.argwhere(~finite)[0]
        raise UserError(f"Gaussian {row} of this frame has a {FIELDS[field]} of {values[row, field]}; train again")
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {line}" for line in comment.encode("ascii", "replace").decode().splitlines()),
        f"element vertex {N}",
        *(f"property float {name}" for name in FIELDS),
        "end_header\n",
    ]
    return "\n".join(header).encode() + np.ascontiguousarray(values).tobytes()


def turned(gaussians: Gaussians, q: Float[Tensor, " 4"]) -> Gaussians:
    """The same, turned by a unit quaternion of double precision."""
    axes = torch.eye(4, dtype=q.dtype)[1:]  # as quaternions
    R = quaternion_product(quaternion_product(q.expand(3, 4), axes), (q * q.new_tensor([1, -1, -1, -1])).expand(3, 4))
    R = R[:, 1:].T
    sh = gaussians.sh.double()
    return gaussians._replace(
        means=(gaussians.means.double() @ R.T).float(),
        quats=quaternion_product(q.expand(len(sh), 4), gaussians.quats.double()).float(),
        sh=torch.einsum("jk,nkc->njc", sh_turn(R, sh_degree_of(sh.shape[1])), sh).float(),
    )


def sh_turn(R: Float[Tensor, "3 3"], degree: int) -> Float[Tensor, "K K"]:
    """The matrix of coefficients that makes the colour in direction R d what it was in d, solved for many directions."""
    directions = torch.randn(64, 3, dtype=R.dtype, generator=torch.Generator().manual_seed(0))
    directions = torch.nn.functional.normalize(directions, dim=1)
    matrix = torch.linalg.lstsq(sh_basis(directions @ R.T, degree), sh_basis(directions, degree)).solution
    return matrix.round(decimals=12)  # the solver's last digits vary
