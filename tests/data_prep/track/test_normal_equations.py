"""Steps against the dense system, and what the accepted and rejected ones of a minimisation do to the cost."""

from __future__ import annotations

import pytest
import torch

from data_prep.track.fit.frame_poses import NUM_FIXED, Motion, at_rest
from data_prep.track.fit.levenberg_marquardt import IdentityPrior, minimise
from data_prep.track.fit.normal_equations import NormalEquations, NotPositiveDefinite, solve

T, D, G = 5, 3, 2


def some_equations(shared: int) -> tuple[NormalEquations, torch.Tensor, torch.Tensor]:
    """Random residuals that see up to three frames, or one and what is shared: equations, dense Hessian, gradient."""
    generator = torch.Generator().manual_seed(3)
    rows = []
    for t in range(T):
        for back in range(1 if shared else 3):
            if t >= back:
                row = torch.zeros(4, T * D + shared, dtype=torch.float64)
                for frame in range(t - back, t + 1):
                    row[:, frame * D : (frame + 1) * D] = torch.randn(4, D, generator=generator, dtype=torch.float64)
                row[:, T * D :] = torch.randn(4, shared, generator=generator, dtype=torch.float64)
                rows.append(row)
    J = torch.cat(rows)
    r = torch.randn(len(J), generator=generator, dtype=torch.float64)
    H, g = J.T @ J, J.T @ r
    equations = NormalEquations.zeros(T, D, shared)
    frames = H[: T * D, : T * D].reshape(T, D, T, D)
    for t in range(T):
        equations.diagonal[t] = frames[t, :, t]
        if t >= 1 and not shared:
            equations.before[t] = frames[t, :, t - 1]
        if t >= 2 and not shared:
            equations.before_that[t] = frames[t, :, t - 2]
    equations.gradient[:] = g[: T * D].reshape(T, D)
    equations.border[:] = H[: T * D, T * D :].reshape(T, D, shared)
    equations.shared[:], equations.shared_gradient[:] = H[T * D :, T * D :], g[T * D :]
    return equations, H, g


@pytest.mark.parametrize("shared", [0, G])
@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_a_step_solves_the_dense_system(shared: int, damping: float) -> None:
    equations, H, g = some_equations(shared)
    step = solve(equations, damping)
    damped = H + damping * torch.diag(H.diagonal())
    expected = -torch.linalg.solve(damped, g)
    torch.testing.assert_close(torch.cat((step.frames.flatten(), step.shared)), expected, rtol=1e-9, atol=1e-9)


def test_rows_add_what_their_products_say() -> None:
    generator = torch.Generator().manual_seed(1)
    rows = torch.randn(7, T, D, generator=generator, dtype=torch.float64)
    shared = torch.randn(7, T, G, generator=generator, dtype=torch.float64)
    residuals = torch.randn(7, T, generator=generator, dtype=torch.float64)
    equations = NormalEquations.zeros(T, D, G)
    equations.add_rows(slice(0, 2), rows[:, :2], residuals[:, :2], shared[:, :2])
    equations.add_rows(slice(2, T), rows[:, 2:], residuals[:, 2:], shared[:, 2:])
    dense = torch.cat((torch.zeros(7, T, T * D, dtype=torch.float64), shared), dim=2)
    for t in range(T):
        dense[:, t, t * D : (t + 1) * D] = rows[:, t]
    J = dense.flatten(0, 1)
    expected = -torch.linalg.lstsq(J, residuals.flatten()).solution
    step = solve(equations, 0.0)
    torch.testing.assert_close(torch.cat((step.frames.flatten(), step.shared)), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("shared", [0, G])
def test_a_hopeless_system_is_told(shared: int) -> None:
    equations, _, _ = some_equations(shared)
    equations.diagonal[2] = -torch.eye(D, dtype=torch.float64)
    with pytest.raises(NotPositiveDefinite):
        solve(equations, 1e-3)


class Bowl:
    """Pulls the first translation column towards 1, through a wall: a full Gauss-Newton step overshoots it."""

    def __init__(self) -> None:
        self.costs: list[float] = []

    def cost(self, identity: torch.Tensor, motion: Motion) -> float:
        x = motion.t[:, 0]
        self.costs.append(float((torch.where(x > 1.5, 100.0, 0.5 * (x - 1.0) ** 2)).sum()))
        return self.costs[-1]

    def add_to(self, equations: NormalEquations, identity, motion: Motion) -> None:
        equations.diagonal += torch.eye(NUM_FIXED, dtype=torch.float64)
        equations.diagonal[:, 3, 3] -= 0.7  # believes in less curvature than there is
        equations.gradient[:, 3] += motion.t[:, 0] - 1.0


def test_only_steps_downhill_are_accepted() -> None:
    start = at_rest(torch.eye(3, dtype=torch.float64).expand(2, 3, 3), torch.zeros(2, 3, dtype=torch.float64), 0)
    bowl = Bowl()
    done = minimise((bowl,), torch.zeros(0), start, 40)
    assert max(bowl.costs) > bowl.costs[0]  # a step that was tried and not taken
    assert bowl.cost(torch.zeros(0), done.motion) == min(bowl.costs)
    torch.testing.assert_close(done.motion.t[:, 0], torch.ones(2, dtype=torch.float64), atol=2e-2, rtol=0)


def test_identities_are_pulled_to_the_mean() -> None:
    identity = torch.tensor([2.0, -1.0], dtype=torch.float64)
    motion = at_rest(torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 3, dtype=torch.float64), 0)
    prior, equations = IdentityPrior(4.0), NormalEquations.zeros(1, 1, 2)
    prior.add_to(equations, identity, motion)
    assert prior.cost(identity, motion) == pytest.approx(0.5 * 4.0 * 5.0)
    torch.testing.assert_close(equations.shared_gradient, 4.0 * identity)
    torch.testing.assert_close(equations.shared, 4.0 * torch.eye(2, dtype=torch.float64))
