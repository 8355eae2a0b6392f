"""Does this GPU compute what the CPU does? A few hundred Gaussians, placed, drawn, compared and differentiated on both."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from avatar.compute.device import on_gpu
from avatar.compute.gpu_functions import gpu_function
from avatar.errors import UserError
from avatar.gaussians.apply_offsets import apply_offsets
from avatar.gaussians.hyper import HyperHeads
from avatar.gaussians.hyper_cpu import Interpolation, Touching, condition, touching_lists
from avatar.gaussians.skull_binding import Skull, SkullBinding, bind_to_skull
from avatar.losses.photometric import dssim, photometric_loss
from avatar.splat import splat
from avatar.splat.scenes import head_camera, head_shell
from avatar.types import Gaussians

TOLERANCE = 1e-4  # of the largest value of each field
COUNT, SIZE = 400, 96
VERTICES, NODES, LATENT = 50, 30, 8

Fields = dict[str, Tensor]


class WrongGpu(UserError):
    """A GPU that gives other numbers than the CPU."""


def self_test(device: torch.device) -> dict[str, float]:
    """The error of each field, relative to its largest value. Raises WrongGpu where one is above TOLERANCE.

    Takes a second, and the time of compiling the kernels once on a machine.
    """
    errors: dict[str, float] = {}
    for name, make in {"placed avatar": placed, "faint scene": faint_scene, "opaque scene": opaque_scene}.items():
        expected, found = make(torch.device("cpu")), make(device)
        errors |= {f"{field} of the {name}": relative_error(found[field], expected[field]) for field in expected}
    worst = max(errors, key=lambda field: math.inf if math.isnan(errors[field]) else errors[field])
    if not errors[worst] <= TOLERANCE:  # a NaN too
        name = torch.cuda.get_device_name(device) if device.type == "cuda" else str(device)
        raise WrongGpu(
            f"{name} gives wrong numbers: the {worst} is off by {errors[worst]:.1e} of its largest value, and rounding is "
            f"at most {TOLERANCE:.0e} (torch {torch.__version__}); use --device cpu, and report this"
        )
    return errors


def relative_error(found: Tensor, expected: Tensor) -> float:
    return float((found.cpu() - expected).abs().max() / expected.abs().max())


class RandomMesh:
    """Gaussians that hang on random triangles of vertices, and take part of random nodes."""

    def __init__(self, generator: torch.Generator, device: torch.device) -> None:
        self.corners = torch.randint(0, VERTICES, (COUNT, 3), generator=generator).to(device)
        self.barycentric = torch.rand(COUNT, 3, generator=generator).to(device)
        cells = torch.randint(0, NODES, (COUNT, 4), generator=generator)
        self.grid = Interpolation(cells, torch.rand(COUNT, 4, generator=generator), NODES)
        self.grid.move(device)

    def touching(self, num_vertices: int) -> Touching:
        return touching_lists(self.corners, self.barycentric, num_vertices)


def placed(device: torch.device) -> Fields:
    """What a network's values make of a mesh, by HyperGaussians and all, and the gradients."""
    generator = torch.Generator().manual_seed(0)
    sheet = RandomMesh(generator, device)
    heads = HyperHeads(COUNT, LATENT)
    shapes = {"vertices": (VERTICES, 3), "values": (NODES, LATENT), "packed": tuple(heads.packed.shape)}
    shapes |= {"quats": (COUNT, 4), "log_scales": (COUNT, 3), "opacity_logits": (COUNT,)}
    shapes |= {"neck": (6,), "skull_logits": (COUNT,)}
    noise = {name: torch.randn(shape, generator=generator) for name, shape in shapes.items()}
    heads.packed.data.copy_(0.3 * noise["packed"])
    heads.set_heads(heads.heads())  # zeros where no Gaussian is
    noise["packed"] = heads.packed.detach()
    noise["log_scales"] -= 4.0
    leaves = {name: value.to(device).requires_grad_() for name, value in noise.items()}
    vertices, values, packed, quats, log_scales, logits, neck, skull_logits = leaves.values()
    skull = Skull(*(torch.randn(COUNT, 3, generator=generator).to(device) for _ in range(2)))
    skull_binding = SkullBinding(skull, neck, skull_logits)
    sh = torch.zeros(COUNT, 1, 3, device=device)
    if on_gpu(sh):
        base, make = (quats, log_scales, logits, sh), gpu_function("make Gaussians")
        found = make(vertices, values, packed, *base, sheet, sheet.grid, skull_binding)
    else:
        points = bind_to_skull((vertices[sheet.corners] * sheet.barycentric[..., None]).sum(dim=1), skull_binding)
        found = apply_offsets(points, quats, log_scales, logits, sh, condition(sheet.grid(values), packed))
    cotangents = [torch.randn(field.shape, generator=generator).to(device) for field in found[:4]]
    gradients = torch.autograd.grad(found[:4], list(leaves.values()), cotangents)
    fields = dict(zip(Gaussians._fields[:4], (field.detach() for field in found), strict=False))
    return fields | {f"gradient of {name}": gradient for name, gradient in zip(leaves, gradients, strict=True)}


def faint_scene(device: torch.device) -> Fields:
    """Transparent splats, no cut-offs, and a camera whose pose has a gradient."""
    shell = head_shell(COUNT)
    gaussians = shell._replace(opacities=0.1 + 0.5 * shell.opacities, scales=2 * shell.scales)
    return drawn(gaussians, device, ("R_cam_world", "t_cam_world"), alpha_min=0.0, t_min=0.0)


def opaque_scene(device: torch.device) -> Fields:
    """Walls behind walls: the pixels of the head stop. None is so near to the cut-off that rounding could decide."""
    shell = head_shell(COUNT, seed=1)
    gaussians = shell._replace(opacities=torch.full((COUNT,), 0.9), scales=8 * shell.scales)
    return drawn(gaussians, device, alpha_min=0.0)


def drawn(gaussians: Gaussians, device: torch.device, pose: tuple[str, ...] = (), **cutoffs: Any) -> Fields:
    """Image, alpha and the gradients of a loss, also in the fields `pose` of the camera, by the same program anywhere."""
    camera = head_camera(SIZE)
    inputs = {**gaussians._asdict(), "background": torch.tensor([0.2, 0.5, 0.9])}
    inputs |= {name: getattr(camera, name) for name in pose}
    leaves = {name: value.to(device).requires_grad_() for name, value in inputs.items()}
    scene = Gaussians(*(leaves[name] for name in Gaussians._fields))
    camera = replace(camera, **{name: leaves[name] for name in pose})
    image, alpha = splat(scene, camera, leaves["background"], **cutoffs)
    rows = torch.linspace(0, 1, SIZE, device=device)
    mask = (rows[:, None] * rows).clamp(max=0.5)
    target = torch.stack((mask, 1 - mask, rows.expand(SIZE, SIZE)), dim=-1)
    loss = photometric_loss(image, target, mask, mask, perceptual=dssim, perceptual_weight=1.0)
    gradients = torch.autograd.grad(loss.total + alpha.mean(), list(leaves.values()))
    found = {"image": image.detach(), "alpha": alpha.detach(), "loss": loss.total.detach()}
    return found | {f"gradient of {name}": gradient for name, gradient in zip(leaves, gradients, strict=True)}
