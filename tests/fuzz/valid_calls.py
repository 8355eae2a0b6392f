"""Arguments with which each compiled function has to answer, and the shapes of its arrays."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import torch

from avatar import _core

Arguments = dict[str, Any]
Shapes = dict[str, str]  # of every array, as check_shapes takes them

OUTPUTS = {
    "image",
    "alpha",
    "face_id",
    "barycentric",
    "depth",
    "offsets",
    "out",
    "means",
    "out_quats",
    "scales",
}
KERNEL = {"simd": "", "threads": 2}
COUNTS = [0, 1, 2, 17, 300]  # a thread takes 256 or 1,024 at a time


def arrays(shapes: Shapes, sizes: dict[str, int]) -> Arguments:
    """Random float32 tensors."""
    return {
        name: torch.rand([sizes[d] if d in sizes else int(d) for d in shape.split()]) for name, shape in shapes.items()
    }


def splat_forward(r: random.Random) -> tuple[Arguments, Shapes]:
    degree = r.randrange(4)
    N, H, W, K = r.choice(COUNTS), r.choice([1, 5, 33, 70]), r.choice([1, 31, 64]), r.randint((degree + 1) ** 2, 16)
    shapes = {"means": "N 3", "quats": "N 4", "scales": "N 3", "opacities": "N", "sh": "N K 3", "background": "3"}
    shapes |= {"image": "H W 3", "alpha": "H W"}
    left, top = r.randrange(W), r.randrange(H)
    return {
        **arrays(shapes, {"N": N, "K": K, "H": H, "W": W}),
        "rotation": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "translation": [0.0, 0.0, 1.0],
        "intrinsics": [float(W), float(W), W / 2, H / 2],
        "sh_degree": degree,
        "cutoffs": [1 / 255, 0.999, 1e-4],
        "blur": 0.3,
        "near": 0.01,
        "antialiased": r.random() < 0.5,
        "everywhere": r.random() < 0.2,
        "region": [left, top, r.randint(left + 1, W), r.randint(top + 1, H)],
        **KERNEL,
    }, shapes


def splat_backward(r: random.Random) -> tuple[Arguments, Shapes]:
    drawn, shapes = splat_forward(r)
    drawing = _core.splat_forward(**drawn)
    inputs = {name: shapes[name] for name in ("means", "quats", "scales", "opacities", "sh")}
    H, W = drawn["alpha"].shape
    of_pass = {**{f"grad_{name}": shape for name, shape in inputs.items()}, "grad_background": "3"}
    of_pass |= {"grad_image": f"{H} {W} 3", "grad_alpha": f"{H} {W}"}
    sizes = {"N": len(drawn["means"]), "K": drawn["sh"].shape[1]}
    shapes = {name: shape.replace("N", str(sizes["N"])) for name, shape in {**inputs, **of_pass}.items()}
    return {"drawing": drawing, **{name: drawn[name] for name in inputs}, **arrays(of_pass, sizes)}, shapes


def rasterize_mesh(r: random.Random) -> tuple[Arguments, Shapes]:
    sizes = {"V": r.choice([1, 3, 50]), "F": r.choice(COUNTS), "H": r.choice([0, 1, 40]), "W": r.choice([0, 1, 30])}
    shapes = {"screen": "V 3", "faces": "F 3", "face_id": "H W", "barycentric": "H W 3", "depth": "H W"}
    call = arrays(shapes, sizes)
    call["screen"] *= 40
    call["faces"] = (call["faces"] * sizes["V"]).int()
    call["face_id"] = call["face_id"].int()
    return call, shapes


def hyper(r: random.Random, more: Shapes) -> tuple[Arguments, Shapes]:
    """A call with `latents` and more, in whose shapes B and R are the blocks and rows of the parameters."""
    sizes = {"N": r.choice(COUNTS), "n": r.choice([0, 1, 7, 8, 19])}
    blocks, rows = -(-sizes["N"] // 16), 32 + 13 * sizes["n"]
    shapes = {"latents": "N n"} | {k: v.replace("B", str(blocks)).replace("R", str(rows)) for k, v in more.items()}
    return {**arrays(shapes, sizes), **KERNEL}, shapes


def hyper_backward(r: random.Random) -> tuple[Arguments, Shapes]:
    more = {"packed": "B R 16", "solved": "B 10 16", "grad_offsets": "N 10", "grad_latents": "N n"}
    call, shapes = hyper(r, more)
    return {**call, "with_parameters": r.random() < 0.5}, shapes


def interpolate_forward(r: random.Random) -> tuple[Arguments, Shapes]:
    sizes = {"N": r.choice(COUNTS), "G": r.choice([1, 9, 64]), "n": r.choice([0, 1, 8, 19])}
    shapes = {"grid": "G n", "cells": "N 4", "weights": "N 4", "out": "N n"}
    call = {**arrays(shapes, sizes), **KERNEL}
    call["cells"] = (call["cells"] * sizes["G"]).int()
    return call, shapes


def interpolate_backward(r: random.Random) -> tuple[Arguments, Shapes]:
    sizes = {"N": r.choice(COUNTS[1:]), "G": r.choice([0, 1, 9, 64]), "n": r.choice([0, 1, 8, 19])}
    sizes["P"] = 4 * sizes["N"] if sizes["G"] else 0
    shapes = {"grad": "N n", "begins": f"{sizes['G'] + 1}", "gaussians": "P", "weights": "P", "grad_grid": "G n"}
    call = {**arrays(shapes, sizes), **KERNEL}
    call["gaussians"] = (call["gaussians"] * sizes["N"]).int()
    call["begins"] = torch.linspace(0, sizes["P"], sizes["G"] + 1).long() if sizes["G"] else torch.tensor([0])
    return call, shapes


def apply_offsets(shapes: Shapes) -> Callable[[random.Random], tuple[Arguments, Shapes]]:
    return lambda r: ({**arrays(shapes, {"N": r.choice(COUNTS)}), **KERNEL}, shapes)


def dssim(r: random.Random) -> tuple[Arguments, Shapes]:
    shapes = {"image": "H W 3", "target": "H W 3", "mask": "H W", "gradient": "H W 3"}
    call = {**arrays(shapes, {"H": r.choice([11, 12, 40]), "W": r.choice([11, 25, 64])}), **KERNEL}
    call["mask"] = call["mask"].round()
    return call, shapes


ACTIVATED = {"means": "N 3", "out_quats": "N 4", "scales": "N 3", "opacities": "N"}
BASES = {"quats": "N 4", "log_scales": "N 3", "raw": "N 10"}
BINDINGS: dict[str, Callable[[random.Random], tuple[Arguments, Shapes]]] = {
    "splat_forward": splat_forward,
    "splat_backward": splat_backward,
    "rasterize_mesh": rasterize_mesh,
    "hyper_forward": lambda r: hyper(r, {"packed": "B R 16", "offsets": "N 10", "solved": "B 10 16"}),
    "hyper_backward": hyper_backward,
    "hyper_apply": lambda r: hyper(r, {"matrix": "N n 10", "bias": "N 10", "offsets": "N 10"}),
    "interpolate_forward": interpolate_forward,
    "interpolate_backward": interpolate_backward,
    "apply_offsets_forward": apply_offsets({"points": "N 3", **BASES, "opacity_logits": "N", **ACTIVATED}),
    "apply_offsets_backward": apply_offsets(
        {
            **BASES,
            "scales": "N 3",
            "opacities": "N",
            **{f"by_{name.removeprefix('out_')}": shape for name, shape in ACTIVATED.items()},
            **{f"grad_{name}": shape for name, shape in BASES.items()},
            "grad_opacity_logits": "N",
        }
    ),
    "dssim": dssim,
}
