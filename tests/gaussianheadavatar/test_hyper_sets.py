"""The five sets against a joint normal distribution in float64, and against the HyperGaussians of the other head."""

from __future__ import annotations

import pytest
import torch

from avatar.gaussianheadavatar.hyper_sets import Attributes, HyperSet, HyperSets
from avatar.gaussians.hyper import HyperHead


def random_set(num: int, m: int, n: int) -> HyperSet:
    hyper = HyperSet(num, m, n).double()
    with torch.no_grad():
        for parameter in hyper.parameters():
            parameter += 0.6 / m**0.5 * torch.randn_like(parameter)
    return hyper


def as_head(hyper: HyperSet) -> HyperHead:
    m, num = hyper.attribute_size, hyper.mean.shape[1]
    lower = torch.zeros(num, m, m, dtype=torch.float64)
    rows, columns = torch.tril_indices(m, m)
    lower[:, rows, columns] = hyper.lower.detach().T
    return HyperHead(hyper.mean.detach().T, lower, hyper.cross.detach().permute(2, 0, 1))


@pytest.mark.parametrize("m", [1, 3, 4, 32])
@pytest.mark.parametrize("n", [1, 8])
def test_an_attribute_is_the_conditional_mean_of_the_joint_distribution(m: int, n: int) -> None:
    num = 30
    hyper, latents = random_set(num, m, n), torch.randn(num, n, dtype=torch.float64)
    head = as_head(hyper)
    L11 = torch.tril(head.lower, -1) + torch.diag_embed(torch.diagonal(head.lower, dim1=1, dim2=2).exp())
    L22 = torch.eye(n, dtype=torch.float64) + 0.1 * torch.randn(num, n, n, dtype=torch.float64).tril(-1)
    L = torch.cat((torch.cat((L11, L11.new_zeros(num, m, n)), 2), torch.cat((head.cross, L22), 2)), 1)
    precision = L @ L.mT
    aa, ab = precision[:, :m, :m], precision[:, :m, m:]
    pulled = torch.linalg.solve(aa, ab @ (latents - head.mean[:, m:])[..., None]).squeeze(-1)
    found = hyper(latents).detach()
    torch.testing.assert_close(found, head.mean[:, :m] - pulled, rtol=1e-7, atol=1e-9)
    torch.testing.assert_close(found, head.conditional_mean(latents), rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("m", [1, 3, 5])
def test_gradients_of_an_attribute(m: int) -> None:
    hyper = random_set(3, m, 2)
    names = [name for name, _ in hyper.named_parameters()]

    def attribute(latents: torch.Tensor, *values: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(hyper, dict(zip(names, values, strict=True)), (latents,))

    latents = torch.randn(3, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(attribute, (latents, *hyper.parameters()))


def latents_of(num: int, n: int) -> list[torch.Tensor]:
    return [torch.randn(num, size) for size in (n, n, 3 * n)]


def test_at_the_start_all_is_zero_and_only_the_cross_term_and_the_mean_can_move() -> None:
    sets = HyperSets(5, 6, 8)
    latents = [latent.requires_grad_() for latent in latents_of(5, 8)]
    attributes = sets(*latents)
    sizes = [3, 6, 4, 3, 1]
    for m, field in zip(sizes, attributes[:5], strict=True):
        assert torch.equal(field, torch.zeros(5, m))
    sum(field.sum() for field in attributes[:5]).backward()
    for name, m in zip(Attributes._fields[:5], sizes, strict=True):
        part = getattr(sets, name)
        assert bool((part.cross.grad != 0).all()) and bool((part.mean.grad[:m] != 0).all())
        assert not bool(part.lower.grad.any()) and not bool(part.mean.grad[m:].any())
    assert not any(bool(latent.grad.any()) for latent in latents if latent.grad is not None)


def test_values_are_counted_as_in_the_paper() -> None:
    """The paper's code keeps L11 as a square; its upper triangle, which nothing reads, is not stored here."""
    sets = HyperSets(10, 32, 8)
    counts = [sum(p.numel() for p in getattr(sets, name).parameters()) // 10 for name in Attributes._fields[:5]]
    assert counts == [41, 824, 54, 41, 18]
    upper = [m * (m - 1) // 2 for m in (3, 32, 4, 3, 1)]
    assert [a + b for a, b in zip(counts, upper, strict=True)] == [44, 1320, 60, 44, 18]


def test_every_attribute_follows_its_own_latent_and_gaussian() -> None:
    sets = HyperSets(5, 6, 2)
    torch.nn.init.normal_(sets.position.cross)
    for part in (sets.colour, sets.rotation, sets.scale, sets.opacity):
        torch.nn.init.normal_(part.cross)
    latents = latents_of(5, 2)
    before = sets(*latents)
    followers = [(0, 0, {"position"}), (1, 0, {"colour"})]
    followers += [(2, 2 * k, {name}) for k, name in enumerate(("rotation", "scale", "opacity"))]
    for which, column, names in followers:
        moved = [latent.clone() for latent in latents]
        moved[which][3, column] += 1.0
        after = sets(*moved)
        changed = {
            name: bool((a != b).any()) for name, a, b in zip(Attributes._fields[:5], after[:5], before[:5], strict=True)
        }
        assert {name for name, is_changed in changed.items() if is_changed} == names
        for a, b in zip(after[:5], before[:5], strict=True):
            assert torch.equal(a[[0, 1, 2, 4]], b[[0, 1, 2, 4]])


def test_colours_start_where_they_are_told_to() -> None:
    sets, colours = HyperSets(5, 6, 2), torch.randn(5, 6)
    sets.start_colour(colours)
    attributes = sets(*latents_of(5, 2))
    assert torch.equal(attributes.colour, colours) and not bool(attributes.position.any())
