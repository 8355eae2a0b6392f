"""Pictures of an evaluated frame: render and truth as protocols compare them, and panels for people."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import cv2
import numpy as np
import torch
from jaxtyping import UInt8

from avatar.compute.device import to_device
from avatar.data.colours import Colour
from avatar.data.frame import Frame
from avatar.evaluation.measure import Pair, as_seen
from avatar.evaluation.protocol import ImageFormat
from avatar.files.video import ERROR_SCALE, error_map, grid, side_by_side
from avatar.files.write_image import encode_image
from avatar.render import Renderer
from avatar.splat import checked_drawings

SHEET_COLUMNS = 2
SHEET_WIDTH = 1600  # pixels at most


def draw(renderer: Renderer, frame: Frame, formats: Iterable[ImageFormat]) -> dict[ImageFormat, Pair]:
    """Render and truth of a frame for each format, where the avatar is; those of one background share the drawing."""
    device = renderer.background.device
    gaussians = renderer.gaussians(frame.params, frame.camera)
    images: dict[Colour, Pair] = {}
    pairs = {}
    for image_format in formats:
        if image_format.background not in images:
            colour = torch.tensor(image_format.background)
            with checked_drawings():
                picture = renderer.draw(gaussians, frame.camera, to_device(colour, device))
            images[image_format.background] = Pair(picture.image, to_device(frame.composite(colour), device))
        pairs[image_format] = Pair(*(as_seen(image, image_format) for image in images[image_format.background]))
    return pairs


def panel(
    pair: Pair, captions: tuple[str, str] = ("truth", "render"), rows: int = 0
) -> UInt8[np.ndarray, "H_panel W_panel 3"]:
    """Truth, render and error map side by side under captions, of at least `rows` pixels' height."""
    render, truth = (image.cpu() / 255.0 if image.dtype == torch.uint8 else image.cpu() for image in pair)
    images = (truth, render, error_map(render, truth))
    return side_by_side(images, (*captions, f"error, 0 to {ERROR_SCALE:g}"), rows)


def contact_sheet(panels: Sequence[UInt8[np.ndarray, "H W 3"]]) -> bytes:
    """Panels in two columns, row by row, as a PNG file."""
    sheet = grid(panels, SHEET_COLUMNS)
    if sheet.shape[1] > SHEET_WIDTH:
        height = round(sheet.shape[0] * SHEET_WIDTH / sheet.shape[1])
        sheet = cv2.resize(sheet, (SHEET_WIDTH, height), interpolation=cv2.INTER_AREA)
    return encode_image(sheet)
