"""The joint minimum over time: against the normal equations written out, and over gaps."""

from __future__ import annotations

import numpy as np
import torch

from avatar.pose_refinement.smoothing import second_differences, smoothed

FRAMES, VALUES = 9, 4


def problem(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    root = torch.randn(VALUES, VALUES, generator=generator)
    curvature = root @ root.T + torch.eye(VALUES)
    moves = torch.randn(FRAMES, VALUES, generator=generator)
    acceleration = torch.randn(FRAMES, VALUES, generator=generator).double()
    calm = torch.tensor([0.01, 1.0, 5.0, 400.0], dtype=torch.float64)
    return moves, curvature, acceleration, calm


def test_it_is_the_minimum_of_the_energy() -> None:
    moves, curvature, acceleration, calm = problem()
    numbers = [3, 4, 5, 6, 7, 20, 21, 22, 23]

    def energy(x: torch.Tensor) -> torch.Tensor:
        away = x - moves.double()
        total = 0.5 * torch.einsum("tf,fg,tg->", away, curvature.double(), away)
        for i in range(1, FRAMES - 1):
            if numbers[i] - numbers[i - 1] == 1 and numbers[i + 1] - numbers[i] == 1:
                total = total + 0.5 * (calm * (x[i - 1] - 2 * x[i] + x[i + 1] + acceleration[i]).square()).sum()
        return total

    x = torch.zeros(FRAMES, VALUES, dtype=torch.float64, requires_grad=True)
    hessian = torch.autograd.functional.hessian(energy, x).reshape(FRAMES * VALUES, FRAMES * VALUES)
    (slope,) = torch.autograd.grad(energy(x), x)
    expected = -torch.linalg.solve(hessian, slope.reshape(-1)).reshape(FRAMES, VALUES)
    found = smoothed(moves, curvature, acceleration, calm, numbers)
    assert found.dtype == moves.dtype
    assert torch.allclose(found.double(), expected, atol=1e-5)


def test_frames_with_no_neighbours_keep_their_moves() -> None:
    moves, curvature, acceleration, calm = problem()
    assert torch.equal(smoothed(moves, curvature, acceleration, calm, [2 * i for i in range(FRAMES)]), moves)
    for few in range(3):
        own = moves[:few]
        assert torch.equal(smoothed(own, curvature, acceleration[:few], calm, range(few)), own), few


def test_what_the_picture_determines_hardly_changes_and_the_rest_is_filled_in() -> None:
    curvature = torch.diag(torch.tensor([1e6, 1e-3]))
    moves = torch.zeros(FRAMES, 2)
    moves[4] = 1.0
    found = smoothed(moves, curvature, torch.zeros(FRAMES, 2).double(), torch.ones(2).double(), range(FRAMES))
    assert torch.allclose(found[:, 0], moves[:, 0], atol=1e-4)
    assert float(found[4, 1]) < 0.4


def test_the_given_motions_own_jumps_are_evened_out() -> None:
    """A jump of one frame in the given tracking is an acceleration of (1, -2, 1), and moves undo it."""
    jump = torch.zeros(FRAMES, 1, dtype=torch.float64)
    jump[3:6, 0] = torch.tensor([1.0, -2.0, 1.0])
    found = smoothed(torch.zeros(FRAMES, 1), torch.eye(1) * 1e-6, jump, torch.ones(1).double(), range(FRAMES))
    assert float(found[4] - (found[3] + found[5]) / 2) < -0.9


def test_rows_of_second_differences() -> None:
    rows = second_differences([1, 2, 3, 4, 9, 10]).toarray()
    assert np.array_equal(rows, [[1, -2, 1, 0, 0, 0], [0, 1, -2, 1, 0, 0]])
