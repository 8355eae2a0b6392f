"""IMavatar's (and PointAvatar's) data format.

    FOLDER/flame_params.json                  or FOLDER/{train,test}/flame_params.json, or transforms_{train,test}.json
    FOLDER/image/1.png                        `file_path`, with or without suffix, relative to the listing
    FOLDER/mask/1.png                         foreground matte, if there is one
    FOLDER/semantic/1.png                     class numbers of the face parsing network, if there are any

Shared values: `shape_params`, and `intrinsics` = -fx, fy, cx, cy in units of the image's width and height (pixels of a
512x512 image in an older form, which has cy > 1). An entry has `expression`, `pose` = 15 rotation-vector values of root,
neck, jaw, left and right eye, and `world_mat` [3, 4], from a world in which FLAME's head is four times its size to a
camera with OpenGL's axes. There are no eyelids: they are zero.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from avatar.head.assets import HeadAssets
from avatar.head.model import NECK, ROOT
from data_prep.formats.frame_files import FrameFiles, KindNames, transparent
from data_prep.formats.frame_track import BadFrame, FrameTrack, Tracking, nearest_rotation, read_frames
from data_prep.formats.root_pose import Joint, camera_of_head, rotation_matrix, six_d, turned_with_neck
from data_prep.formats.tracked_folder import TrackedFolder, existing, listings_of, matte_notes
from data_prep.formats.transforms import OPENCV_FROM_OPENGL, ListedFrame, frame_rate, numbered

NAME = "IMavatar"
NAMES = KindNames("mask/", "semantic/", "semantic/", images="image/", tracking="flame_params.json")
WORLD_SCALE = 4.0  # "the FLAME head is centered at the origin, scaled by 4 times"
_OLD_SIZE = 512.0


def recognise(frames: list[ListedFrame]) -> bool:
    return any({"expression", "pose", "world_mat"} <= frame.values.keys() for frame in frames[:1])


def open_folder(folder: Path, frames: list[ListedFrame]) -> TrackedFolder:
    """Raises UserError for paths outside the folder."""
    listed = numbered(frames)
    images = {number: frame.image for number, frame in listed.items()}
    files = FrameFiles(
        folder=folder,
        images=images,
        alphas=existing({number: _beside(path, "mask") for number, path in images.items()}) or transparent(images),
        tracking={number: frame.listing for number, frame in listed.items()},
        parsing=existing({number: _beside(path, "semantic") for number, path in images.items()}),
        listings=listings_of(frames),
        names=NAMES,
    )

    def read(head: HeadAssets, size: tuple[int, int], complain: Callable[[str], object]) -> Tracking:
        root, neck = Joint(head, ROOT), Joint(head, NECK)
        return read_frames(listed, lambda frame: _read_frame(frame, root, neck, size), files.tracking, complain)

    fps, fps_notes = frame_rate(frames)
    notes = (*matte_notes(files), *fps_notes)
    return TrackedFolder(NAME, files, read, {n: frame.split for n, frame in listed.items()}, notes, fps)


def _beside(image: Path, kind: str) -> Path:
    """`image/1.png` -> `mask/1.png`."""
    return image.parent.parent / kind / f"{image.stem}.png"


def _read_frame(frame: ListedFrame, root: Joint, neck: Joint, size: tuple[int, int]) -> FrameTrack:
    expression, shape = frame.numbers("expression"), frame.numbers("shape_params")
    pose = frame.numbers("pose", 15)
    world_mat = frame.numbers("world_mat", 12).reshape(3, 4)
    torso = camera_of_head(
        OPENCV_FROM_OPENGL @ nearest_rotation(world_mat[:, :3], "world_mat"),
        OPENCV_FROM_OPENGL @ world_mat[:, 3] / WORLD_SCALE,
        rotation_matrix(pose[:3]),
        np.zeros(3),
        root.position(shape, expression),
    )
    R, t = turned_with_neck(torso, pose[3:6], neck.position(shape))
    return FrameTrack(
        expression=expression,
        neck=six_d(pose[3:6]),
        jaw=six_d(pose[6:9]),
        eyes=six_d(pose[9:]),
        eyelids=np.zeros(2),
        R=R,
        t=t,
        shape=shape,
        intrinsics=_intrinsics(frame, size),
        size=size,
    )


def _intrinsics(frame: ListedFrame, size: tuple[int, int]) -> np.ndarray:
    """fx, fy, cx, cy in pixels [4]."""
    fx, fy, cx, cy = frame.numbers("intrinsics", 4)
    if fx == 0 or fy <= 0:
        raise BadFrame("intrinsics has no positive focal lengths")
    unit = np.array([*size, *size]) / (_OLD_SIZE if cy > 1 else 1.0)
    return np.array([abs(fx), fy, cx, cy]) * unit  # x is mirrored there, because the camera looks along -z
