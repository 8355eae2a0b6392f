"""The networks' sizes and their blend against a plain loop over the points."""

from __future__ import annotations

import pytest
import torch

from avatar.gaussianheadavatar import networks
from avatar.gaussianheadavatar.networks import Blended, Networks, Outputs, PointNetwork, encode, nearness


def small_networks(latents: int | None = None) -> Networks:
    outputs = Outputs(3, 4, 8) if latents is None else Outputs(latents, latents, 3 * latents)
    return Networks(theta=5, width=16, features=7, outputs=outputs, bounded=latents is None).double()


def inputs(num: int, near: torch.Tensor | None = None) -> list[torch.Tensor]:
    some = torch.linspace(-0.5, 1.5, num).clamp(0, 1) if near is None else near
    shapes = (num, 3), (num, 7), (5,), (6,)
    return [*(torch.randn(shape, dtype=torch.float64) for shape in shapes), some.double()]


def test_parameters_are_counted_as_published() -> None:
    with torch.device("meta"):
        both = Networks(theta=64)
    counts = [
        sum(p.numel() for p in getattr(branch, name).parameters())
        for name in ("colour", "deformation", "attributes")
        for branch in (both.expression, both.pose)
    ]
    assert counts == [129_568, 33_376, 310_787, 87_798, 232_200, 42_424]


def test_the_narrowest_networks_have_hidden_layers() -> None:
    narrow = Networks(theta=5, width=1, features=7, outputs=Outputs(3, 4, 8))
    assert min(size for parameter in narrow.parameters() for size in parameter.shape) > 0


@pytest.mark.parametrize("dims", [(7, 5, 4), (7, 5, 6, 4), (7, 5, 6, 5, 8, 3)])
def test_a_network_sees_its_input_again_in_the_middle(dims: tuple[int, ...]) -> None:
    network, values = PointNetwork(dims, "tanh"), torch.randn(9, 7)
    x = values
    for i, layer in enumerate(network.layers):
        if i == len(dims) // 2:
            x = torch.cat((x, values), dim=-1)
        x = x @ layer.weight.T + layer.bias
        if i < len(dims) - 2:
            x = torch.where(x > 0, x, 0.01 * x)
    torch.testing.assert_close(network(values), torch.tanh(x))
    network.last = None
    torch.testing.assert_close(network(values), x)


@pytest.mark.parametrize(("size", "coded"), [(3, 27), (6, 54)])
def test_a_code_holds_the_values_and_their_sines_and_cosines(size: int, coded: int) -> None:
    values = torch.randn(2, size)
    code = encode(values)
    waves = [wave(values * 2.0**k) for k in range(4) for wave in (torch.sin, torch.cos)]
    assert code.shape == (2, coded) and encode(values[0]).shape == (coded,)
    assert torch.equal(code.sort(dim=1).values, torch.cat((values, *waves), dim=1).sort(dim=1).values)


def plain(nets: Networks, places, features, theta, beta, near) -> Blended:
    """Every network on every point, one point at a time."""
    outputs: list[tuple[torch.Tensor, ...]] = []
    for place, feature, weight in zip(places, torch.tanh(features), near, strict=True):
        of_point = []
        for name in Blended._fields:
            start = encode(place) if name == "deformation" else feature
            e = getattr(nets.expression, name)(torch.cat((start, theta))[None])[0]
            p = getattr(nets.pose, name)(torch.cat((start, encode(beta)))[None])[0]
            of_point.append(weight * e + (1 - weight) * p)
        outputs.append(tuple(of_point))
    return Blended(*(torch.stack(values) for values in zip(*outputs, strict=True)))


@pytest.mark.parametrize("latents", [None, 2])
def test_the_blend_is_that_of_a_plain_loop(latents: int | None) -> None:
    nets, given = small_networks(latents), inputs(21)
    blended, expected = nets(*given), plain(nets, *given)
    sizes = (3, 4, 8) if latents is None else (2, 2, 6)
    for size, found, value in zip(sizes, blended, expected, strict=True):
        assert found.shape == (21, size)
        torch.testing.assert_close(found, value)


def test_only_a_deformation_in_metres_is_bounded() -> None:
    for latents in (None, 3):
        nets, given = small_networks(latents), inputs(21)
        given[0] *= 1e4
        bounded = latents is None
        assert bool((nets(*given).deformation.abs() <= 1).all()) == bounded


def test_gradients_reach_the_points_and_both_paths() -> None:
    nets, given = small_networks(), inputs(21)
    places, features, theta, beta = (value.requires_grad_() for value in given[:4])
    sum(field.square().sum() for field in nets(*given)).backward()
    for value in (places, features):
        assert value.grad is not None and bool((value.grad != 0).all())
    for value in (theta, beta, *nets.parameters()):
        assert value.grad is not None and bool(value.grad.isfinite().all()) and bool(value.grad.any())


@pytest.mark.parametrize("all_near", [True, False])
def test_a_path_that_no_point_needs_stays_out(all_near: bool) -> None:
    nets, given = small_networks(), inputs(6, torch.full((6,), float(all_near)))
    unused = nets.pose if all_near else nets.expression
    for parameter in unused.parameters():
        parameter.data.fill_(float("nan"))
    blended = nets(*given)
    sum(field.sum() for field in blended).backward()
    assert all(bool(field.isfinite().all()) for field in blended)
    used = nets.expression if all_near else nets.pose
    assert all(bool(p.grad.isfinite().all()) for p in used.parameters() if p.grad is not None)
    assert all(p.grad is None or not bool(p.grad.any()) for p in unused.parameters())


def test_nearness_falls_with_the_squared_distance(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(networks, "CHUNK", 3)
    landmarks = torch.tensor([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    distances = torch.tensor([0.0, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0])
    points = torch.stack((10.0 + distances, torch.zeros(7), torch.zeros(7)), dim=1).requires_grad_()
    near = nearness(points, landmarks, 1.0, 3.0)
    torch.testing.assert_close(near, ((9 - distances**2) / 8).clamp(0, 1))
    assert not near.requires_grad
