"""The training target of a frame, and the condition of a head."""

from __future__ import annotations

import torch

from avatar.data.frame import Frame
from avatar.types import Camera, HeadParams


def frame(image: torch.Tensor, alpha: torch.Tensor, head_mask: torch.Tensor) -> Frame:
    height, width = alpha.shape
    camera = Camera(torch.eye(3), torch.zeros(3), 50.0, 50.0, width / 2, height / 2, width, height)
    six = torch.zeros(6)
    params = HeadParams(torch.zeros(10), six, torch.zeros(12), torch.zeros(2), six)
    return Frame(0, "00001", camera, params, image, alpha, head_mask, torch.zeros(height, width))


def test_the_target_is_composited_twice_over_the_background() -> None:
    """Matte over the background, that times the mask over the background again, written out in float64."""
    image, alpha, mask, background = torch.rand(9, 7, 3), torch.rand(9, 7), torch.rand(9, 7), torch.rand(3)
    a, m = alpha.double()[..., None], mask.double()[..., None]
    expected = (image.double() * a + background.double() * (1 - a)) * m + background.double() * (1 - m)
    target = frame(image, alpha, mask).composite(background)
    torch.testing.assert_close(target.double(), expected, rtol=0, atol=2e-7)


def test_the_target_is_exact_where_nothing_is_mixed() -> None:
    image, background = torch.rand(9, 7, 3), torch.rand(3)
    alpha, mask = (torch.rand(2, 9, 7) > 0.5).float()
    target = frame(image, alpha, mask).composite(background)
    inside = (alpha * mask).bool()
    assert torch.equal(target[inside], image[inside])
    assert torch.equal(target[~inside], background.expand_as(target)[~inside])


def test_another_condition_takes_the_place_of_all_but_the_neck() -> None:
    zeros = HeadParams(torch.zeros(10), torch.zeros(6), torch.zeros(12), torch.zeros(2), torch.arange(6.0))
    wanted = torch.arange(1.0, 31.0)
    found = zeros.with_condition(wanted)
    assert torch.equal(found.condition(), wanted) and torch.equal(found.neck, zeros.neck)
    assert torch.equal(zeros.condition(), torch.zeros(30))
