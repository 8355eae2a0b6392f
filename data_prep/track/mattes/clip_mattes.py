"""The mattes of a clip: by a matting network, or by a segmentation network, what frames of the same pose agree on, the
colours at the person's edge, and what a still camera shows behind the person."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from avatar.files.third_party import MATTING_FILES, ThirdPartyFile
from avatar.files.write_image import write_image
from data_prep.progress import Progress
from data_prep.track.frames import Read, ahead, mask_file, write_masks
from data_prep.track.mattes import background_plate
from data_prep.track.mattes.alike_frames import ClipFrame, clip_frame, person_alone
from data_prep.track.mattes.matting_network import open_matting
from data_prep.track.mattes.refine_segmentation import sharpened
from data_prep.track.mattes.segmentation_network import open_segmentation

_TITLE = "making mattes"


def write_mattes(
    folder: Path,
    numbers: Sequence[int],
    image: Read,
    points: Callable[[int], np.ndarray],
    network: ThirdPartyFile,
    progress: Progress,
) -> None:
    """Of the frames with these numbers, in the order of their times; `points` are a face's, [L, 2] in pixels."""
    if network in MATTING_FILES:
        matte = open_matting(network)
        for number in progress(numbers, len(numbers), _TITLE):
            write_image(mask_file(folder, number), matte(image(number)))
        return
    own = threading.local()  # a network is for one thread

    def by_network(number: int) -> tuple[np.ndarray, np.ndarray]:
        if not hasattr(own, "matte"):
            own.matte = open_segmentation(network)
        picture = image(number)
        return picture, own.matte(picture)

    of_clip = numbers[:: -(-len(numbers) // background_plate.CLIP_FRAMES)]
    clip: list[ClipFrame] = []

    def looked_at() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for number, (picture, matte) in ahead(of_clip, by_network, progress, "looking at the background"):
            clip.append(clip_frame(number, matte, points(number)))
            yield picture, matte

    behind = background_plate.learn_plate(looked_at())

    def one(number: int) -> np.ndarray:
        picture, matte = by_network(number)
        return sharpened(picture, person_alone(number, matte, points(number), clip), points(number), behind)

    write_masks(folder, numbers, one, progress, _TITLE)
