"""The deformation network: a place on the neutral mesh and the frame's condition in, a vector per Gaussian out."""

from __future__ import annotations

import threading

import torch
from jaxtyping import Float
from torch import Tensor, nn


class DeformationMLP(nn.Module):
    """`layers` hidden layers of `width` with ReLU, then a linear output (FlashAvatar: 6 x 256).

    The input of the first layer is (positional code, frame condition). The code differs between Gaussians and never
    changes; the condition changes with the frame and is the same for all Gaussians. So the first layer is two products,
    code @ A + (condition @ B + b), and the second is a single row: the same weights and result as one layer on the
    concatenated input, for 30% of its arithmetic with 51 code and 120 condition values.
    """

    def __init__(self, code_size: int, condition_size: int, out_size: int, width: int = 256, layers: int = 6) -> None:
        super().__init__()
        self.code_size, self.condition_size = code_size, condition_size
        self.input = nn.Linear(code_size + condition_size, width)
        self.hidden = nn.ModuleList(nn.Linear(width, width) for _ in range(layers - 1))
        self.output = nn.Linear(width, out_size)

    def forward(self, code: Float[Tensor, "N C"], condition: Float[Tensor, " D"]) -> Float[Tensor, "N O"]:
        for_code, for_condition = self.input.weight.split((self.code_size, self.condition_size), dim=1)
        of_frame = torch.addmv(self.input.bias, for_condition, condition)
        x = torch.relu_(torch.addmm(of_frame, code, for_code.T))
        for layer in self.hidden:
            x = torch.relu_(layer(x))
        return self.output(x)


class FoldedNetwork(nn.Module):
    """A network that is not trained any more, with the first layer's product with the code done; the same to rounding."""

    def __init__(self, network: DeformationMLP, code: Float[Tensor, "N C"]) -> None:
        super().__init__()
        for_code, for_condition = network.input.weight.detach().split((network.code_size, network.condition_size), 1)
        self.of_code = code @ for_code.T
        self.for_condition, self.bias = for_condition.clone(), network.input.bias.detach().clone()
        self.layers = [
            (layer.get_parameter("weight").detach().T.clone(), layer.get_parameter("bias").detach().clone())
            for layer in (*network.hidden, network.output)
        ]
        self._of_thread = threading.local()  # megabytes: fresh memory in every frame would cost page faults

    def forward(self, _: Tensor, condition: Float[Tensor, " D"]) -> Float[Tensor, "N O"]:
        """What the network gives for its code, which it has already, and this condition; no gradients."""
        of_frame, own = torch.addmv(self.bias, self.for_condition, condition), self._of_thread
        if not hasattr(own, "pair"):
            own.pair = torch.empty_like(self.of_code), torch.empty_like(self.of_code)
        x, spare = own.pair
        torch.add(self.of_code, of_frame, out=x).relu_()
        for weight, bias in self.layers[:-1]:
            torch.addmm(bias, x, weight, out=spare).relu_()
            x, spare = spare, x
        weight, bias = self.layers[-1]
        return torch.addmm(bias, x, weight)
