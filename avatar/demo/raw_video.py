"""The demo person as somebody's telephone would have filmed them: a room behind, sensor noise, compression."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from avatar.demo.identity import sample_identity
from avatar.demo.performance import FPS, Motion, perform
from avatar.demo.render import Renderer, background_of
from avatar.demo.subject import check_arguments, rendered, single_threads
from avatar.errors import UserError
from avatar.files.video import video_writer

SHOT_NOISE, READ_NOISE = 0.55, 1.2  # standard deviations in levels of 255: per root of the level, and everywhere
_STREET = 1.3  # sides of a picture over which a hand-held camera drifts
_PASSING, _SKIN = 3, (150, 115, 95)  # people, and their faces' colour
_GRAIN = 1.1  # pixels, over which a sensor's noise is smeared by demosaicing


def make_video(
    out: Path,
    frames: int = 600,
    size: int = 512,
    seed: int = 0,
    motion: Motion = "speech",
    outdoors: bool = False,
) -> Path:
    """Film `frames` pictures of `size` x `size` pixels of the person of `seed` and write them as H.264 to `out` (.mp4).

    `outdoors` is hard to matte: loose hair, before a background that moves.
    The same arguments give the same pictures before the encoder, and the same motion as `make_subject`, whose tracking is
    the truth for this video. The file appears when it is complete. Raises UserError for values out of range, and where
    `out` exists or has another suffix.
    """
    out = Path(out)
    if out.suffix.lower() != ".mp4":
        raise UserError(f"a video is written as .mp4, not as {out}")
    if out.exists():
        raise UserError(f"{out} exists; choose another name or remove it first")
    check_arguments(frames, size, seed, motion)
    with video_writer(out, FPS) as add:
        for picture in tqdm(filmed(frames, size, seed, motion, outdoors), total=frames, desc="filming", unit="frame"):
            add(picture)
    return out


def filmed(
    frames: int, size: int, seed: int, motion: Motion = "speech", outdoors: bool = False
) -> Iterator[np.ndarray]:
    """The pictures, uint8 [size, size, 3], before they are encoded."""
    renderer = Renderer(sample_identity(seed), has_loose_hair=outdoors)
    performance = perform(seed, frames, motion)
    with single_threads():
        drawn = rendered(renderer, performance, size)
        yield from in_room(((picture.image, picture.alpha) for _, _, picture in drawn), size, seed, outdoors)


def in_room(
    pictures: Iterable[tuple[np.ndarray, np.ndarray]], size: int, seed: int, outdoors: bool = False
) -> Iterator[np.ndarray]:
    """Pictures of the person of `seed` and their alpha, as a camera in the person's room would have taken them, or
    `outdoors`, where what is behind moves.

    All are uint8, `size` pixels wide and high; the pictures are over the person's own background, as the renderer and
    `make_subject` leave them.
    """
    own = background_of(sample_identity(seed), size, size)
    scenery = make_street(size, seed) if outdoors else itertools.repeat(make_room(size, seed))
    rng = np.random.default_rng((seed, 11))
    for (image, alpha), seen in zip(pictures, scenery, strict=False):
        # Where the person covers a part of a pixel, the renderer's own background is the rest of it.
        behind = 1.0 - alpha[..., None].astype(np.float32) / 255.0
        yield expose(image + behind * (seen - own), rng)


def expose(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """What a sensor makes of levels [H, W, 3]: noise that grows with the root of the light, smeared a little."""
    noise = rng.standard_normal(image.shape).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), 0.5 * _GRAIN) * np.float32(_GRAIN * np.sqrt(np.pi))
    strength = np.sqrt(READ_NOISE**2 + SHOT_NOISE**2 * np.maximum(image, 0.0) / 16.0)
    return np.clip(np.rint(image + noise * strength), 0, 255).astype(np.uint8)


def make_room(size: int, seed: int) -> np.ndarray:
    """What stands behind the person, out of focus: a wall, a window, shelves. Levels of 255, float32 [size, size, 3]."""
    rng = np.random.default_rng((seed, 12))
    wall = np.array([168, 160, 148]) * rng.uniform(0.6, 1.15) * (1 + 0.08 * rng.uniform(-1, 1, 3))
    y, x = (np.mgrid[0:size, 0:size] / size).astype(np.float32)
    room = wall * (0.75 + 0.35 * (x if rng.random() < 0.5 else 1 - x) - 0.15 * y)[..., None]
    room = room.astype(np.float32)

    def place(left: float, top: float, right: float, bottom: float, colour: np.ndarray) -> None:
        corners = [round(size * v) for v in (left, top, right, bottom)]
        room[max(0, corners[1]) : corners[3], max(0, corners[0]) : corners[2]] = colour

    left = rng.uniform(-0.1, 0.1) if rng.random() < 0.5 else rng.uniform(0.6, 0.8)
    place(left, -0.1, left + 0.32, rng.uniform(0.4, 0.6), np.array([225, 232, 240]) * rng.uniform(0.85, 1.05))
    shelf = 0.62 - left if left < 0.3 else 0.02
    for row in range(3):
        height = 0.08 + 0.24 * row + rng.uniform(-0.02, 0.02)
        place(shelf, height + 0.16, shelf + 0.36, height + 0.18, wall * 0.45)
        at = shelf
        while at < shelf + 0.33:
            width = rng.uniform(0.015, 0.05)
            colour = rng.uniform(30, 190, 3) * rng.uniform(0.5, 1.0)
            place(at, height + rng.uniform(0.0, 0.07), at + width, height + 0.16, colour)
            at += width
    return cv2.GaussianBlur(room, (0, 0), 0.012 * size)


def make_street(size: int, seed: int) -> Iterator[np.ndarray]:
    """What a hand-held camera sees outdoors behind the person, frame by frame without end: trees before the sky, which
    drift, and people who pass. Like `make_room`."""
    rng = np.random.default_rng((seed, 14))
    wide = round(_STREET * size)
    x = np.arange(wide) / wide
    leaves = cv2.GaussianBlur(rng.standard_normal((wide, wide)), (0, 0), 0.015 * size)
    tops = cv2.GaussianBlur(rng.standard_normal((1, wide)), (0, 0), 0.05 * size)
    street = np.empty((wide, wide, 3), np.float32)
    street[:] = np.array([226, 233, 240]) * (1.0 - 0.1 * x[:, None, None])
    is_tree = x[:, None] > rng.uniform(0.2, 0.5) + 0.1 * tops / tops.std()
    trees = rng.uniform((40, 55, 25), (95, 100, 60)) * np.exp(0.45 * leaves / leaves.std())[..., None]
    street[is_tree] = np.minimum(trees, 235.0)[is_tree]
    at, pace = rng.uniform(0.0, 1.0, _PASSING), rng.choice((-1, 1), _PASSING) * rng.uniform(0.003, 0.01, _PASSING)
    clothes = rng.uniform(30, 190, (_PASSING, 1)) * rng.uniform(0.7, 1.0, (_PASSING, 3))
    phase, speed = rng.uniform(0, 2 * np.pi, (2, 2)), rng.uniform(0.02, 0.07, (2, 2))
    for frame in itertools.count():
        picture = street.copy()
        for k in range(_PASSING):
            centre = round(wide * (1.3 * ((at[k] + frame * pace[k]) % 1.0) - 0.15))
            for y, across, high, colour in ((0.98, 0.09, 0.42, clothes[k]), (0.52, 0.035, 0.05, _SKIN)):
                axes = round(across * wide), round(high * wide)
                cv2.ellipse(picture, (centre, round(y * wide)), axes, 0, 0, 360, [float(c) for c in colour], -1)
        picture = cv2.GaussianBlur(picture, (0, 0), 0.012 * size)
        left, top = 0.5 * (wide - size) * (1.0 - 0.45 * np.sin(phase + frame * speed).sum(0))
        yield cv2.warpAffine(picture, np.array([[1, 0, -left], [0, 1, -top]]), (size, size))
