"""A thousand random scenes, or as many as AVATAR_STRESS_EXAMPLES says, against the batched float64 oracle.

Every batch of 64 scenes has a seed, which is its test's name: a failure is repeated with -k 'seed and 123'.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

import pytest
import torch
from splat.scenes import POSE
from stress.batched_oracle import Batch, Drawn, draw
from stress.random_scenes import random_batch
from torch import Tensor

from avatar.bench.machine import available_simd, limited_to
from avatar.bench.splat import GRADIENT_TOLERANCE, IMAGE_TOLERANCE
from avatar.splat import splat
from avatar.types import Gaussians, Rendering

SCENES = 64
SEEDS = range(-(-int(os.environ.get("AVATAR_STRESS_EXAMPLES", "1024")) // SCENES))
SIMD = available_simd()

# IMAGE_TOLERANCE is of 1 + the brightest colour, GRADIENT_TOLERANCE of the gradient and of what rounding errors of relative
# size 1 would make of it.
NOTHING = 1e-30  # float32 ends at 1e-38, and products of what is near it
# Of longer splats, in pixels, some gradients of mean, quaternion and scale are further off; these are not compared.
LONG = 1e3


def inputs_of(batch: Batch) -> dict[str, Tensor]:
    """All that a drawing has a gradient in."""
    pose = {name: getattr(batch, name) for name in POSE}
    return {**batch.gaussians._asdict(), "background": batch.background, **pose}


@dataclass(frozen=True)
class Truth:
    """What the oracle says of a batch, and cotangents that are zero at ambiguous pixels."""

    drawn: Drawn
    grad_image: Tensor
    grad_alpha: Tensor
    gradients: dict[str, Tensor]
    noise: dict[str, Tensor]  # see Rounding.noise


def truth_of(batch: Batch, seed: int) -> Truth:
    g = torch.Generator().manual_seed(seed)
    shape = (len(batch), batch.height, batch.width)
    grad_image, grad_alpha = torch.randn(*shape, 3, generator=g), torch.randn(shape, generator=g)
    leaves = {name: leaf.double().requires_grad_() for name, leaf in inputs_of(batch).items()}
    gaussians = Gaussians(*(leaves[name] for name in Gaussians._fields))
    posed = replace(batch, **{name: leaves[name] for name in POSE})
    drawn = draw(posed, gaussians, leaves["background"], grad_image.double(), grad_alpha.double())
    grad_image = grad_image.masked_fill(drawn.ambiguous[..., None], 0.0)
    grad_alpha = grad_alpha.masked_fill(drawn.ambiguous, 0.0)
    loss = (drawn.image * grad_image).sum() + (drawn.alpha * grad_alpha).sum()
    gradients = torch.autograd.grad(loss, list(leaves.values()), retain_graph=True)
    noise = torch.autograd.grad(drawn.rounding.noise(g), list(leaves.values()), materialize_grads=True)
    return Truth(
        drawn,
        grad_image,
        grad_alpha,
        dict(zip(leaves, gradients, strict=True)),
        dict(zip(leaves, noise, strict=True)),
    )


def draw_with_kernel(
    batch: Batch, truth: Truth, function: Callable[..., Rendering] = splat, dtype: torch.dtype = torch.float32
) -> tuple[Rendering, dict[str, Tensor]]:
    """Images and gradients of all scenes, one after the other, in float64 for the comparison."""
    renderings, gradients, inputs = [], [], inputs_of(batch)
    for b in range(len(batch)):
        leaves = [tensor[b].to(dtype, copy=True).requires_grad_() for tensor in inputs.values()]
        camera = replace(batch.camera(b), **dict(zip(POSE, leaves[6:], strict=True)))
        found = function(Gaussians(*leaves[:5]), camera, leaves[5], **asdict(batch.options))
        cotangents = truth.grad_image[b].to(dtype), truth.grad_alpha[b].to(dtype)
        gradients.append(torch.autograd.grad(found, leaves, cotangents, materialize_grads=True))
        renderings.append(Rendering(*(t.detach() for t in found)))
    image, alpha = (torch.stack(fields).double() for fields in zip(*renderings, strict=True))
    columns = (torch.stack(column).double() for column in zip(*gradients, strict=True))
    return Rendering(image, alpha), dict(zip(inputs, columns, strict=True))


def norms(name: str, field: Tensor) -> Tensor:
    """The lengths of what belongs to one splat, [B, N], or of the background or a part of the pose, [B, 1]."""
    batch, count = len(field), field.shape[1] if name in Gaussians._fields else 1
    return torch.linalg.vector_norm(field.reshape(batch, count, field[0].numel() // max(count, 1)), dim=-1)


def allowed_and_error(truth: Truth, found: dict[str, Tensor]) -> dict[str, tuple[Tensor, Tensor]]:
    """For every splat, the background, R and t: the error of its gradient and what is allowed, infinite if not compared."""
    result = {}
    for name, expected in truth.gradients.items():
        error = norms(name, found[name] - expected)
        size = norms(name, expected) + norms(name, truth.noise[name])
        allowed = GRADIENT_TOLERANCE * size + NOTHING
        long, ambiguous = truth.drawn.lengths > LONG, truth.drawn.ambiguous_colour
        if name in POSE:  # sums over splats
            allowed = allowed.masked_fill((long | ambiguous).any(1, keepdim=True), torch.inf)
        if name in ("means", "quats", "scales"):
            allowed = allowed.masked_fill(long, torch.inf)
        if name in ("means", "sh"):
            allowed = allowed.masked_fill(ambiguous, torch.inf)
        result[name] = (error, allowed)
    return result


def assert_agrees(batch: Batch, truth: Truth, found: Rendering, gradients: dict[str, Tensor]) -> None:
    drawn = truth.drawn
    brightest = torch.maximum(drawn.image.abs().amax((1, 2, 3)), batch.background.double().abs().amax(1))
    allowed = (IMAGE_TOLERANCE * (1 + brightest))[:, None, None].expand_as(drawn.alpha)
    allowed = allowed.masked_fill(drawn.ambiguous, torch.inf)
    error = (found.image - drawn.image).abs().amax(-1)
    assert torch.isfinite(found.image).all() and torch.isfinite(found.alpha).all()
    assert (error <= allowed).all(), f"image of scenes {worst(error, allowed)}"
    error = (found.alpha - drawn.alpha).abs()
    assert (error <= allowed).all(), f"alpha of scenes {worst(error, allowed)}"
    for name, (error, allowed) in allowed_and_error(truth, gradients).items():
        assert torch.isfinite(gradients[name]).all(), f"gradient of {name}"
        assert (error <= allowed).all(), f"gradient of {name} of scenes {worst(error, allowed)}"


def worst(error: Tensor, allowed: Tensor) -> str:
    places = (error > allowed).nonzero().tolist()
    return f"{sorted({place[0] for place in places})}; error {error[error > allowed].max():.1e}, first at {places[0]}"


@pytest.mark.parametrize("seed", SEEDS, ids=lambda seed: f"seed {seed}")
def test_random_scenes_agree_with_the_batched_oracle(seed: int) -> None:
    batch = random_batch(seed, SCENES)
    truth = truth_of(batch, seed)
    # Instruction sets and thread counts take turns; a thread more than tiles are enough to find a wrong hand-over.
    with limited_to(threads=3 if seed % 5 == 0 else 1, simd=SIMD[seed % len(SIMD)]):
        found, gradients = draw_with_kernel(batch, truth)
    assert_agrees(batch, truth, found, gradients)
