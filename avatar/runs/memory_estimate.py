"""How much memory an avatar takes, from its configuration and head model, before anything of it is allocated.

The figures are of the tensors that are alive at once; tests/runs/test_footprint.py compares them with what a process takes.
"""

from __future__ import annotations

import math

from avatar.compute.memory import Need
from avatar.config import Config, ModelConfig
from avatar.data.loader import BYTES_PER_PIXEL, CACHE_BYTES, FRAMES_AHEAD
from avatar.errors import UserError
from avatar.gaussians.encoding import encoded_size
from avatar.head.assets import HeadAssets
from avatar.runs.model_registry import MODELS

Shapes = dict[str, tuple[int, ...]]  # by the names in a state dict

FLOAT = 4  # bytes
MESH_BYTES = 2**28  # of posed meshes, 4,400 frames of FLAME's 5,023 vertices; what does not fit is computed again
STEP_COPIES = 4  # of a parameter during a step: itself, its gradient, Adam's two moments
# While a checkpoint is written: all but the gradient once more as a file, which is copied once.
SAVING_COPIES = 4 + 2 * 3
UNPACKING_COPIES = 2  # of the HyperGaussians more, because a file holds them in another order
DRAWING_COPIES = 3  # while an avatar is opened: what the file holds, the model, what the renderer makes of it
# Floats for a Gaussian in a step, beside its parameters and latents: colours and their gradients (3 times 48), what is
# drawn and its gradient, offsets, points and their corners.
STEP_FLOATS = 250
# Bytes for a pixel in a step, by the perceptual term; measured with 256x256 to 1024x1024 pixels.
PIXEL_BYTES = {"none": 100, "dssim": 110, "lpips-squeeze": 1050, "lpips-alex": 360, "lpips-vgg": 3600}

_NETWORK = ("the deformation network", "model.mlp_width or model.mlp_layers")
_HEADS = ("the HyperGaussians", "model.uv_size or model.latent_dim")
_OTHERS = ("colours and shapes of the Gaussians", "model.uv_size")


def count_gaussians(config: ModelConfig, assets: HeadAssets) -> int:
    """How many Gaussians an avatar of this head has. Raises UserError where the UV raster is too coarse to have any."""
    try:
        return MODELS[config.name].count_gaussians(config, assets)
    except ValueError as error:
        raise UserError(f"model.uv_size={config.uv_size} is too small: {error}") from None


def training_needs(
    config: Config, assets: HeadAssets, *, frames: int, size: tuple[int, int], perceptual: str
) -> list[Need]:
    """What training takes at its peak, which is in a step or while a checkpoint is written.

    frames      that are trained on, of `size` (width, height) pixels
    perceptual  the name of the perceptual term
    """
    model, pixels = config.model, size[0] * size[1]
    gaussians = count_gaussians(model, assets)
    shapes = MODELS[model.name].shapes(model, assets.num_expressions, gaussians)
    cached = min(CACHE_BYTES, frames * pixels * BYTES_PER_PIXEL)
    posed = min(MESH_BYTES, frames * 3 * FLOAT * assets.num_vertices)
    ahead = FRAMES_AHEAD * pixels * BYTES_PER_PIXEL
    lasting = [
        Need("the cache of decoded frames", cached + posed, "--size"),
        Need("a frame and its losses", ahead + pixels * PIXEL_BYTES.get(perceptual, PIXEL_BYTES["dssim"]), "--size"),
    ]
    layers = encoded_size() + (model.mlp_layers + 2) * model.mlp_width
    step = [
        *parameter_needs(shapes, STEP_COPIES),
        Need(
            "the network's layers at every place",
            FLOAT * MODELS[model.name].most_places(model, gaussians) * layers,
            "model.mlp_width, model.mlp_layers or model.latent_grid",
        ),
        Need("drawing", FLOAT * gaussians * (STEP_FLOATS + 3 * model.latent_dim), "model.uv_size"),
        *MODELS[model.name].step_needs(model, gaussians, size),
    ]
    saving = parameter_needs(shapes, SAVING_COPIES, UNPACKING_COPIES)
    return [*lasting, *max(step, saving, key=lambda needs: sum(need.size for need in needs))]


def drawing_needs(config: ModelConfig, assets: HeadAssets, gaussians: int) -> list[Need]:
    """What opening a trained avatar and drawing it takes."""
    shapes = MODELS[config.name].shapes(config, assets.num_expressions, gaussians)
    # The first layer's, and two that are filled in turn.
    layers = encoded_size() + 3 * config.mlp_width
    places = MODELS[config.name].most_places(config, gaussians)
    return [
        *parameter_needs(shapes, DRAWING_COPIES, UNPACKING_COPIES),
        Need(
            "the network's layers at every place",
            FLOAT * places * layers,
            "model.mlp_width",
        ),
    ]


def parameter_needs(shapes: Shapes, copies: int, more_of_heads: int = 0) -> list[Need]:
    """What the parameters take, `copies` times; `more_of_heads`: and the HyperGaussians so many times more."""
    sizes = dict.fromkeys((_NETWORK, _HEADS, _OTHERS), 0)
    for name, shape in shapes.items():
        part = (
            _NETWORK
            if name.startswith(("deformation.", "networks.", "upsampler."))
            else _HEADS
            if name.startswith("hyper.")
            else _OTHERS
        )
        sizes[part] += FLOAT * math.prod(shape) * (copies + more_of_heads * (part is _HEADS))
    return [Need(what, size, lower) for (what, lower), size in sizes.items()]
