"""How far each frame's expression is from those of the training, as a strip under a video and as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import UInt8

CURVE_SHARE, WORDS_SHARE = 0.16, 0.05  # of the height of the picture above
LEAST_CURVE, LEAST_WORDS = 24, 14  # pixels
NOTE_SHARE = 0.62  # of the width, at most; the frame's figure stands to the right of it
NOTE = "distance from training (line: 99%)"
LEAST_TOP = 1.5  # of the vertical axis, in multiples of the distance that counts as far
HIGHEST_TOP = 5.0  # beyond it the curve is cut
Colour = tuple[int, ...]
FONT = cv2.FONT_HERSHEY_SIMPLEX
PAPER, GRID, INK, NEAR, FAR = (245,) * 3, (205,) * 3, (40,) * 3, (60, 110, 170), (200, 50, 40)  # RGB


class DistanceStrip:
    """A line of words over a curve, drawn once, and on it the place of each frame."""

    def __init__(self, distances: Sequence[float], width: int, picture_height: int) -> None:
        self._words = max(round(WORDS_SHARE * picture_height), LEAST_WORDS)
        self._height = max(round(CURVE_SHARE * picture_height), LEAST_CURVE)
        self._distances, self._width = distances, width
        self._top = min(max(LEAST_TOP, 1.1 * max(distances)), HIGHEST_TOP)
        self._sheet = self._draw_curve()

    def frame(self, index: int) -> UInt8[np.ndarray, "H W 3"]:
        """The strip with a mark at this frame and its figure."""
        strip, distance = self._sheet.copy(), self._distances[index]
        x, y = self._place(index)
        colour = FAR if distance > 1.0 else NEAR
        cv2.line(strip, (x, self._words), (x, len(strip)), GRID, 1)
        cv2.circle(strip, (x, y), max(2, self._height // 14), colour, cv2.FILLED, cv2.LINE_AA)
        scale, width = self._fitted(f"{distance:.2f}", (1 - NOTE_SHARE) * self._width)
        self._write(strip, f"{distance:.2f}", scale, self._width - width - 4, colour)
        return strip

    def _place(self, index: int) -> tuple[int, int]:
        x = (index + 0.5) / len(self._distances) * (self._width - 1)
        return round(x), self._row(self._distances[index])

    def _row(self, distance: float) -> int:
        return self._words + round((1.0 - min(distance, self._top) / self._top) * (self._height - 3)) + 1

    def _draw_curve(self) -> UInt8[np.ndarray, "H W 3"]:
        sheet = np.full((self._words + self._height, self._width, 3), PAPER, np.uint8)
        limit = self._row(1.0)
        cv2.line(sheet, (0, limit), (self._width, limit), GRID, 1)
        points = [self._place(i) for i in range(len(self._distances))]
        for i in range(len(points) - 1):
            far = max(self._distances[i], self._distances[i + 1]) > 1.0
            cv2.line(sheet, points[i], points[i + 1], FAR if far else NEAR, 1, cv2.LINE_AA)
        self._write(sheet, NOTE, self._fitted(NOTE, NOTE_SHARE * self._width)[0], 4, INK)
        return sheet

    def _fitted(self, words: str, room: float) -> tuple[float, int]:
        """The scale at which words fill the line's height, or the room where that is less; their width in pixels."""
        scale = self._words / 34
        width = cv2.getTextSize(words, FONT, scale, 1)[0][0]
        smaller = min(1.0, room / width)
        return scale * smaller, round(width * smaller)

    def _write(self, sheet: UInt8[np.ndarray, "H W 3"], words: str, scale: float, left: int, colour: Colour) -> None:
        cv2.putText(sheet, words, (left, self._words - self._words // 4), FONT, scale, colour, 1, cv2.LINE_AA)


def distances_csv(names: Sequence[str], distances: Sequence[float]) -> str:
    """One line per frame: its number in the video, its name with the driver, its distance (above 1 is far)."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("frame", "name", "distance"))
    for index, (name, distance) in enumerate(zip(names, distances, strict=True)):
        writer.writerow((index, name, f"{distance:.4f}"))
    return text.getvalue()
