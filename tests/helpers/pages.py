"""What tests see of an avatar's page, whose AvatarView is the page's `avatar`."""

from __future__ import annotations

import io
import json
import time
from typing import Any

import imageio.v3 as iio
import numpy as np
import torch


def shown(page: Any) -> torch.Tensor:
    """The canvas as values in [0, 1]."""
    data = page.evaluate("avatar.screenshot().then(b => b.arrayBuffer()).then(b => Array.from(new Uint8Array(b)))")
    return torch.from_numpy(iio.imread(io.BytesIO(bytes(data)))[..., :3].astype(np.float32) / 255)


def until(page: Any, expression: str, seconds: float = 20.0) -> None:
    """Playwright's own waiting evaluates text inside the page, which the page's security policy forbids."""
    end = time.monotonic() + seconds
    while not page.evaluate(expression):
        assert time.monotonic() < end, f"never: {expression}"
        page.wait_for_timeout(20)


def says(page: Any, sentence: str, seconds: float = 20.0) -> None:
    """Wait for a sentence of the camera's card."""
    until(page, f"document.getElementById('camera-said').textContent.includes({json.dumps(sentence)})", seconds)
