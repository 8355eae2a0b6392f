from __future__ import annotations

import pytest
import torch
from heads import OPEN, grid_head, mouth_head, rest_params

from avatar.files.video import fitted
from avatar.head.model import HeadModel
from avatar.motion.neutral_pose import RestPose, find_mean, frame_rest
from avatar.pipeline.reenact import panels, say_open_lips


def neutral(opening: float) -> RestPose:
    """Lips `opening` times 10 mm apart in the middle of the mouth."""
    params = rest_params(3)
    params.expression[OPEN] = opening
    return frame_rest([params], 0)


def test_a_neutral_face_with_open_lips_is_said_with_the_way_out() -> None:
    said: list[str] = []
    head = HeadModel(mouth_head(), torch.zeros(0))
    for opening in (0.0, 0.3):
        say_open_lips(neutral(opening), head, "anna", "--driver-neutral", said.append)
    assert said == []
    say_open_lips(neutral(0.5), head, "anna", "--driver-neutral", said.append)
    (sentence,) = said
    assert sentence.startswith("The lips of anna are 4.") and "--driver-neutral N takes frame N instead" in sentence


def test_nothing_is_said_of_means_of_no_rest_and_of_heads_without_lips() -> None:
    said: list[str] = []
    head = HeadModel(mouth_head(), torch.zeros(0))
    say_open_lips(None, head, "anna", "--neutral", said.append)
    params = rest_params(3)
    params.expression[OPEN] = 1.0
    say_open_lips(find_mean([params]), head, "anna", "--neutral", said.append)
    say_open_lips(frame_rest([rest_params()], 0), HeadModel(grid_head(), torch.zeros(0)), "a", "--neutral", said.append)
    assert said == []


def test_panels_are_of_one_size_where_another_camera_stands_in_for_the_first_one() -> None:
    renders = iter([torch.zeros(64, 48, 3)] * 3)
    pictures = (fitted(torch.zeros(rows, 48, 3), 64, 48) for rows in (64, 36, 96))
    first, wide, tall = panels(renders, pictures, "anna", [0.5, 0.5, 0.5])
    assert first.shape == wide.shape == tall.shape
    dark = [(panel[-100:, :48] == 0).all(axis=2).sum() for panel in (first, wide, tall)]
    assert [one / dark[0] for one in dark[1:]] == pytest.approx([36 / 64, 64 / 96], abs=0.02)
