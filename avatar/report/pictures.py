"""The pictures of a report: held-out frames."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from avatar.data.loader import FrameLoader
from avatar.data.split import evenly_spread
from avatar.evaluation.draw import panel
from avatar.evaluation.measure import Pair
from avatar.render import Renderer
from avatar.runs.run import Run
from avatar.splat import checked_drawings

MAX_FRAMES = 40
MAX_PANEL_WIDTH = 1080  # pixels of truth, render and error side by side; 40 of them stay under 5 MB


def frame_panels(run: Run) -> list[tuple[str, np.ndarray]]:
    """(name, truth | render | error as uint8 [h, w, 3]) of at most `MAX_FRAMES` held-out frames, spread over them.

    Driven by what the tracker left, where the tracking was refined.
    """
    subject = run.subject.as_tracked()
    background = torch.tensor(run.config.data.background)
    renderer = Renderer(run.avatar, background)
    panels = []
    with FrameLoader(subject, run.config.data.size) as loader:
        for frame in loader.frames(evenly_spread(subject.split.test, MAX_FRAMES)):
            with checked_drawings():
                render = renderer.render(frame.params, frame.camera).image.clamp(0, 1).cpu()
            image = panel(Pair(render, frame.composite(background)))
            if image.shape[1] > MAX_PANEL_WIDTH:
                height = round(image.shape[0] * MAX_PANEL_WIDTH / image.shape[1])
                image = cv2.resize(image, (MAX_PANEL_WIDTH, height), interpolation=cv2.INTER_AREA)
            panels.append((frame.name, image))
    return panels
