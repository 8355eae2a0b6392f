"""The mattes of a clip by a network, the colours at the person's edge, and what a still camera shows behind the person."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import UInt8

from data_prep.progress import Progress
from data_prep.track import background_plate
from data_prep.track.frames import Read, ahead
from data_prep.track.matting import open_matter, sharpened


def clip_matter(
    numbers: Sequence[int], image: Read, points: Callable[[int], np.ndarray], progress: Progress
) -> Callable[[int], UInt8[np.ndarray, "H W"]]:
    """What makes the matte of a frame by its number; `points` are its face's, [L, 2] in pixels."""
    own = threading.local()  # a network is for one thread

    def by_network(number: int) -> tuple[np.ndarray, np.ndarray]:
        if not hasattr(own, "matter"):
            own.matter = open_matter()
        picture = image(number)
        return picture, own.matter(picture)

    of_clip = numbers[:: -(-len(numbers) // background_plate.CLIP_FRAMES)]
    behind = background_plate.learn_plate(
        pair for _, pair in ahead(of_clip, by_network, progress, "looking at the background")
    )
    return lambda number: sharpened(*by_network(number), points(number), behind)
