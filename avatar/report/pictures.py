"""The pictures of a report: held-out frames, and how sure the avatar is of each of its Gaussians."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from avatar.data.loader import FrameLoader
from avatar.evaluation.draw import panel
from avatar.evaluation.measure import Pair
from avatar.gaussians.uv import painted
from avatar.render import Renderer
from avatar.runs.run import Run

MAX_FRAMES = 40
MAX_PANEL_WIDTH = 1080  # pixels of truth, render and error side by side; 40 of them stay under 5 MB
UNCERTAINTY_GAIN = 2.5  # of the paper's figures: sigmoid(2.5 u)


def frame_panels(run: Run) -> list[tuple[str, np.ndarray]]:
    """(name, truth | render | error as uint8 [h, w, 3]) of at most `MAX_FRAMES` held-out frames, spread over them.

    Driven by what the tracker left, where the tracking was refined.
    """
    subject = run.subject.as_tracked()
    test = subject.split.test
    chosen = [test[i * len(test) // min(MAX_FRAMES, len(test))] for i in range(min(MAX_FRAMES, len(test)))]
    background = torch.tensor(run.config.data.background)
    renderer = Renderer(run.avatar, background)
    panels = []
    with FrameLoader(subject, run.config.data.size) as loader:
        for frame in loader.frames(chosen):
            render = renderer.render(frame.params, frame.camera).image.clamp(0, 1).cpu()
            image = panel(Pair(render, frame.composite(background)))
            if image.shape[1] > MAX_PANEL_WIDTH:
                height = round(image.shape[0] * MAX_PANEL_WIDTH / image.shape[1])
                image = cv2.resize(image, (MAX_PANEL_WIDTH, height), interpolation=cv2.INTER_AREA)
            panels.append((frame.name, image))
    return panels


def uncertainty_map(run: Run) -> np.ndarray | None:
    """sigmoid(2.5 u) of each Gaussian at its texel of the UV map, uint8 [S, S, 3]; None without HyperGaussians.

    u is the log-determinant of the conditional covariance, summed over the heads (HyperGaussians, supplement, eq. 3):
    0, the colour of 0.5, at the start of training.
    """
    hyper, texels = run.avatar.hyper, run.avatar.embedding.texels
    if hyper is None:
        return None
    with torch.no_grad():
        values = torch.sigmoid(UNCERTAINTY_GAIN * hyper.uncertainty()).cpu().numpy()
    colours = cv2.applyColorMap(np.round(values * 255).astype(np.uint8)[:, None], cv2.COLORMAP_VIRIDIS)[:, 0, ::-1]
    image, covered = painted(texels, colours)
    image[~covered] = 255
    size = len(image)
    return cv2.resize(image, None, fx=max(1, 512 // size), fy=max(1, 512 // size), interpolation=cv2.INTER_NEAREST)
