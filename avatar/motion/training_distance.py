"""How far each frame's expression is from those of the training, as a strip under a video and as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import UInt8

STRIP_SHARE = 0.16  # of the height of the picture above
LEAST_TOP = 1.5  # of the vertical axis, in multiples of the distance that counts as far
HIGHEST_TOP = 5.0  # beyond it the curve is cut
PAPER, GRID, INK, NEAR, FAR = (245,) * 3, (205,) * 3, (40,) * 3, (60, 110, 170), (200, 50, 40)  # RGB


class DistanceStrip:
    """Draws the curve once, and on it the place of each frame."""

    def __init__(self, distances: Sequence[float], width: int, picture_height: int) -> None:
        height = max(round(STRIP_SHARE * picture_height), 24)
        self._distances = distances
        self._top = min(max(LEAST_TOP, 1.1 * max(distances)), HIGHEST_TOP)
        self._width, self._height = width, height
        self._sheet = self._draw_curve()

    def frame(self, index: int) -> UInt8[np.ndarray, "H W 3"]:
        """The strip with a mark at this frame and its figure."""
        strip, distance = self._sheet.copy(), self._distances[index]
        x, y = self._place(index)
        colour = FAR if distance > 1.0 else NEAR
        cv2.line(strip, (x, 0), (x, self._height), GRID, 1)
        cv2.circle(strip, (x, y), max(2, self._height // 14), colour, cv2.FILLED, cv2.LINE_AA)
        scale = self._height / 110
        words = f"{distance:.2f}" + (" far from training" if distance > 1.0 else "")
        (text_width, text_height), _ = cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
        left = min(x + 6, self._width - text_width - 4)
        cv2.putText(strip, words, (left, text_height + 4), cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv2.LINE_AA)
        return strip

    def _place(self, index: int) -> tuple[int, int]:
        x = (index + 0.5) / len(self._distances) * (self._width - 1)
        y = (1.0 - min(self._distances[index], self._top) / self._top) * (self._height - 3) + 1
        return round(x), round(y)

    def _draw_curve(self) -> UInt8[np.ndarray, "H W 3"]:
        sheet = np.full((self._height, self._width, 3), PAPER, np.uint8)
        limit = round((1.0 - 1.0 / self._top) * (self._height - 3)) + 1
        cv2.line(sheet, (0, limit), (self._width, limit), GRID, 1)
        points = [self._place(i) for i in range(len(self._distances))]
        for i in range(len(points) - 1):
            far = max(self._distances[i], self._distances[i + 1]) > 1.0
            cv2.line(sheet, points[i], points[i + 1], FAR if far else NEAR, 1, cv2.LINE_AA)
        scale = self._height / 130
        note = "distance from the training expressions (line: 99% of them are nearer)"
        (text_width, _), _ = cv2.getTextSize(note, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
        scale *= min(1.0, 0.95 * self._width / text_width)
        cv2.putText(sheet, note, (4, self._height - 5), cv2.FONT_HERSHEY_SIMPLEX, scale, INK, 1, cv2.LINE_AA)
        return sheet


def distances_csv(names: Sequence[str], distances: Sequence[float]) -> str:
    """One line per frame: its number in the video, its name with the driver, its distance (above 1 is far)."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("frame", "name", "distance"))
    for index, (name, distance) in enumerate(zip(names, distances, strict=True)):
        writer.writerow((index, name, f"{distance:.4f}"))
    return text.getvalue()
