"""The camera's focal length: given, from the video's metadata, or assumed. Landmarks cannot tell it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from avatar.errors import UserError
from data_prep.track.faces.landmark_groups import LEFT_IRIS, RIGHT_IRIS

FILM_DIAGONAL = math.hypot(36.0, 24.0)  # millimetres; "equivalent" focal lengths compare diagonals (CIPA DCG-001)
ASSUMED_EQUIVALENT = 28.0  # millimetres: telephones and webcams have 23 to 32
PUPIL_DISTANCE = 0.063  # metres, of adults
NEAREST = 0.6  # metres: a face that seems nearer than an arm is long is a part of a larger picture,
CROPPED = 0.9  # and was filmed from 0.6 to 1.5 metres away, or farther


class Focal(NamedTuple):
    pixels: float  # of the upright source pictures
    source: str  # how it is known, for the user
    is_assumed: bool


def choose_focal(
    width: int,
    height: int,
    points: Float[np.ndarray, "T 478 3"],
    given: float | None = None,
    field_of_view: float | None = None,
    equivalent: float | None = None,
) -> Focal:
    """The focal length in pixels of pictures of `width` x `height`, in which the face has these landmarks.

    `given` pixels or `field_of_view` degrees across the width win over the metadata's `equivalent` millimetres; without
    any, that of a telephone is assumed, or the one at which the face is `CROPPED` away where it would seem nearer than
    `NEAREST`: such a video was cut out of a larger one. Raises UserError for values that no camera has.
    """
    diagonal = math.hypot(width, height)
    if given is not None:
        if not (math.isfinite(given) and 0.2 * diagonal < given < 100 * diagonal):
            raise UserError(f"--focal must be in pixels of the video ({width}x{height}), not {given:g}")
        return Focal(float(given), "given with --focal", False)
    if field_of_view is not None:
        if not (math.isfinite(field_of_view) and 1.0 <= field_of_view <= 150.0):
            raise UserError(f"--fov must be from 1 to 150 degrees across the width of the video, not {field_of_view:g}")
        pixels = 0.5 * width / math.tan(math.radians(field_of_view) / 2)
        return Focal(pixels, f"from the field of view of {field_of_view:g} degrees", False)
    if equivalent is not None:
        return Focal(equivalent / FILM_DIAGONAL * diagonal, f"from the metadata ({equivalent:g} mm equivalent)", False)
    pixels = ASSUMED_EQUIVALENT / FILM_DIAGONAL * diagonal
    words = f"assumed: a lens of {ASSUMED_EQUIVALENT:g} mm equivalent"
    if len(points):
        # Turned heads show their eyes closer together; the widest tenth is seen from the front.
        eyes = np.linalg.norm(points[:, LEFT_IRIS, :2] - points[:, RIGHT_IRIS, :2], axis=1)
        per_metre = float(np.percentile(eyes, 90)) / PUPIL_DISTANCE  # pixels of focal length, for a metre of distance
        if NEAREST * per_metre > pixels:
            pixels, words = CROPPED * per_metre, f"assumed: the face is {CROPPED:g} m away"
    return Focal(pixels, words, True)
