"""LPIPS v0.1, the learned perceptual distance, as a small torch module; its weights are in `lpips.py`.

    d(x, y) = sum over taps l of mean over pixels of  w_l . (unit(f_l(x)) - unit(f_l(y)))^2

f_l are ReLU features of an ImageNet network and unit() divides by the norm over channels. Inputs here are images in
[0, 1]; they are brought to [-1, 1] and standardised inside. The figure is unscaled. Source: Zhang et al. 2018, "The
Unreasonable Effectiveness of Deep Features as a Perceptual Metric"; features as in torchvision's vgg16, alexnet and
squeezenet1_1. The layers carry torchvision's numbers, so that its published files fit as they are.
"""

from __future__ import annotations

import hashlib
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from avatar.tensors import check_shapes

Net = Literal["vgg", "alex", "squeeze"]
NETS: tuple[Net, ...] = ("vgg", "alex", "squeeze")
MIN_SIZE = 32  # pixels; the deepest tap of each network still has a pixel


class Fire(nn.Module):
    """SqueezeNet's module: 1x1 convolution down, then 1x1 and 3x3 side by side."""

    def __init__(self, inputs: int, squeezed: int, expanded: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, squeezed, 1)
        self.expand1x1 = nn.Conv2d(squeezed, expanded, 1)
        self.expand3x3 = nn.Conv2d(squeezed, expanded, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        x = F.relu(self.squeeze(x))
        return F.relu(torch.cat((self.expand1x1(x), self.expand3x3(x)), dim=1))


def vgg16_features() -> tuple[nn.Sequential, tuple[int, ...]]:
    """torchvision's vgg16.features up to relu5_3, and the layers after which LPIPS taps it."""
    layers: list[nn.Module] = []
    inputs = 3
    for outputs in (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512):  # 0: pool
        if outputs == 0:
            layers.append(nn.MaxPool2d(2))
        else:
            layers += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU(inplace=True)]
            inputs = outputs
    return nn.Sequential(*layers), (3, 8, 15, 22, 29)


def alexnet_features() -> tuple[nn.Sequential, tuple[int, ...]]:
    """torchvision's alexnet.features up to the last ReLU, and the layers after which LPIPS taps it."""
    layers = nn.Sequential(
        *(nn.Conv2d(3, 64, 11, stride=4, padding=2), nn.ReLU(inplace=True), nn.MaxPool2d(3, 2)),
        *(nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(inplace=True), nn.MaxPool2d(3, 2)),
        *(nn.Conv2d(192, 384, 3, padding=1), nn.ReLU(inplace=True)),
        *(nn.Conv2d(384, 256, 3, padding=1), nn.ReLU(inplace=True)),
        *(nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(inplace=True)),
    )
    return layers, (1, 4, 7, 9, 11)


def squeezenet_features() -> tuple[nn.Sequential, tuple[int, ...]]:
    """torchvision's squeezenet1_1.features, and the layers after which LPIPS taps it."""
    layers = nn.Sequential(
        *(nn.Conv2d(3, 64, 3, stride=2), nn.ReLU(inplace=True), nn.MaxPool2d(3, 2, ceil_mode=True)),
        *(Fire(64, 16, 64), Fire(128, 16, 64), nn.MaxPool2d(3, 2, ceil_mode=True)),
        *(Fire(128, 32, 128), Fire(256, 32, 128), nn.MaxPool2d(3, 2, ceil_mode=True)),
        *(Fire(256, 48, 192), Fire(384, 48, 192), Fire(384, 64, 256), Fire(512, 64, 256)),
    )
    return layers, (1, 4, 7, 9, 10, 11, 12)


FEATURES = {"vgg": vgg16_features, "alex": alexnet_features, "squeeze": squeezenet_features}
CHANNELS: dict[Net, tuple[int, ...]] = {
    "vgg": (64, 128, 256, 512, 512),
    "alex": (64, 192, 384, 256, 256),
    "squeeze": (64, 128, 256, 384, 384, 512, 512),
}


class Lpips(nn.Module):
    """`Lpips(net)(image, target)`; weights are frozen, random until loaded (use
    `avatar.losses.lpips.load_lpips`)."""

    shift: Tensor
    scale: Tensor

    def __init__(self, net: Net) -> None:
        super().__init__()
        self.net: Net = net
        self.features, self.taps = FEATURES[net]()
        self.heads = nn.ParameterList(nn.Parameter(torch.rand(channels)) for channels in CHANNELS[net])
        # LPIPS's constants: ImageNet's mean and standard deviation, rounded, for inputs in [-1, 1]
        self.register_buffer("shift", torch.tensor((-0.030, -0.088, -0.188))[:, None, None], persistent=False)
        self.register_buffer("scale", torch.tensor((0.458, 0.448, 0.450))[:, None, None], persistent=False)
        # Channels last: 1.6 times faster here on a CPU with squeeze at 256x256, forward and backward
        self.requires_grad_(False).eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, ""]:
        """The distance of two images with values in [0, 1] (not checked; renders may leave it a little).

        Differentiable in both. Raises ValueError for sizes that disagree or are under 32 pixels.
        """
        sizes = check_shapes(image=(image, "H W 3"), target=(target, "H W 3"))
        if min(sizes["H"], sizes["W"]) < MIN_SIZE:
            raise ValueError(
                f"LPIPS needs images of at least {MIN_SIZE} x {MIN_SIZE} pixels, got {sizes['W']} x {sizes['H']}"
            )
        total = torch.zeros((), dtype=image.dtype, device=image.device)
        for head, first, second in zip(
            self.heads, self._unit_features(image), self._unit_features(target), strict=True
        ):
            squared = (first - second).square()
            total = total + (squared * head[:, None, None]).sum(dim=0).mean()
        return total

    def on(self, device: torch.device) -> Lpips:
        """Move to a device. On a GPU channels come first: with channels last its pooling adds gradients up in any order. So
        do some of cuDNN's convolutions, which are turned off for the whole process."""
        if device.type == "cpu":
            return self.to(device)
        torch.backends.cudnn.deterministic = True
        return self.to(device, memory_format=torch.contiguous_format)  # type: ignore[call-overload]

    def _unit_features(self, image: Tensor) -> list[Tensor]:
        x = ((image.permute(2, 0, 1) * 2.0 - 1.0 - self.shift) / self.scale).unsqueeze(0)
        if x.is_cuda:
            x = x.contiguous()
        units = []
        for index, layer in enumerate(self.features):
            x = layer(x)
            if index in self.taps:
                units.append(F.normalize(x, dim=1, eps=1e-10)[0])  # zero, with a zero gradient, where all is zero
        return units

    def fingerprint(self) -> str:
        """SHA-256 over names and values of the weights, for results files."""
        digest = hashlib.sha256(self.net.encode())
        for name, tensor in sorted(self.state_dict().items()):
            digest.update(name.encode())
            digest.update(tensor.detach().cpu().contiguous().numpy().data)
        return digest.hexdigest()
