"""The mattes of one camera of a rig: head and neck without clothes, as VHAP's export has them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from avatar.data.read_image import read_image, read_mask
from avatar.files.third_party import ThirdPartyFile
from avatar.head.assets import HeadAssets
from avatar.head.model import HeadModel
from data_prep.formats.avatar_track import FRAMES, MATTE
from data_prep.formats.frame_track import FrameTrack
from data_prep.prepare.projection import project_head
from data_prep.progress import Progress
from data_prep.track.faces.embedding import LandmarkEmbedding
from data_prep.track.frames import Read, frame_file, mask_file, write_masks
from data_prep.track.masks.clothes import CLIP_FRAMES, Colours, learn_colours
from data_prep.track.masks.head_and_mouth import head_mask, neck_ring
from data_prep.track.masks.neck_zones import Zones, zones_of
from data_prep.track.mattes.clip_mattes import write_mattes


class MatteClip(NamedTuple):
    numbers: Sequence[int]  # of the frames
    image: Read
    screen: Callable[[int], np.ndarray]  # of a frame's number: the posed vertices [V, 3], in pixels


def front_colours(folder: Path, tracks: Mapping[int, FrameTrack], model: HeadModel) -> Colours | None:
    """The colours of clothes, skin and hair, in the front camera's tracked folder: from aside less of them is sure."""
    faces = model.faces.numpy()
    ring = neck_ring(model.assets.template.numpy(), faces)

    def zones(number: int) -> Zones:
        image, track = read_image(frame_file(folder / FRAMES, number)), tracks[number]
        screen = project_head(model, track, track.intrinsics, *track.size)
        return zones_of(image, read_mask(mask_file(folder / MATTE, number)), screen, faces, ring)

    numbers = list(tracks)
    return learn_colours(map(zones, numbers[:: -(-len(numbers) // CLIP_FRAMES)]))


def write_head_mattes(
    folder: Path,
    clip: MatteClip,
    head: HeadAssets,
    colours: Colours | None,
    embedding: LandmarkEmbedding,
    network: ThirdPartyFile,
    progress: Progress,
) -> None:
    """Mattes that lie in `folder` are cut to the head; where there are none they are made."""
    numbers, image, screen = clip
    faces = head.faces.numpy()
    ring = neck_ring(head.template.numpy(), faces)

    def points(number: int) -> np.ndarray:
        return np.einsum("lk,lkc->lc", embedding.barycentric, screen(number)[embedding.corners, :2])

    if not mask_file(folder, numbers[0]).is_file():
        write_mattes(folder, numbers, image, points, network, progress)

    def one(number: int) -> np.ndarray:
        picture, matte = image(number), read_mask(mask_file(folder, number))
        made = head_mask(picture, matte, zones_of(picture, matte, screen(number), faces, ring), colours)
        return np.minimum(matte, made.mask)

    write_masks(folder, numbers, one, progress, "cutting mattes to the head")
