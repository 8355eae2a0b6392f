"""A head model as named tensors, for files that carry it along."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from avatar.head.assets import IDENTITY_COEFFICIENTS, JOINT_NAMES, LAYOUT_TENSOR, HeadAssets, fingerprint_of
from avatar.tensors import check_finite, check_shapes

_SHAPES = {
    "template": "V 3",
    "faces": "F 3",
    "shape_dirs": f"V 3 {IDENTITY_COEFFICIENTS}",
    "expression_dirs": "V 3 E",
    "pose_dirs": f"V 3 {9 * (len(JOINT_NAMES) - 1)}",
    "joint_regressor": f"{len(JOINT_NAMES)} V",
    "weights": f"V {len(JOINT_NAMES)}",
    "eyelid_dirs": "2 V 3",
    "uvs": "T 2",
    "uv_faces": "F 3",
}
_INTEGERS = ("faces", "uv_faces")
_REGION = "region."


def head_tensors(assets: HeadAssets) -> dict[str, Tensor]:
    """Everything that `head_from_tensors` needs."""
    tensors = {name: getattr(assets, name).contiguous() for name in _SHAPES}
    tensors["parents"] = torch.tensor(assets.parents)
    if assets.layout_is_made:
        tensors[LAYOUT_TENSOR] = torch.tensor([assets.layout_method])
    return tensors | {f"{_REGION}{name}": index.contiguous() for name, index in assets.regions.items()}


def head_from_tensors(tensors: Mapping[str, Tensor]) -> HeadAssets:
    """The head model again, its fingerprint computed anew.

    Raises KeyError, TypeError or ValueError when a tensor is missing, of another type or shape, or names a vertex that
    does not exist.
    """
    arrays = {name: tensors[name].contiguous() for name in _SHAPES}
    sizes = check_shapes(**{name: (arrays[name], shape) for name, shape in _SHAPES.items()})
    for name, tensor in arrays.items():
        wanted = torch.int64 if name in _INTEGERS else torch.float32
        if tensor.dtype != wanted:
            raise TypeError(f"head.{name} is {tensor.dtype}, not {wanted}")
    check_finite(**{f"head.{name}": tensor for name, tensor in arrays.items() if name not in _INTEGERS})
    regions = {n.removeprefix(_REGION): t.contiguous() for n, t in tensors.items() if n.startswith(_REGION)}
    for name, tensor, limit in (
        ("faces", arrays["faces"], sizes["V"]),
        ("uv_faces", arrays["uv_faces"], sizes["T"]),
        *((f"region {name}", index, sizes["V"]) for name, index in regions.items()),
    ):
        if tensor.dtype != torch.int64 or (tensor.numel() and not 0 <= int(tensor.min()) <= int(tensor.max()) < limit):
            raise ValueError(f"head.{name} names rows outside of 0 to {limit - 1}")
    parents = tuple(tensors["parents"].tolist())
    if (
        tensors["parents"].dtype != torch.int64
        or len(parents) != len(JOINT_NAMES)
        or parents[0] != -1
        or any(not 0 <= p < i for i, p in enumerate(parents) if i)
    ):
        raise ValueError(f"head.parents is {list(parents)}")
    (method,) = tensors[LAYOUT_TENSOR].tolist() if LAYOUT_TENSOR in tensors else (0,)
    if not isinstance(method, int):
        raise TypeError(f"head.{LAYOUT_TENSOR} is {method}")
    fingerprint = fingerprint_of(arrays, parents, regions, method)
    return HeadAssets(
        **arrays,  # pyright: ignore
        parents=parents,
        regions=regions,
        fingerprint=fingerprint,
        layout_method=method,
    )
