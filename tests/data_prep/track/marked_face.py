"""A face that tests find without MediaPipe: a red crown and a blue chin on grey, and a detector that sees them."""

from __future__ import annotations

import cv2
import numpy as np

from data_prep.track.faces.detect import Face

WIDTH, HEIGHT = 160, 120
CROWN, CHIN = (70, 20), (70, 80)  # x, y of the upright picture
MIDDLE, AXES = (70, 50), (22, 32)


def picture(shift: int = 0) -> np.ndarray:
    image = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    for (x, y), colour in ((CROWN, (255, 0, 0)), (CHIN, (0, 0, 255))):
        cv2.circle(image, (x + shift, y), 4, colour, -1)
    return image


def matte(shift: int = 0) -> np.ndarray:
    """255 on head and body."""
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.ellipse(mask, (MIDDLE[0] + shift, MIDDLE[1]), (AXES[0] + 4, AXES[1] + 4), 0, 0, 360, 255, -1)
    mask[95:, 30:110] = 255
    return mask


class MarkDetector:
    """Stands in for `FaceDetector`. As MediaPipe's, it takes a face that is upside down for an upright one."""

    def __enter__(self) -> MarkDetector:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def anywhere(self, image: np.ndarray) -> Face | None:
        crown, chin = (_centre(image, channel) for channel in (0, 2))
        if crown is None or chin is None:
            return None
        if crown[1] > chin[1] + abs(crown[0] - chin[0]):
            crown, chin = chin, crown
        return face_between(crown, chin)

    def find(self, image: np.ndarray, begins_shot: bool = False) -> list[Face]:
        face = self.anywhere(image)
        return [] if face is None else [face]


def face_between(crown: np.ndarray, chin: np.ndarray) -> Face:
    points = np.zeros((478, 3), np.float32)
    down, middle = chin - crown, (crown + chin) / 2
    across = np.array([down[1], -down[0]])
    angles = np.linspace(0, 2 * np.pi, 478)
    points[:, :2] = middle + 0.5 * np.cos(angles)[:, None] * down + 0.36 * np.sin(angles)[:, None] * across
    points[10, :2], points[152, :2] = crown, chin
    points[468, :2], points[473, :2] = middle - 0.2 * across, middle + 0.2 * across
    return Face(points, np.zeros(52, np.float32))


def _centre(image: np.ndarray, channel: int) -> np.ndarray | None:
    others = image[..., [c for c in range(3) if c != channel]].max(axis=2)
    rows, columns = np.nonzero((image[..., channel] > 180) & (others < 80))
    return np.array([columns.mean() + 0.5, rows.mean() + 0.5]) if len(rows) else None
