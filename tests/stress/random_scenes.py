"""Random scenes in batches: every size, camera, splat and option that a program may meet, and those that it should not."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from stress.batched_oracle import Batch, Options

from avatar.types import Gaussians

F32 = np.float32
EDGE, CAP = F32(1 / 255), F32(0.999)
OPACITIES = [0.0, 1e-38, np.nextafter(EDGE, F32(0)), EDGE, np.nextafter(EDGE, F32(1)), 1.001 * EDGE]
OPACITIES += [np.nextafter(CAP, F32(0)), CAP, np.nextafter(CAP, F32(1)), 1.0]
COUNTS = [0, 1, 1, 2, 3, 5, 8, 13, 21]


def random_batch(seed: int, scenes: int = 64) -> Batch:
    """The same batch for the same seed on every machine."""
    r = np.random.default_rng(seed)
    count, (width, height) = int(r.choice(COUNTS)), random_size(r)
    degree = int(r.integers(0, 4))
    stored = int(r.integers(degree, 4))

    # Fields of view from 2 to 178 degrees; principal points in the image, around it and far outside.
    focal = max(width, height) * np.exp(r.uniform(np.log(0.01), np.log(30), (scenes, 1))) * r.uniform(0.7, 1.4, (1, 2))
    kind = r.random((scenes, 1))
    centre = np.where(kind < 0.5, r.uniform(0, 1, (scenes, 2)), r.uniform(-3, 4, (scenes, 2)))
    centre = np.where(kind < 0.2, 0.5, centre) * [width, height]
    turned = r.random(scenes) < 0.75
    R = np.where(turned[:, None, None], rotations(r, scenes), np.eye(3))
    t = np.where(turned[:, None], r.normal(0, 1, (scenes, 3)), 0.0)

    pixel, depth = random_places(r, scenes, count, width, height)
    in_camera = np.concatenate(((pixel - centre[:, None]) / focal[:, None] * depth, depth), -1)
    means = (in_camera - t[:, None]) @ R
    quats = r.normal(size=(scenes, count, 4)) * 10 ** r.uniform(-3, 3, (scenes, count, 1))
    quats = np.where(r.random((scenes, count, 1)) < 0.05, r.choice([0.0, 1.0], (scenes, count, 4)), quats)
    one_pixel = np.abs(depth) / focal[:, None, :1]
    scales = np.where(
        r.random((scenes, count, 1)) < 0.7,
        one_pixel * np.exp(r.uniform(-2, 3.5, (scenes, count, 3))),
        10 ** r.uniform(-12, 6, (scenes, count, 3)),
    )
    opacities = np.where(
        r.random((scenes, count)) < 0.7, r.uniform(0, 1, (scenes, count)), r.choice(OPACITIES, (scenes, count))
    )
    sh = r.normal(0, 0.4, (scenes, count, (stored + 1) ** 2, 3)) * r.choice([1, 1, 1, 30], (scenes, count, 1, 1))
    return Batch(
        Gaussians(*(single(a) for a in (means, quats, scales, opacities, sh))),
        single(r.uniform(0, 1, (scenes, 3)) * r.choice([0, 1, 1, 10], (scenes, 1))),
        single(R),
        single(t),
        torch.from_numpy(focal),
        torch.from_numpy(centre),
        width,
        height,
        random_options(r, degree),
    )


def random_size(r: np.random.Generator) -> tuple[int, int]:
    """Mostly small, where edges weigh most; some of the kernel's tile of 32 x 32 pixels and a little more."""
    kind = r.random()
    if kind < 0.1:
        return 1, 1
    if kind < 0.25:
        width, height = r.choice([31, 32, 33, 64, 65], 2)
    else:
        width, height = np.exp(r.uniform(0, np.log(40), 2)).astype(int)
    return int(width), int(height)


def random_places(
    r: np.random.Generator, scenes: int, count: int, width: int, height: int
) -> tuple[np.ndarray, np.ndarray]:
    """Where splats stand: pixels [B, N, 2] that they would be seen at, and depths [B, N, 1] in metres."""
    pixel = r.uniform(-0.3, 1.3, (scenes, count, 2)) * [width, height]
    pixel = np.where(r.random((scenes, count, 1)) < 0.05, np.floor(pixel) + 0.5, pixel)  # on a pixel centre
    depth = np.exp(r.uniform(np.log(0.011), np.log(100), (scenes, count, 1)))
    kind = r.random((scenes, count, 1))
    depth = np.where(kind < 0.15, r.choice([0.0, 1e-30, 1e-3, 0.00999, 0.01, 0.0101], kind.shape), depth)
    depth = np.where(kind < 0.08, -depth, depth)
    depth = np.where(r.random((scenes, 1, 1)) < 0.1, 1.0, depth)  # all at one depth: drawn in the order of their index
    return pixel, depth


def random_options(r: np.random.Generator, degree: int) -> Options:
    return Options(
        sh_degree=degree,
        alpha_min=pick(r, [1 / 255, 1 / 255, 0.0, 0.05]),
        alpha_max=pick(r, [0.999, 0.999, 0.99, 0.5]),
        t_min=pick(r, [1e-4, 1e-4, 0.0, 0.2]),
        blur=pick(r, [0.3, 0.3, 0.1, 2.0]),
        near=pick(r, [0.01, 0.01, 0.2]),
        antialiased=bool(r.random() < 0.25),
    )


def pick(r: np.random.Generator, values: list[float]) -> float:
    """As the float32 value that every backend uses for a cut-off."""
    return float(F32(values[int(r.integers(len(values)))]))


def rotations(r: np.random.Generator, count: int) -> np.ndarray:
    q, _ = np.linalg.qr(r.normal(size=(count, 3, 3)))
    return q * np.sign(np.linalg.det(q))[:, None, None]


def single(values: np.ndarray[Any, Any]) -> torch.Tensor:
    return torch.from_numpy(values.astype(F32))
