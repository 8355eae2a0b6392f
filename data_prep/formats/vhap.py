"""VHAP's export, the data format of GaussianAvatars: one person, one or several cameras.

    FOLDER/transforms_{train,val,test}.json   or one transforms.json
    FOLDER/images/00000_00.png                `file_path`: timestep and camera
    FOLDER/fg_masks/00000_00.png              `fg_mask_path`: foreground matte, if there is one
    FOLDER/flame_param/00000.npz              `flame_param_path`: one timestep's FLAME parameters

An entry has `transform_matrix` (the camera in the world, OpenGL axes) and intrinsics, its own or shared (`fl_x`, `fl_y`,
`cx`, `cy`, `w`, `h`, or `camera_angle_x`, `camera_angle_y`); `cy` is counted from the bottom of the picture. `camera_id` or
`camera_index` says which camera. A parameter file has `translation`, `rotation`, `neck_pose`, `jaw_pose` [3], `eyes_pose`
[6] as rotation vectors, `expr`, `shape` and perhaps `static_offset` [V, 3], whatever further axes of length 1. There are no
eyelids: they are zero, except where `avatar track` adds `eyelids` [2]. The static offset moves the root joint; else it is
not used: the Gaussians learn where they belong.

A UNION folder holds listings alone, of frames in the sequences' folders beside it (`../SEQUENCE/images/...`). Each of these
has a world of its own and may have an identity of its own; that of the first frame is used for all.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from avatar.data.split import evenly_spread
from avatar.errors import UserError
from avatar.files.names import natural_order
from avatar.files.pickles import load_npz
from avatar.head.assets import HeadAssets
from avatar.head.model import NECK, ROOT
from data_prep.formats.frame_files import FrameFiles, KindNames, transparent
from data_prep.formats.frame_track import BadFrame, FrameTrack, Tracking, read_frames, vector
from data_prep.formats.root_pose import Joint, camera_of_head, rotation_matrix, six_d, turned_with_neck
from data_prep.formats.tracked_folder import Shot, TrackedFolder, existing, listings_of, matte_notes
from data_prep.formats.train_test_split import ALL, chosen_cameras
from data_prep.formats.transforms import (
    OPENCV_FROM_OPENGL,
    ListedFrame,
    camera_pose,
    frame_rate,
    is_union,
    numbered,
    pinhole,
    spaced,
)

NAME = "VHAP"
NAMES = KindNames("fg_masks/", "head masks", "mouth masks", images="images/", tracking="flame_param/")
FRONTAL_FRAMES = 8  # by which the front camera is found


def recognise(frames: list[ListedFrame]) -> bool:
    return any("flame_param_path" in frame.values for frame in frames[:1])


def open_folder(folder: Path, frames: list[ListedFrame], cameras: str = ALL) -> TrackedFolder:
    """`cameras` is "all", "front" or names between commas.

    Raises UserError for paths outside the folder, frames without parameters, and cameras that there are not.
    """
    frames, notes = _chosen(frames, cameras, folder)
    listed = numbered(frames)
    parameters = {number: _parameter_file(frame) for number, frame in listed.items()}
    images = {number: frame.image for number, frame in listed.items()}
    shots = _shots(listed, parameters)
    mattes = existing({number: frame.path("fg_mask_path") for number, frame in listed.items()})
    files = FrameFiles(
        folder=folder.parent if is_union(folder) else folder,
        images=images,
        alphas=mattes or transparent(images),
        tracking=parameters,
        listings=listings_of(frames),
        names=NAMES,
    )

    def read(head: HeadAssets, size: tuple[int, int], complain: Callable[[str], object]) -> Tracking:
        joints = Joint(head, ROOT), Joint(head, NECK)
        read_file = lru_cache(maxsize=1)(_parameters)  # the frames of one time share a file
        of = {number: shot.camera for number, shot in shots.items()} or None
        tracking = read_frames(
            listed,
            lambda frame: _read_frame(frame, read_file(_parameter_file(frame)), joints, size),
            parameters,
            complain,
            of,
        )
        return _one_identity(tracking) if is_union(folder) else tracking

    fps, fps_notes = frame_rate(frames)
    notes = (*notes, *matte_notes(files), *fps_notes)
    return TrackedFolder(NAME, files, read, {n: frame.split for n, frame in listed.items()}, notes, fps, shots=shots)


def _parameter_file(frame: ListedFrame) -> Path:
    path = frame.path("flame_param_path")
    if path is None:
        raise UserError(f"{frame.listing}: frame {frame.position} has no flame_param_path; export the folder again")
    return path


def _read_frame(
    frame: ListedFrame, raw: dict[str, np.ndarray], joints: tuple[Joint, Joint], size: tuple[int, int]
) -> FrameTrack:
    root, neck = joints

    def values(key: str, count: int | None = None) -> np.ndarray:
        if key not in raw:
            raise BadFrame(f"{key} is missing in {_parameter_file(frame).name}")
        return vector(raw[key], key, count)

    expression, shape = values("expr"), values("shape")
    offset = None
    if "static_offset" in raw and raw["static_offset"].size:
        offset = _static_offset(values("static_offset"), root.num_vertices, _parameter_file(frame).name)
    R_cam_world, t_cam_world = _opencv_pose(frame)
    torso = camera_of_head(
        R_cam_world,
        t_cam_world,
        rotation_matrix(values("rotation", 3)),
        values("translation", 3),
        root.position(shape, expression, offset),
    )
    neck_pose = values("neck_pose", 3)
    R, t = turned_with_neck(torso, neck_pose, neck.position(shape, None, offset))
    intrinsics, tracked_size = pinhole(frame, size)
    intrinsics[3] = tracked_size[1] - intrinsics[3]
    return FrameTrack(
        expression=expression,
        jaw=six_d(values("jaw_pose", 3)),
        eyes=six_d(values("eyes_pose", 6)),
        eyelids=values("eyelids", 2) if "eyelids" in raw else np.zeros(2),
        neck=six_d(neck_pose),
        R=R,
        t=t,
        shape=shape,
        intrinsics=intrinsics,
        size=tracked_size,
    )


def _static_offset(values: np.ndarray, vertices: int, file: str) -> np.ndarray:
    """[at least `vertices`, 3]; the tracker's head may have teeth after the vertices of the head model."""
    if len(values) % 3:
        raise BadFrame(f"static_offset in {file} has {len(values)} values, not three for each vertex")
    given = len(values) // 3
    if not vertices <= given < 2 * vertices:
        raise BadFrame(
            f"static_offset in {file} has {given} vertices and the head model {vertices}; give --head the model that the "
            "tracking was made with"
        )
    return values.reshape(-1, 3)


def _parameters(file: Path) -> dict[str, np.ndarray]:
    try:
        return load_npz(file)
    except UserError as error:
        raise BadFrame(str(error).removeprefix(f"{file} ")) from None


def _opencv_pose(frame: ListedFrame) -> tuple[np.ndarray, np.ndarray]:
    R, t = camera_pose(frame)
    return OPENCV_FROM_OPENGL @ R, OPENCV_FROM_OPENGL @ t


def _by_camera(frames: list[ListedFrame]) -> dict[str, list[ListedFrame]]:
    """The frames of each camera, by its name, in the order in which the cameras come."""
    by_camera: dict[str, list[ListedFrame]] = {}
    for frame in frames:
        by_camera.setdefault(_camera(frame), []).append(frame)
    return by_camera


def _chosen(frames: list[ListedFrame], cameras: str, folder: Path) -> tuple[list[ListedFrame], tuple[str, ...]]:
    """The frames of the chosen cameras, and a note where these are not all."""
    by_camera = _by_camera(frames)
    chosen, notes = chosen_cameras(cameras, by_camera, lambda: _front(by_camera), folder)
    return [frame for frame in frames if _camera(frame) in chosen], notes


def _camera(frame: ListedFrame) -> str:
    return str(frame.values.get("camera_id", frame.values.get("camera_index")))


def _shots(listed: dict[int, ListedFrame], parameters: dict[int, Path]) -> dict[int, Shot]:
    """Camera and time of each frame; empty where there is one camera. The frames of one parameter file are of one time.

    Raises UserError for two frames of one camera at one time.
    """
    times, seen = _times(parameters), {}
    shots: dict[int, Shot] = {}
    for number, frame in listed.items():
        path = parameters[number]
        shot = Shot(_camera(frame), times[path])
        if shot in seen:
            raise UserError(
                f"{frame.listing}: {listed[seen[shot]].image.name} and {frame.image.name} are both of camera "
                f"{shot.camera} with {path.name}; each needs a camera_id or camera_index, or a parameter file, of its own"
            )
        seen[shot] = number
        shots[number] = shot
    return shots if len({shot.camera for shot in seen}) > 1 else {}


def _times(parameters: dict[int, Path]) -> dict[Path, int]:
    """The time of each parameter file: sequences as they come, the files of one in the order of their names."""
    files = dict.fromkeys(parameters.values())
    folders = {folder: place for place, folder in enumerate(dict.fromkeys(file.parent for file in files))}
    ordered = sorted(files, key=lambda file: (folders[file.parent], natural_order(file.name)))
    return dict(zip(ordered, spaced(ordered), strict=True))


def _one_identity(tracking: Tracking) -> Tracking:
    """With the identity of the first frame in all: each sequence of a UNION set was tracked by itself."""
    if not tracking.frames:
        return tracking
    first = next(iter(tracking.frames.values())).shape
    same = {number: replace(track, shape=first) for number, track in tracking.frames.items()}
    changed = any(not np.array_equal(track.shape, first) for track in tracking.frames.values())
    notes = ["the sequences have an identity each: that of the first is used for all"] if changed else []
    return replace(tracking, frames=same, notes=[*tracking.notes, *notes])


def _front(by_camera: dict[str, list[ListedFrame]]) -> str:
    """The camera that sees the face most from the front, among those with training frames."""
    trained = {name: own for name, own in by_camera.items() if any(frame.split in ("train", None) for frame in own)}
    candidates = trained or by_camera

    def facing(name: str) -> float:
        own = candidates[name]
        return float(np.mean([_frontality(own[i]) for i in evenly_spread(range(len(own)), FRONTAL_FRAMES)]))

    return max(candidates, key=facing)


def _frontality(frame: ListedFrame) -> float:
    """Cosine of the angle between where the face looks and where its camera is; -2 where the frame is unusable."""
    try:
        rotation = vector(_parameters(_parameter_file(frame)).get("rotation", ()), "rotation", 3)
        R, _ = _opencv_pose(frame)
    except BadFrame:
        return -2.0
    return float(-(R @ rotation_matrix(rotation))[2, 2])
