"""Words for what a direction of the expression space does, on a flat face whose parts are known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from heads import grid_head
from torch import Tensor

from avatar.head.model import LEFT_EYE, RIGHT_EYE, HeadModel
from avatar.motion.component_names import BOXES, name_components

APART = 0.06  # metres between the eyes
ROWS, COLUMNS = 66, 49
Field = Callable[[Tensor, Tensor], tuple[object, object, object]]  # x, y from the part's middle -> movement


def head_with(fields: list[tuple[str, Field]], apart: float = APART) -> HeadModel:
    """A direction for each part and field: a movement of 1 is one of a millimetre, x and y have a deviation of 1."""
    y, x = torch.meshgrid(torch.linspace(-2.25, 1.0, ROWS), torch.linspace(-1.2, 1.2, COLUMNS), indexing="ij")
    place = torch.stack((x.flatten(), y.flatten(), torch.zeros(x.numel())), dim=1)
    head = grid_head(ROWS, COLUMNS)
    eyes = [int((place[:, :2] - torch.tensor([side, 0.0])).norm(dim=1).argmin()) for side in (0.5, -0.5)]
    regressor = torch.zeros_like(head.joint_regressor)
    regressor[[LEFT_EYE, RIGHT_EYE], eyes] = 1.0
    directions = torch.zeros(len(place), 3, len(fields))
    for k, (part, field) in enumerate(fields):
        (inner, outer), (low, high) = BOXES[part]
        side, height = place[:, 0].abs(), place[:, 1]
        inside = (side >= inner) & (side <= outer) & (height >= low) & (height <= high)
        for other in list(BOXES)[: list(BOXES).index(part)]:
            (inner, outer), (low, high) = BOXES[other]
            inside &= ~((side >= inner) & (side <= outer) & (height >= low) & (height <= high))
        own = place[inside, :2] - place[inside, :2].mean(dim=0)
        u, v = (own / own.square().mean(dim=0).sqrt()).unbind(dim=1)
        directions[inside, :, k] = 1e-3 * torch.stack(
            [torch.as_tensor(value, dtype=torch.float32).expand(len(u)) for value in field(u, v)], dim=1
        )
    own_eyes = place[eyes[0], 0] - place[eyes[1], 0]
    return HeadModel(
        replace(
            head, template=place * apart / own_eyes, joint_regressor=regressor, expression_dirs=directions, regions={}
        ),
        torch.zeros(0),
    )


def named(*fields: tuple[str, Field], apart: float = APART) -> list[tuple[str, str, float]]:
    return name_components(torch.eye(len(fields)), head_with(list(fields), apart))


def wing(x: Tensor) -> Tensor:
    return x.abs() - x.abs().mean()


MOVEMENTS: dict[str, tuple[str, Field, str, float]] = {
    "eyes up": ("Eyes", lambda x, y: (0, 1, 0), "up", 1.0),
    "eyes down": ("Eyes", lambda x, y: (0, -1, 0), "up", -1.0),
    "eyes open": ("Eyes", lambda x, y: (0, y, 0), "open", 1.0),
    "brows aside": ("Brows", lambda x, y: (1, 0, 0), "sideways", 1.0),
    "brows' ends": ("Brows", lambda x, y: (0, wing(x), 0), "outer ends up", 1.0),
    "nose": ("Nose", lambda x, y: (0, 0, -1), "forward", -1.0),
    "mouth up": ("Mouth", lambda x, y: (0, 1, 0), "up", 1.0),
    "mouth up and a little open": ("Mouth", lambda x, y: (0, 1 + 0.1 * y, 0), "up", 1.0),
    "mouth wide": ("Mouth", lambda x, y: (x, 0, 0), "wide", 1.0),
    "mouth tilted": ("Mouth", lambda x, y: (0, x, 0), "tilted", 1.0),
    "mouth open": ("Mouth", lambda x, y: (0, y, 0), "open", 1.0),
    "mouth closed": ("Mouth", lambda x, y: (0, -y, 0), "open", -1.0),
    "mouth's corners": ("Mouth", lambda x, y: (0, wing(x), 0), "corners up", 1.0),
    "smile": ("Mouth", lambda x, y: (x, wing(x), 0), "smile", 1.0),
    "frown": ("Mouth", lambda x, y: (-x, -wing(x), 0), "smile", -1.0),
    "cheeks": ("Cheeks", lambda x, y: (x, 0, 0), "wide", 1.0),
    "jaw": ("Jaw", lambda x, y: (0, 1, 0), "up", 1.0),
    "more up than wide": ("Jaw", lambda x, y: (0.45 * x, 1, 0), "up", 1.0),  # 2 along the deviation is a slope of 2
    "more wide than up": ("Jaw", lambda x, y: (0.55 * x, 1, 0), "wide", 1.0),
}


@pytest.mark.parametrize("name", MOVEMENTS)
def test_the_part_that_moves_most_and_its_movement(name: str) -> None:
    part, field, way, sign = MOVEMENTS[name]
    assert named((part, field)) == [(part, way, sign)]


def test_the_same_movement_gets_a_second_word_or_a_number() -> None:
    fields = [
        ("Jaw", lambda x, y: (0, -1, 0.31)),
        ("Jaw", lambda x, y: (0, 1, 0.31)),
        ("Jaw", lambda x, y: (0, 1, -0.31)),
        ("Jaw", lambda x, y: (0, -1, 0.29)),
        ("Jaw", lambda x, y: (0, 1, 0)),
        ("Nose", lambda x, y: (0, 1, 0)),
    ]
    assert [(part, way) for part, way, _ in named(*fields)] == [
        ("Jaw", "up"),
        ("Jaw", "up, forward"),
        ("Jaw", "up, back"),
        ("Jaw", "up (2)"),
        ("Jaw", "up (3)"),
        ("Nose", "up"),
    ]


def test_what_moves_nothing_or_has_no_eyes_is_a_numbered_component() -> None:
    still: tuple[str, Field] = ("Jaw", lambda x, y: (0, 0.009, 0))
    moving: tuple[str, Field] = ("Jaw", lambda x, y: (0, 0.011, 0))
    assert named(still, moving) == [("Face", "component 1", 1.0), ("Jaw", "up", 1.0)]
    assert named(moving, apart=0.0009) == [("Face", "component 1", 1.0)]
