"""Head parameters and cameras that a Python program gives: checked before they meet the network."""

from __future__ import annotations

import math
import numbers
from collections.abc import Collection
from dataclasses import fields

import torch
from torch import Tensor

from avatar.errors import UserError
from avatar.tensors import check_shapes, describe_non_finite
from avatar.types import Camera, HeadParams

PARAM_SHAPES = {"expression": "E", "jaw": "6", "eyes": "12", "eyelids": "2", "neck": "6"}
CAMERA_SHAPES = {"R_cam_world": "3 3", "t_cam_world": "3"}


def checked_params(params: object, coefficients: Collection[int]) -> HeadParams:
    """The head parameters, with one of the numbers of expression `coefficients`.

    Raises UserError, naming the tensor, for another type, shape or dtype, and for values that are not finite.
    """
    if not isinstance(params, HeadParams):
        raise UserError(
            f"a frame is given as avatar.types.HeadParams, such as rest_params() or recording.params(0), not as "
            f"{_kind(params)}"
        )
    sizes = _checked_tensors("params", params, PARAM_SHAPES)
    if sizes["E"] not in coefficients:
        own = " or ".join(map(str, sorted(coefficients)))
        raise UserError(f"params.expression has {sizes['E']} coefficients: give the {own} of this avatar")
    return params


def checked_camera(camera: object) -> Camera:
    """The camera. Raises UserError as `checked_params` does; the splatter checks its numbers."""
    if not isinstance(camera, Camera):
        raise UserError(
            f"a view is given as avatar.types.Camera, such as rest_camera() or recording.camera(0), not as "
            f"{_kind(camera)}"
        )
    _checked_tensors("camera", camera, CAMERA_SHAPES)
    return camera


def checked_size(size: int | None) -> int | None:
    """A picture's width in pixels, or None. Raises UserError for any other value."""
    if size is not None and (not isinstance(size, numbers.Integral) or size < 1):
        raise UserError(f"size is {size!r}: give a whole number of pixels, at least 1")
    return None if size is None else int(size)


def check_pose(zoom: float, **others: float) -> None:
    """Raises UserError, naming the value, for a factor that is not above 0 and for others that are no finite numbers."""
    for name, value in {**others, "zoom": zoom}.items():
        is_number = isinstance(value, numbers.Real) or getattr(value, "ndim", None) == 0
        if not is_number or not math.isfinite(value):
            raise UserError(f"{name} is {value!r}, not a finite number")
    if zoom <= 0:
        raise UserError(f"zoom is {zoom}: give a factor above 0")


def _checked_tensors(owner: str, values: HeadParams | Camera, shapes: dict[str, str]) -> dict[str, int]:
    tensors: dict[str, Tensor] = {
        f"{owner}.{field.name}": getattr(values, field.name) for field in fields(values) if field.name in shapes
    }
    try:
        sizes = check_shapes(**{name: (value, shapes[name.split(".")[1]]) for name, value in tensors.items()})
    except (TypeError, ValueError) as error:
        raise UserError(str(error)) from None
    for name, value in tensors.items():
        if value.dtype != torch.float32:
            raise UserError(f"{name} is {_kind(value)}, not torch.float32: give it as {name}.float()")
    if not bool(torch.isfinite(torch.cat([value.flatten() for value in tensors.values()])).all()):
        for name, value in tensors.items():
            if (sentence := describe_non_finite(name, value)) is not None:
                raise UserError(sentence)
    return sizes


def _kind(value: object) -> str:
    return str(value.dtype) if isinstance(value, Tensor) else type(value).__name__
