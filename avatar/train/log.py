"""What a run shows while it works: a progress bar, preview images and curves."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from avatar.files.atomic import write_atomically
from avatar.files.write_image import encode_image
from avatar.losses.metrics import psnr
from avatar.losses.photometric import PhotometricLoss
from avatar.runs.training_curves import LOSSES, read_curves, write_curves
from avatar.tensors import to_8_bit

LOG_EVERY = 10  # steps between points of the training curves
SMOOTHING = 0.98  # of the loss and PSNR that the progress bar shows


class TrainingLog:
    """Writes RUN/curves.csv and RUN/previews; a context manager, so that an interruption still ends the bar."""

    def __init__(self, run: Path, start: int, stop: int) -> None:
        self._run, self._previews = run, run / "previews"
        self._rows = [tuple(row) for row in read_curves(run) if row[0] <= start]
        self._bar = tqdm(total=stop, initial=start, unit="step", desc="train", dynamic_ncols=True)
        self._loss = self._psnr = math.nan

    def __enter__(self) -> TrainingLog:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def step(self, step: int, loss: PhotometricLoss, render: Tensor, truth: Tensor) -> None:
        """Record one step; `step` counts from 1. The PSNR is computed only for the steps that are logged."""
        total, terms, quality = float(loss.total.detach()), {}, math.nan
        if self.shows(step):
            terms, quality = (
                {name: float(term.detach()) for name, term in loss._asdict().items()},
                float(psnr(render, truth)),
            )
        self.note(step, total, terms, quality)

    def shows(self, step: int) -> bool:
        """Whether the curves have a point at `step`."""
        return step % LOG_EVERY == 0

    def note(self, step: int, total: float, terms: Mapping[str, float], quality: float) -> None:
        """Record the numbers of a step; all but the total count at those steps only that the curves show."""
        self._loss = smoothed(self._loss, total, 1)
        self._bar.update(1)
        if self.shows(step):
            self._psnr = smoothed(self._psnr, quality, LOG_EVERY)
            self._rows.append((step, quality, *(terms[name] for name in LOSSES)))
        shown = {"loss": f"{self._loss:.5f}"}
        if not math.isnan(self._psnr):  # none is measured before the first step that is logged
            shown["psnr"] = f"{self._psnr:.2f}"
        self._bar.set_postfix(shown, refresh=False)

    def save(self) -> None:
        """Write the curves. Raises UserError when the disk refuses."""
        write_curves(self._run, self._rows)

    def say(self, news: str) -> None:
        """Above the bar, and where it is."""
        self._bar.write(news, file=sys.stderr)

    def preview(self, step: int, truth: Tensor, render: Tensor) -> None:
        """The truth beside the render of one held-out frame, [H, W, 3] each."""
        image = to_8_bit(torch.cat((truth, render), dim=1)).cpu().numpy()
        self._previews.mkdir(parents=True, exist_ok=True)
        write_atomically(self._previews / f"step_{step:08d}.png", encode_image(image))


def smoothed(mean: float, value: float, steps: int) -> float:
    """The running mean after a value that stands for `steps` steps; the first value stands for itself."""
    keep = SMOOTHING**steps
    return value if math.isnan(mean) else keep * mean + (1 - keep) * value
