"""What a person can move on an avatar by hand, by which name and how far: the ranges are those of the training video."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor

from avatar.errors import UserError
from avatar.head.assets import EYES
from avatar.head.expression_names import plain
from avatar.head.model import HeadModel, matrix_from_6d
from avatar.motion.component_names import name_components
from avatar.types import HeadParams

COMPONENTS = 12  # of head models whose coefficients have no names
EDGE = 1.0  # percent of the training frames beyond either end of a range
JOINTS = ("jaw", "look_down", "look_left", "left_lid", "right_lid", "lean", "turn")
LEAST_RANGE = 0.02  # radians, or share of a closed lid: what has moved less, training has not shown
JOINT_FIELD = {"jaw": "jaw", "left_lid": "eyelids", "right_lid": "eyelids", "lean": "neck", "turn": "neck"}  # else eyes
PARTS = (
    ("Mouth", r"mouth|lip|smile|tongue|pucker|funnel|frown"),
    ("Jaw", r"jaw|chin"),
    ("Brows", r"brow"),
    ("Eyes", r"eye|lid|blink|squint|gaze|look"),
    ("Cheeks", r"cheek|puff"),
    ("Nose", r"nose|sneer"),
)


@dataclass(frozen=True)
class ExpressionControl:
    """A direction of the expression space; its value is the distance along it from the neutral face."""

    part: str
    name: str
    direction: Float[Tensor, " E"]  # of length 1
    low: float
    high: float


def expression_controls(
    expressions: Float[Tensor, "T E"], rest: Float[Tensor, " E"], head: HeadModel
) -> list[ExpressionControl]:
    """A control for each coefficient that has a name, else for the directions in which training varies most."""
    away = expressions.double() - rest.double()
    names = head.assets.names.names
    if any(names):
        kept = [i for i, name in enumerate(names) if name and float(away[:, i].amax() - away[:, i].amin()) > 1e-3]
        directions = torch.eye(expressions.shape[1], dtype=torch.float64)[kept]
        labels = [(_part(name), readable_name(name), 1.0) for i in kept if (name := names[i])]
    else:
        directions = principal_directions(away)
        labels = name_components(directions, head)
    controls = []
    for direction, (part, name, sign) in zip(directions, labels, strict=True):
        low, high = shown_range((away @ (sign * direction)).numpy())
        controls.append(ExpressionControl(part, name, (sign * direction).float(), low, high))
    return controls


def principal_directions(values: Float[Tensor, "T E"]) -> Float[Tensor, "K E"]:
    """The first COMPONENTS directions of the largest variance, without those in which nothing varies."""
    _, spread, directions = torch.linalg.svd(values - values.mean(dim=0), full_matrices=False)
    count = int((spread > max(1e-3 * float(spread[:1].sum()), 1e-9)).sum())
    return directions[: min(count, COMPONENTS)]


def joint_ranges(training: Sequence[HeadParams]) -> dict[str, tuple[float, float]]:
    """How far jaw, gaze, lids and torso have moved in training; what has not moved is left out."""
    ranges = {name: shown_range(value.double().numpy()) for name, value in joint_values(training).items()}
    return {name: (low, high) for name, (low, high) in ranges.items() if high - low > LEAST_RANGE}


def joint_values(motion: Sequence[HeadParams]) -> dict[str, Float[Tensor, " T"]]:
    """JOINTS in each frame; gaze is the left eye's.

    Radians about the x axis (jaw: opens; look_down; lean: the torso backwards) and the y axis (look_left: to the person's
    own left; turn: the torso to the right); lids from 0 (open) to about 1.
    """
    stacked = {name: torch.stack([getattr(p, name) for p in motion]) for name in ("jaw", "eyes", "neck", "eyelids")}
    return {
        "jaw": _about_x(stacked["jaw"]),
        "look_down": _about_x(stacked["eyes"][:, :6]),
        "look_left": _about_y(stacked["eyes"][:, :6]),
        "left_lid": stacked["eyelids"][:, 0],
        "right_lid": stacked["eyelids"][:, 1],
        "lean": _about_x(stacked["neck"]),
        "turn": _about_y(stacked["neck"]),
    }


def posed(
    rest: HeadParams, expressions: Mapping[ExpressionControl, float] | None, joints: Mapping[str, float]
) -> HeadParams:
    """The neutral face with these controls set; `joints` are of `joint_ranges`. None keeps `rest.expression`."""
    expression = rest.expression
    for control, value in (expressions or {}).items():
        expression = expression + value * control.direction
    gaze = turned(joints.get("look_down", 0.0), joints.get("look_left", 0.0))
    lids = torch.tensor([joints.get("left_lid", 0.0), joints.get("right_lid", 0.0)], dtype=torch.float32)
    jaw = turned(joints["jaw"], 0.0) if "jaw" in joints else rest.jaw
    return replace(
        rest,
        expression=expression,
        jaw=jaw,
        eyes=gaze.repeat(2),
        eyelids=lids,
        neck=turned(joints.get("lean", 0.0), joints.get("turn", 0.0)),
    )


def posed_by_name(
    values: Mapping[str, float], controls: Sequence[ExpressionControl], rest: HeadParams, fixed: Collection[str] = ()
) -> HeadParams:
    """`posed` by the names of expressions, in any style of writing, and of joints other than those that are `fixed`.

    Raises UserError for another name, with those that there are.
    """
    known = {plain(c.name): c for c in reversed(controls)} | {plain(f"{c.part} {c.name}"): c for c in controls}
    own = [name for name in JOINTS if name not in fixed]
    joints = {name: value for name, value in values.items() if name in own}
    expressions = {name: value for name, value in values.items() if name not in own}
    for name in expressions:
        if plain(name) not in known:
            names = [*own, *(re.sub(r"\W+", "_", f"{c.part} {c.name}".lower()).strip("_") for c in controls)]
            raise UserError(f"this avatar has no {name}; it has {', '.join(names)}")
    return posed(rest, {known[plain(name)]: value for name, value in expressions.items()}, joints)


def fixed_controls(fixed_joints: Collection[str]) -> set[str]:
    """Those of JOINTS that turn joints of a head model of which no vertex follows them."""
    joints_of = {"jaw": {"jaw"}, "look_down": set(EYES), "look_left": set(EYES)}
    return {name for name, joints in joints_of.items() if joints.issubset(fixed_joints)}


def turned(about_x: float, about_y: float) -> Float[Tensor, " 6"]:
    """6D of a rotation vector (x, y, 0), radians."""
    return axis_angle_to_rotation_matrix(torch.tensor([[about_x, about_y, 0.0]]))[0, :2].reshape(6)


def readable_name(name: str) -> str:
    """mouthSmile_L, mouth_smile_left and MouthSmileLeft are `mouth smile left`."""
    name = re.sub(r"_L$", "_left", re.sub(r"_R$", "_right", name))
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).replace("_", " ").lower()


def _part(name: str) -> str:
    return next((part for part, pattern in PARTS if re.search(pattern, name, re.IGNORECASE)), "Face")


def shown_range(values: np.ndarray) -> tuple[float, float]:
    """Nearly all of the values, and 0."""
    low, high = np.percentile(values, [EDGE, 100 - EDGE])
    return min(float(low), 0.0), max(float(high), 0.0)


def _about_x(six: Float[Tensor, "T 6"]) -> Float[Tensor, " T"]:
    R = matrix_from_6d(six)
    return torch.atan2(R[:, 2, 1], R[:, 2, 2])


def _about_y(six: Float[Tensor, "T 6"]) -> Float[Tensor, " T"]:
    R = matrix_from_6d(six)
    return torch.atan2(-R[:, 2, 0], torch.hypot(R[:, 2, 1], R[:, 2, 2]))
