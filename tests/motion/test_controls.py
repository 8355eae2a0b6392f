"""What can be moved by hand: by which name, how far, and what it does to the parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from heads import grid_head, rest_params

from avatar.errors import UserError
from avatar.head.expression_names import ExpressionNames
from avatar.head.model import HeadModel
from avatar.motion.controls import (
    COMPONENTS,
    JOINTS,
    expression_controls,
    fixed_controls,
    joint_ranges,
    joint_values,
    posed,
    posed_by_name,
    principal_directions,
    readable_name,
    shown_range,
)

NAMED = replace(grid_head(), names=ExpressionNames(("mouthSmile_L", None, "browInnerUp", "jawOpen", "sigh")))
REST = torch.tensor([0.5, 0.0, 0.0, 0.0, 0.0])
REST_PARAMS = replace(rest_params(), expression=REST)
STEPS = torch.linspace(0.0, 1.0, 201)[:, None]
EXPRESSIONS = REST + STEPS * torch.tensor([2.0, 9.0, -1.0, 0.0009, 1.0])  # the fourth hardly moves
CONTROLS = expression_controls(EXPRESSIONS, REST, HeadModel(NAMED, torch.zeros(0)))


def test_named_coefficients_that_move_are_controls_over_nearly_all_of_their_range() -> None:
    assert [(c.part, c.name) for c in CONTROLS] == [
        ("Mouth", "mouth smile left"),
        ("Brows", "brow inner up"),
        ("Face", "sigh"),
    ]
    assert [c.direction.tolist() for c in CONTROLS] == torch.eye(5)[[0, 2, 4]].tolist()
    ranges = [(c.low, c.high) for c in CONTROLS]
    assert np.array(ranges) == pytest.approx(np.array([(0.0, 1.98), (-0.99, 0.0), (0.0, 0.99)]), abs=1e-6)


def test_without_names_the_controls_are_the_directions_of_the_largest_variance() -> None:
    head = HeadModel(grid_head(), torch.zeros(0))
    moved = STEPS * torch.tensor([0.0, 0.0, 3.0, 4.0, 0.0])
    (control,) = expression_controls(moved, torch.zeros(5), head)
    sign = 1 if control.high > 0 else -1
    assert control.direction.tolist() == pytest.approx([0.0, 0.0, sign * 0.6, sign * 0.8, 0.0], abs=1e-6)
    assert control.high - control.low == pytest.approx(4.95, abs=1e-5)


@pytest.mark.parametrize(("scale", "count"), [(10.0, 2), (0.01, 2), (1e-12, 0)])
def test_directions_in_which_next_to_nothing_varies_are_none(scale: float, count: int) -> None:
    values = 7.0 + scale * torch.eye(4, dtype=torch.float64)[:3] * torch.tensor([1.0, 0.01, 1e-5, 0.0])
    assert len(principal_directions(values)) == count
    assert len(principal_directions(torch.eye(20, dtype=torch.float64))) == COMPONENTS


def test_a_range_leaves_out_a_percent_at_either_end_and_holds_0() -> None:
    assert shown_range(np.linspace(-1, 3, 401)) == pytest.approx((-0.96, 2.96))
    assert shown_range(np.linspace(2, 3, 101)) == pytest.approx((0.0, 2.99))
    assert shown_range(np.linspace(-3, -2, 101)) == pytest.approx((-2.99, 0.0))


@pytest.mark.parametrize("joint", JOINTS)
def test_a_joint_is_set_and_measured_by_its_name(joint: str) -> None:
    values = joint_values([posed(REST_PARAMS, None, {joint: value}) for value in (0.0, 0.2, 0.4)])
    assert list(values) == list(JOINTS)
    for name, found in values.items():
        assert found.tolist() == pytest.approx([0.0, 0.2, 0.4] if name == joint else [0.0] * 3, abs=1e-6), name
    motion = [posed(REST_PARAMS, None, {joint: 0.0003 * step}) for step in range(101)]
    assert joint_ranges(motion) == {joint: pytest.approx((0.0, 0.0297), abs=1e-6)}
    assert joint_ranges([posed(REST_PARAMS, None, {joint: 0.0002 * step}) for step in range(101)]) == {}


def test_controls_move_the_expression_away_from_the_rest_and_the_jaw_stays_unless_it_is_named() -> None:
    smile, brows = CONTROLS[:2]
    rest = replace(REST_PARAMS, jaw=posed(REST_PARAMS, None, {"jaw": 0.1}).jaw)
    found = posed(rest, {smile: 0.25, brows: -0.5}, {"left_lid": 1.0})
    assert found.expression.tolist() == [0.75, 0.0, -0.5, 0.0, 0.0]
    assert torch.equal(found.jaw, rest.jaw) and found.eyelids.tolist() == [1.0, 0.0]
    assert torch.equal(posed(rest, None, {}).expression, REST)
    assert posed(rest, None, {"jaw": 0.2}).jaw[:3].tolist() == [1.0, 0.0, 0.0]


def test_poses_are_named_in_any_style_of_writing() -> None:
    expected = posed(REST_PARAMS, {CONTROLS[0]: 0.25}, {"jaw": 0.2})
    for name in ("mouth_smile_left", "MouthSmileLeft", "mouthSmile_L", "Mouth mouth smile left"):
        found = posed_by_name({name: 0.25, "jaw": 0.2}, CONTROLS, REST_PARAMS)
        assert torch.equal(found.expression, expected.expression) and torch.equal(found.jaw, expected.jaw)
    with pytest.raises(UserError, match="has no jaw; it has look_down, .*turn, mouth_mouth_smile_left, .*face_sigh$"):
        posed_by_name({"jaw": 0.2}, CONTROLS, REST_PARAMS, fixed={"jaw"})


def test_of_two_controls_of_one_name_the_first_has_it_and_each_its_part() -> None:
    first, second = (replace(control, name="up") for control in CONTROLS[:2])
    for name, control in (("up", first), ("mouth_up", first), ("brows_up", second)):
        found = posed_by_name({name: 1.0}, [first, second], REST_PARAMS)
        assert torch.equal(found.expression, REST + control.direction), name


@pytest.mark.parametrize(
    ("fixed", "controls"),
    [
        ((), set()),
        (("jaw",), {"jaw"}),
        (("left eye",), set()),
        (("jaw", "left eye", "right eye"), {"jaw", "look_down", "look_left"}),
    ],
)
def test_joints_that_move_nothing_are_no_controls(fixed: tuple[str, ...], controls: set[str]) -> None:
    assert fixed_controls(fixed) == controls


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("mouthSmile_L", "mouth smile left"),
        ("mouthSmile_R", "mouth smile right"),
        ("mouth_smile_left", "mouth smile left"),
        ("JawOpen", "jaw open"),
    ],
)
def test_names_are_read_as_words(name: str, words: str) -> None:
    assert readable_name(name) == words
