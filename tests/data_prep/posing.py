"""A drawn face whose landmarks, scores and pictures a test chooses; MediaPipe is not needed."""

from __future__ import annotations

import cv2
import numpy as np

from data_prep.track.faces.detect import Face
from data_prep.track.faces.landmarks import BLENDSHAPES, NUM_POINTS

WIDTH, HEIGHT = 640, 480
TALL = 240.0  # pixels of the face


def posed(
    height: float = TALL, x: float = WIDTH / 2, y: float = 260.0, yaw: float = 0.0, pitch: float = 0.0, **scores: float
) -> Face:
    """A face centred there, turned to the person's left by `yaw` degrees and lifted by `pitch`."""
    rng = np.random.default_rng(0)
    shell = rng.normal(size=(NUM_POINTS, 3))
    shell *= np.array([0.4, 0.5, 0.4]) / np.linalg.norm(shell, axis=1, keepdims=True)
    shell[:, 2] = -np.abs(shell[:, 2])
    shell[[454, 234, 10, 152]] = [[0.4, 0, 0], [-0.4, 0, 0], [0, -0.5, 0], [0, 0.5, 0]]
    a, b = np.radians([yaw, pitch])
    about_y = np.array([[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(b), np.sin(b)], [0, -np.sin(b), np.cos(b)]])
    points = height * shell @ (about_y @ about_x).T + np.array([x, y, 0])
    values = np.zeros(len(BLENDSHAPES), np.float32)
    for name, value in scores.items():
        values[BLENDSHAPES.index(name)] = value
    return Face(points.astype(np.float32), values)


def picture(light: float = 1.0, blur: float = 0.0) -> np.ndarray:
    """With texture everywhere, grey levels of 50 to 200 times `light`."""
    noise = cv2.GaussianBlur(np.random.default_rng(1).normal(size=(HEIGHT, WIDTH)).astype(np.float32), (0, 0), 2.0)
    if blur:
        noise = cv2.GaussianBlur(noise, (0, 0), blur)
    grey = 125 + 25 * noise / noise.std()
    return np.repeat((light * grey.clip(50, 200))[..., None], 3, 2).clip(0, 255).astype(np.uint8)
