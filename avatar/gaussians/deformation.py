"""The deformation network: a place on the neutral mesh and the frame's condition in, a vector per Gaussian out."""

from __future__ import annotations

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
