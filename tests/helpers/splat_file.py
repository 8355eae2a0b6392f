"""A PLY file of Gaussians, read without the code that writes it."""

from __future__ import annotations

import io

import numpy as np
import torch
import trimesh

from avatar.types import Gaussians


def read_splats(data: bytes) -> Gaussians:
    """As viewers of 3D Gaussian splatting read it, through trimesh's reader of PLY."""
    loaded = trimesh.load(io.BytesIO(data), file_type="ply", process=False)
    raw = loaded.metadata["_ply_raw"]["vertex"]["data"]  # type: ignore[union-attr]
    assert all(raw.dtype[name] == "<f4" for name in raw.dtype.names)

    def columns(*names: str) -> torch.Tensor:
        return torch.from_numpy(np.stack([raw[name] for name in names], axis=1).astype(np.float32))

    rest = columns(*(f"f_rest_{i}" for i in range(45))).reshape(-1, 3, 15).permute(0, 2, 1)
    return Gaussians(
        columns("x", "y", "z"),
        columns("rot_0", "rot_1", "rot_2", "rot_3"),
        columns("scale_0", "scale_1", "scale_2").exp(),
        torch.sigmoid(columns("opacity"))[:, 0],
        torch.cat((columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None], rest), dim=1),
    )
