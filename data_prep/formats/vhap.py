"""VHAP's export, the data format of GaussianAvatars.

    FOLDER/transforms_{train,val,test}.json   or one transforms.json
    FOLDER/images/00000_00.png                `file_path`: timestep and camera
    FOLDER/fg_masks/00000_00.png              `fg_mask_path`: foreground matte, if there is one
    FOLDER/flame_param/00000.npz              `flame_param_path`: one timestep's FLAME parameters

An entry has `transform_matrix` (the camera in the world, OpenGL axes) and intrinsics, its own or shared (`fl_x`, `fl_y`,
`cx`, `cy`, `w`, `h`, or `camera_angle_x`); `cy` is counted from the bottom of the picture. A parameter file has
`translation`, `rotation`, `neck_pose`, `jaw_pose` [3], `eyes_pose` [6] as rotation vectors, `expr`, `shape` and perhaps
`static_offset` [V, 3], whatever further axes of length 1. There are no eyelids: they are zero. The static offset is not
used: the Gaussians learn where they belong.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from avatar.errors import UserError
from avatar.files.pickles import load_npz
from avatar.head.assets import HeadAssets
from data_prep.formats.frame_files import FrameFiles, KindNames, transparent
from data_prep.formats.frame_track import BadFrame, FrameTrack, Tracking, vector
from data_prep.formats.root_pose import RootJoint, camera_of_head, rotation_matrix, six_d
from data_prep.formats.tracked_folder import TrackedFolder, existing, listings_of, matte_notes, numbered
from data_prep.formats.transforms import (
    OPENCV_FROM_OPENGL,
    ListedFrame,
    camera_pose,
    frame_rate,
    pinhole,
    read_frames,
)

NAME = "VHAP"
NAMES = KindNames("fg_masks/", "head masks", "mouth masks", images="images/", tracking="flame_param/")


def recognise(frames: list[ListedFrame]) -> bool:
    return any("flame_param_path" in frame.values for frame in frames[:1])


def open_folder(folder: Path, frames: list[ListedFrame]) -> TrackedFolder:
    """Raises UserError for paths outside the folder and for frames without parameters."""
    frames, notes = _one_camera(frames)
    listed = numbered(frames)
    parameters = {number: _parameter_file(frame) for number, frame in listed.items()}
    images = {number: frame.image for number, frame in listed.items()}
    mattes = existing({number: frame.path("fg_mask_path") for number, frame in listed.items()})
    files = FrameFiles(
        folder=folder,
        images=images,
        alphas=mattes or transparent(images),
        head_masks={},
        mouth_masks={},
        tracking=parameters,
        listings=listings_of(frames),
        names=NAMES,
    )

    def read(head: HeadAssets, size: tuple[int, int], complain: Callable[[str], object]) -> Tracking:
        root = RootJoint(head)
        return read_frames(listed, parameters, lambda frame: _read_frame(frame, root, size), complain)

    fps, fps_notes = frame_rate(frames)
    notes = (*notes, *matte_notes(files), *fps_notes)
    return TrackedFolder(NAME, files, read, {n: frame.split for n, frame in listed.items()}, notes, fps)


def _parameter_file(frame: ListedFrame) -> Path:
    path = frame.path("flame_param_path")
    if path is None:
        raise UserError(f"{frame.listing}: frame {frame.position} has no flame_param_path; export the folder again")
    return path


def _read_frame(frame: ListedFrame, root: RootJoint, size: tuple[int, int]) -> FrameTrack:
    raw = _parameters(frame)

    def values(key: str, count: int | None = None) -> np.ndarray:
        if key not in raw:
            raise BadFrame(f"{key} is missing in {_parameter_file(frame).name}")
        return vector(raw[key], key, count)

    expression, shape = values("expr"), values("shape")
    R_cam_world, t_cam_world = _opencv_pose(frame)
    R, t = camera_of_head(
        R_cam_world,
        t_cam_world,
        rotation_matrix(values("rotation", 3)),
        values("translation", 3),
        root.position(shape, expression),
    )
    intrinsics, tracked_size = pinhole(frame, size)
    intrinsics[3] = tracked_size[1] - intrinsics[3]
    return FrameTrack(
        expression=expression,
        jaw=six_d(values("jaw_pose", 3)),
        eyes=six_d(values("eyes_pose", 6)),
        eyelids=np.zeros(2),
        neck=six_d(values("neck_pose", 3)),
        R=R,
        t=t,
        shape=shape,
        intrinsics=intrinsics,
        size=tracked_size,
    )


def _parameters(frame: ListedFrame) -> dict[str, np.ndarray]:
    file = _parameter_file(frame)
    try:
        return load_npz(file)
    except UserError as error:
        raise BadFrame(str(error).removeprefix(f"{file} ")) from None


def _opencv_pose(frame: ListedFrame) -> tuple[np.ndarray, np.ndarray]:
    R, t = camera_pose(frame)
    return OPENCV_FROM_OPENGL @ R, OPENCV_FROM_OPENGL @ t


def _one_camera(frames: list[ListedFrame]) -> tuple[list[ListedFrame], tuple[str, ...]]:
    """The frames of the camera that sees the face most from the front: the method is for one moving picture."""
    by_camera: dict[str, list[ListedFrame]] = {}
    for frame in frames:
        by_camera.setdefault(str(frame.values.get("camera_id", frame.values.get("camera_index"))), []).append(frame)
    if len(by_camera) == 1:
        return frames, ()
    trained = {name: own for name, own in by_camera.items() if any(frame.split in ("train", None) for frame in own)}
    candidates = trained or by_camera
    best = max(candidates, key=lambda name: _frontality(candidates[name][0]))
    note = f"the folder has {len(by_camera)} cameras; camera {best}, which sees the face most from the front, is used"
    return by_camera[best], (note,)


def _frontality(frame: ListedFrame) -> float:
    """Cosine of the angle between where the face looks and where its camera is; -2 where the frame is unusable."""
    try:
        rotation = vector(_parameters(frame).get("rotation", ()), "rotation", 3)
        R, _ = _opencv_pose(frame)
    except BadFrame:
        return -2.0
    return float(-(R @ rotation_matrix(rotation))[2, 2])
