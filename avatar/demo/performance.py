"""What the demo person does: smooth random speech with blinks, saccades and head movement, as FLAME parameters.

Twenty-five frames a second. Everything is drawn from the seed; the tracking that is written is the motion itself.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d

from avatar.demo.head import JOINTS, NUM_EXPRESSION, demo_head
from avatar.types import IDENTITY_6D, Camera, HeadParams

Motion = Literal["speech", "turn", "gaze"]
MOTIONS: tuple[Motion, ...] = ("speech", "turn", "gaze")
FPS = 25.0
CAMERA_DISTANCE = 1.0  # metres
FIELD_OF_VIEW_HEIGHT = 0.37  # metres that the picture covers at the head
VIEW_HEIGHT = -0.014  # metres, y of the point of the head's space that is in the middle of the picture
FLIP = np.diag([1.0, -1.0, -1.0])  # head axes (y up, z forward) seen by an OpenCV camera in front of the face

# Shapes of the mouth that syllables go through: jaw opening in radians, and expression coefficients of both sides.
_VISEMES: tuple[tuple[float, dict[str, float]], ...] = (
    (0.190, {"lower_lip_down": 0.35, "upper_lip_up": 0.20}),  # a
    (0.095, {"stretch": 0.55, "smile": 0.35, "upper_lip_up": 0.35, "lower_lip_down": 0.45}),  # e
    (0.055, {"stretch": 0.65, "smile": 0.35, "lower_lip_down": 0.55, "upper_lip_up": 0.25}),  # i, s
    (0.125, {"funnel": 0.75, "pucker": 0.30}),  # o
    (0.060, {"pucker": 0.95, "funnel": 0.30}),  # u, w
    (0.000, {"lip_press": 0.75, "lip_roll_in": 0.30}),  # m, b, p
    (0.030, {"lip_roll_in": 0.25, "upper_lip_up": 0.40, "lower_lip_thrust": -0.5}),  # f, v
    (0.070, {"upper_lip_up": 0.20, "lower_lip_down": 0.25, "frown": 0.10}),  # l, n, d
)

# What "gaze" goes through: the eyes in degrees (to the subject's left, downwards), the lids (left, right; 1 is closed).
_LOOKS: tuple[tuple[float, float, float, float], ...] = (
    (32, 0, 0, 0),  # into the corners
    (-32, 0, 0, 0),
    (0, 20, 0, 0),  # down, with open lids
    (0, 0, 1, 0),  # winks
    (0, 0, 0, 1),
    (-22, 12, 0, 0),  # rolled
    (-26, -12, 0, 0),
    (0, -24, 0, 0),
    (26, -12, 0, 0),
    (22, 12, 0, 0),
    (0, 0, 0, 0),
)


class Performance(NamedTuple):
    """T frames; float64."""

    expression: np.ndarray  # [T, 100]
    jaw: np.ndarray  # [T] radians of opening
    gaze: np.ndarray  # [T, 2] radians: to the subject's left, and downwards
    eyelids: np.ndarray  # [T, 2] left, right; 1 is closed
    head: np.ndarray  # [T, 3] radians: yaw to the subject's left, pitch down, roll to the subject's right shoulder
    shift: np.ndarray  # [T, 3] metres that the head moves


def _drift(rng: np.random.Generator, frames: int, seconds: float, columns: int) -> np.ndarray:
    """Smooth noise [T, columns] of unit variance that changes over about `seconds`."""
    sigma = 0.5 * seconds * FPS
    pad = int(4 * sigma) + 1
    noise = gaussian_filter1d(rng.standard_normal((frames + 2 * pad, columns)), sigma, axis=0)
    return noise[pad : pad + frames] * np.sqrt(2.0 * np.sqrt(np.pi) * sigma)


def perform(seed: int, frames: int, motion: Motion, take: int = 0) -> Performance:
    """The motion of a seed, `frames` long; always the same for the same arguments. Every take is another one."""
    rng = np.random.default_rng((seed, 2, take) if take else (seed, 2))
    names = demo_head().expression_names
    expression = np.zeros((frames, NUM_EXPRESSION))

    def add(stem: str, values: np.ndarray) -> None:
        for i, name in enumerate(names):
            if name == stem or name in (f"{stem}_left", f"{stem}_right"):
                expression[:, i] += values

    jaw, mouth, talking = _speech(rng, frames)
    for stem, values in mouth.items():
        add(stem, values)
    mood = _drift(rng, frames, 5.0, 4)
    add("smile", 0.22 + 0.24 * np.clip(mood[:, 0], -0.9, 2.2))
    add("cheek_up", 0.35 * np.clip(mood[:, 0], 0.0, 2.2))
    add("squint", 0.25 * np.clip(mood[:, 1], 0.0, 2.0))
    for i, name in enumerate(names):  # no face is symmetric
        if name.startswith(("smile", "brow_outer", "upper_lip", "cheek_up")):
            expression[:, i] *= 1.0 + 0.22 * np.sin(1.7 * seed + (1.0 if name.endswith("left") else -1.0))
    brows = np.clip(_drift(rng, frames, 0.9, 2) - 0.45, 0.0, 2.2) * (0.35 + 0.65 * talking[:, None])
    add("brow_inner_up", 0.55 * brows[:, 0])
    add("brow_outer_up", 0.60 * brows[:, 0])
    add("brow_down", np.clip(0.60 * brows[:, 1] - 0.6 * brows[:, 0], 0.0, 1.2))
    add("mouth_left", 0.18 * _drift(rng, frames, 1.5, 1)[:, 0] * talking)
    add("sneer", 0.2 * np.clip(_drift(rng, frames, 0.8, 1)[:, 0] - 0.8, 0.0, 1.5))

    head = _head_turns(rng, frames, motion, talking)
    gaze, blink_with_gaze = _gaze(rng, frames, head)
    lids = _blinks(rng, frames, blink_with_gaze)
    if motion == "gaze":
        gaze, lids = _looks(rng, frames)
    shift = _drift(rng, frames, 3.0, 3) * np.array([0.004, 0.002, 0.006])
    return Performance(np.clip(expression, -1.2, 1.6), jaw, gaze, lids, head, shift)


def _speech(rng: np.random.Generator, frames: int) -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]:
    """Jaw [T], mouth coefficients {stem: [T]} and how much the person is talking [T]: phrases of syllables, and pauses."""
    jaw, talking = np.zeros(frames), np.zeros(frames)
    stems = sorted({stem for _, shape in _VISEMES for stem in shape})
    mouth = {stem: np.zeros(frames) for stem in stems}
    clock = np.arange(frames) / FPS
    now = rng.uniform(-1.0, 0.3)
    while now < clock[-1] + 0.5:
        phrase_end = now + rng.uniform(1.4, 4.2)
        talking += np.clip((clock - now) / 0.15, 0, 1) * np.clip((phrase_end - clock) / 0.15, 0, 1)
        while now < phrase_end:
            width = rng.uniform(0.055, 0.095)  # seconds, of the syllable's Gaussian
            weight = np.exp(-0.5 * ((clock - now) / width) ** 2)
            opening, shape = _VISEMES[rng.choice(len(_VISEMES), p=(0.20, 0.14, 0.13, 0.12, 0.10, 0.13, 0.06, 0.12))]
            strength = rng.uniform(0.65, 1.15)
            jaw += weight * opening * strength
            for stem, value in shape.items():
                mouth[stem] += weight * value * strength
            now += rng.uniform(0.11, 0.24)
        now += rng.uniform(0.25, 1.1)
    rest = 0.018 * (1.0 + np.clip(_drift(rng, frames, 2.0, 1)[:, 0], -1.0, 2.0))
    return np.clip(jaw + rest * (mouth["lip_press"] < 0.25), 0.0, 0.42), mouth, np.clip(talking, 0.0, 1.0)


def _head_turns(rng: np.random.Generator, frames: int, motion: Motion, talking: np.ndarray) -> np.ndarray:
    slow = np.tanh(0.8 * _drift(rng, frames, 2.4, 3)) * np.radians([15.0, 6.5, 4.5])
    quick = _drift(rng, frames, 0.45, 3) * talking[:, None] * np.radians([1.0, 1.5, 0.8])
    if motion != "turn":
        return slow + quick
    clock = np.arange(frames) / FPS
    phase, period = rng.uniform(0, 2 * np.pi), rng.uniform(5.5, 7.5)
    turn = np.sin(2 * np.pi * clock / period + phase)
    sweep = np.stack(
        (0.70 * np.sign(turn) * np.abs(turn) ** 0.8, 0.16 * np.sin(2 * np.pi * clock / (2.7 * period)), 0 * turn), -1
    )
    return sweep + slow * np.array([0.15, 0.6, 0.8]) + quick


def _gaze(rng: np.random.Generator, frames: int, head: np.ndarray) -> tuple[np.ndarray, list[int]]:
    """Gaze [T, 2], and the frames of large saccades, with which people often blink."""
    target, now, large = np.zeros((frames, 2)), 0, []
    aim = np.zeros(2)
    while now < frames:
        hold = int(rng.uniform(0.35, 2.0) * FPS)
        new = rng.normal(0.0, 1.0, 2) * np.radians([8.0, 4.0]) if rng.random() < 0.6 else np.zeros(2)
        if np.linalg.norm(new - aim) > np.radians(11.0):
            large.append(now)
        aim = new
        target[now : now + hold] = aim
        now += hold
    jumps = gaussian_filter1d(target, 0.55, axis=0, mode="nearest")
    # The eyes keep towards the camera while the head turns.
    gaze = jumps - 0.55 * head[:, :2]
    return np.clip(gaze, np.radians([-26.0, -14.0]), np.radians([26.0, 16.0])), large


def _blinks(rng: np.random.Generator, frames: int, with_gaze: list[int]) -> np.ndarray:
    shape = np.array([0.25, 0.8, 1.0, 0.92, 0.62, 0.34, 0.14, 0.04])
    starts = [f for f in with_gaze if rng.random() < 0.4]
    now = rng.uniform(0.3, 2.5)
    while now * FPS < frames:
        starts.append(int(now * FPS))
        now += rng.uniform(1.8, 4.5)
    lids = np.zeros(frames + len(shape))
    for start in starts:
        lids[start : start + len(shape)] = np.maximum(lids[start : start + len(shape)], shape)
    tired = np.clip(0.10 + 0.05 * _drift(rng, frames, 3.0, 2), 0.0, 0.22)
    return np.clip(lids[:frames, None] + tired * (1 - lids[:frames, None]), 0.0, 1.0)


def _looks(rng: np.random.Generator, frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Gaze [T, 2] and lids [T, 2] of eyes that go through `_LOOKS`, each for 0.12 to 0.32 seconds."""
    holds = rng.integers(3, 9, frames)
    looks = np.repeat(np.resize(np.array(_LOOKS, float), (frames, 4)), holds, axis=0)[:frames]
    looks = gaussian_filter1d(looks, 0.55, axis=0, mode="nearest")
    return np.radians(looks[:, :2]), looks[:, 2:]


def _rotation(axis: int, angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    R = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R[i, i], R[i, j], R[j, i], R[j, j] = c, -s, s, c
    return R


def _six(R: np.ndarray) -> np.ndarray:
    return R[:2].reshape(-1)


def frame_params(performance: Performance, frame: int) -> HeadParams:
    """FLAME parameters of one frame; the neck is at rest, since the head's pose is in the camera."""
    eye = _six(_rotation(1, performance.gaze[frame, 0]) @ _rotation(0, performance.gaze[frame, 1]))

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, np.float32))

    return HeadParams(
        expression=tensor(performance.expression[frame]),
        jaw=tensor(_six(_rotation(0, performance.jaw[frame]))),
        eyes=tensor(np.concatenate((eye, eye))),
        eyelids=tensor(performance.eyelids[frame]),
        neck=torch.tensor(IDENTITY_6D),
    )


def frame_camera(performance: Performance, frame: int, size: int) -> Camera:
    """The camera of one frame, `size` pixels square: the head turns about the base of its neck, so the camera does."""
    yaw, pitch, roll = performance.head[frame]
    R_head = _rotation(1, yaw) @ _rotation(0, pitch) @ _rotation(2, roll)
    pivot = JOINTS[0]
    middle = np.array([0.0, VIEW_HEIGHT, 0.0])
    # head space -> turned about the pivot and shifted -> seen from in front
    R = FLIP @ R_head
    t = FLIP @ (pivot - R_head @ pivot + performance.shift[frame] - middle) + np.array([0.0, 0.0, CAMERA_DISTANCE])
    focal = size * CAMERA_DISTANCE / FIELD_OF_VIEW_HEIGHT
    return Camera(
        R_cam_world=torch.from_numpy(R.astype(np.float32)),
        t_cam_world=torch.from_numpy(t.astype(np.float32)),
        fx=focal,
        fy=focal,
        cx=size / 2,
        cy=size / 2,
        width=size,
        height=size,
    )
