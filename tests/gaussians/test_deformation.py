from __future__ import annotations

import math

import torch
from torch import nn

from avatar.gaussians.deformation import DeformationMLP
from avatar.gaussians.encoding import encoded_size, positional_encoding


def test_the_split_first_layer_equals_one_layer_on_the_concatenated_input() -> None:
    network = DeformationMLP(51, 120, 10).double()
    code, condition = torch.randn(40, 51, dtype=torch.float64), torch.randn(120, dtype=torch.float64)
    layers: list[nn.Module] = [network.input, nn.ReLU()]
    for hidden in network.hidden:
        layers += [hidden, nn.ReLU()]
    plain = nn.Sequential(*layers, network.output)
    joined = torch.cat((code, condition.expand(40, 120)), dim=1)
    torch.testing.assert_close(network(code, condition), plain(joined), rtol=1e-12, atol=1e-12)

    weights = torch.randn(40, 10, dtype=torch.float64)
    parameters = list(network.parameters())
    split = torch.autograd.grad((network(code, condition) * weights).sum(), parameters)
    whole = torch.autograd.grad((plain(joined) * weights).sum(), parameters)
    for a, b in zip(split, whole, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-10)


def test_flashavatars_network_has_375_thousand_parameters() -> None:
    with torch.device("meta"):
        network = DeformationMLP(encoded_size(8), 120, 10)
    assert sum(p.numel() for p in network.parameters()) == 375_562


def test_positional_encoding_is_the_point_then_sines_and_cosines_of_doubling_frequencies() -> None:
    point = torch.tensor([[0.1, -0.2, 0.3]], dtype=torch.float64)
    code = positional_encoding(point, frequencies=8)[0].tolist()
    expected = point[0].tolist()
    for k in range(8):
        expected += [math.sin(2**k * x) for x in point[0].tolist()]
        expected += [math.cos(2**k * x) for x in point[0].tolist()]
    assert len(code) == encoded_size(8) == 51
    assert max(abs(a - b) for a, b in zip(code, expected, strict=True)) < 1e-12
