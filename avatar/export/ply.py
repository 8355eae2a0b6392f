"""Gaussians in the PLY files of 3D Gaussian splatting, which viewers and editors of splats read.

x y z, nx ny nz (zero), f_dc_0..2, f_rest_0..44 (channel by channel, padded with zeros to degree 3), opacity (logit),
scale_0..2 (natural logarithm, metres), rot_0..3 (w x y z); float32, little-endian. Viewers take -y as up, as after training
on COLMAP's cameras, so the axes are x to the person's right, y down, z to the front: head space, turned by 180 degrees
about z. The head's pose is in the camera and therefore not in the file.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from avatar.errors import UserError
from avatar.splat.sh import MAX_DEGREE
from avatar.types import Gaussians

REST = (MAX_DEGREE + 1) ** 2 - 1
FIELDS = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
    *(f"f_rest_{i}" for i in range(3 * REST)),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
LEAST_OPACITY = 1e-6  # a logit must be finite


def encode_ply(gaussians: Gaussians, comment: str = "") -> bytes:
    """The file's bytes. `comment` is text for people, kept in the header.

    Raises UserError for values that are not finite: finite parameters can stand for infinite sizes.
    """
    gaussians = upside_down(gaussians)
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


def upside_down(gaussians: Gaussians) -> Gaussians:
    """The same, turned by 180 degrees about z: k q for quaternions, and (-1)^m Y_lm for spherical harmonics, where
    i = l^2 + l + m is odd as m is."""
    w, x, y, z = gaussians.quats.unbind(dim=1)
    sh = gaussians.sh.clone()
    sh[:, 1::2] *= -1
    return gaussians._replace(
        means=gaussians.means * gaussians.means.new_tensor([-1, -1, 1]),
        quats=torch.stack((-z, -y, x, w), dim=1),
        sh=sh,
    )
