"""The tracking of INSTA's published archives, which is only in their meshes. Never tried on a real archive.

    FOLDER/canonical.obj          the person at rest, with the vertices of every mesh
    FOLDER/meshes/00000.obj       `mesh_path`: FLAME's vertices in metres, with jaw, eyes, eyelids and expression
    FOLDER/flame/exp/00000.txt    `exp_path`: the expression's coefficients; expected where there are as many as the model's

`transform_matrix` is the camera in the meshes' space. A head's pose inside the mesh is moved into the camera. The neck is
at rest, as metrical-tracker's is.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from avatar.data.split import evenly_spread
from avatar.errors import UserError
from avatar.files.read import is_there, read_text
from avatar.head.assets import HeadAssets
from avatar.head.model import FLAME_PARENTS
from avatar.types import IDENTITY_6D
from data_prep.formats.frame_track import BadFrame, FrameTrack, Tracking, read_frames, vector
from data_prep.formats.mesh_fit import LEAST_SIGMA, Identity, Mesh, fit_identity, fit_pose, start
from data_prep.formats.mesh_head import HeadRows, MeshPose
from data_prep.formats.mesh_rows import FITTED, match, spread
from data_prep.formats.obj_mesh import read_mesh, read_vertices
from data_prep.formats.transforms import ListedFrame, camera_pose, pinhole

CANONICAL = "canonical.obj"
MOST_OFF = 2e-3  # metres, root mean square, of a mesh that the head model can be
SAMPLES, POSED = 12, 800  # meshes that tell the identity; vertices that tell a pose
_MOST_TEXT = 2**16
_ADVICE = "give --head the model that the meshes were made with, or --tracking"


def mesh_paths(listed: dict[int, ListedFrame]) -> dict[int, Path]:
    """Of the frames that name one; empty where no file is there. Raises UserError for paths outside the folder."""
    paths = {number: path for number, frame in listed.items() if (path := frame.path("mesh_path")) is not None}
    return paths if any(is_there(path) for path in paths.values()) else {}


def read_meshes(
    folder: Path,
    listed: dict[int, ListedFrame],
    head: HeadAssets,
    size: tuple[int, int],
    complain: Callable[[str], object],
) -> Tracking:
    """Fit the head model to every mesh; those that are missing, damaged or another head's end up in `bad`.

    size  width, height of the images

    Calls `complain` for a canonical.obj or a head model that is not that of the meshes.
    """
    paths = mesh_paths(listed)
    try:
        clip = _Clip(folder, listed, head, size)
    except UserError as error:
        complain(str(error))
        return Tracking({}, dict.fromkeys(paths, "the meshes' identity is not known"), [], paths)
    tracking = read_frames({number: number for number in paths}, clip.read, paths, complain)
    if clip.off:
        mean, most = 1e3 * np.mean(clip.off), 1e3 * max(clip.off)
        tracking.notes.append(
            f"the tracking is fitted to the meshes, whose vertices it misses by {mean:.2g} mm in the mean frame and "
            f"{most:.2g} mm in the worst"
        )
        if (moved := (clip.identity.weights < 0.5).mean()) > 0.01:
            tracking.notes.append(f"{moved:.0%} of the meshes' vertices are not where the head model can have them")
    return tracking


class _Clip:
    """What the meshes share, and the fit of each, which starts where the last one ended."""

    def __init__(self, folder: Path, listed: dict[int, ListedFrame], head: HeadAssets, size: tuple[int, int]) -> None:
        if head.parents != FLAME_PARENTS:
            raise UserError(
                f"the head model's joints do not hang together as FLAME's, as the meshes of {folder} take it"
            )
        self.listed, self.size, self.expressions = listed, size, head.num_expressions
        self.paths = mesh_paths(listed)
        self.expected = {number: frame.path("exp_path") for number, frame in listed.items()}
        self.count: int | None = None
        sample = self._sample(folder)
        self.reference, rows = _reference(folder / CANONICAL, self.paths[next(iter(sample))], head)
        self.count = len(rows)
        shared = spread(self.count, FITTED)
        sample = {number: points for number, points in sample.items() if len(points) == self.count}
        meshes = [self._mesh(number, points[shared]) for number, points in sample.items()]
        if not meshes:
            raise UserError(f"no mesh of {folder} has the {self.count} vertices of {self.reference}; copy them again")
        found = _one_identity(HeadRows(head, rows[shared]), meshes)
        if found.sigma > MOST_OFF:
            raise UserError(f"the head model misses the meshes of {folder} by {1e3 * found.sigma:.2g} mm; {_ADVICE}")
        chosen = spread(len(shared), POSED)
        self.picked = shared[chosen]
        self.identity = found._replace(weights=found.weights[chosen])
        self.rows = HeadRows(head, rows[self.picked]).with_identity(found.coefficients)
        self.last: MeshPose | None = None
        self.off: list[float] = []  # metres, of each mesh that was read

    def read(self, number: int) -> FrameTrack:
        """Raises BadFrame for a mesh that is missing, damaged or not of this head, and for a frame without a camera."""
        frame, path = self.listed[number], self.paths[number]
        R, t = camera_pose(frame)
        intrinsics, size = pinhole(frame, self.size)
        mesh = self._mesh(number, self._points(path)[self.picked])
        pose, off = self._fit(mesh)
        if off > MOST_OFF:
            raise BadFrame(f"the head model misses {path.name} by {1e3 * off:.2g} mm")
        self.last = pose
        self.off.append(off)
        return FrameTrack(
            expression=pose.expression,
            jaw=pose.turns[0, :2].ravel(),
            eyes=pose.turns[1:, :2].ravel(),
            eyelids=pose.eyelids,
            neck=np.array(IDENTITY_6D),
            R=R @ pose.R,
            t=R @ pose.t + t,
            shape=self.identity.coefficients,
            intrinsics=intrinsics,
            size=size,
        )

    def _fit(self, mesh: Mesh) -> tuple[MeshPose, float]:
        found = None if self.last is None else fit_pose(self.rows, self.identity, mesh, self.last)
        if found is None or found[1] > MOST_OFF:
            found = fit_pose(self.rows, self.identity, mesh, start(self.rows, mesh))
        return found

    def _points(self, path: Path) -> np.ndarray:
        points = read_vertices(path)
        if self.count is not None and len(points) != self.count:
            raise BadFrame(f"{path.name} has {len(points)} vertices, but {self.reference} has {self.count}")
        return points

    def _mesh(self, number: int, points: np.ndarray) -> Mesh:
        path = self.expected[number]
        return Mesh(points, None if path is None else _coefficients(path, self.expressions))

    def _sample(self, folder: Path) -> dict[int, np.ndarray]:
        """The vertices of meshes from all parts of the clip."""
        numbers, found, reason = list(self.paths), {}, ""
        for number in evenly_spread(numbers, SAMPLES):
            try:
                found[number] = self._points(self.paths[number])
            except BadFrame as error:
                reason = str(error)
        if not found:
            raise UserError(f"none of the meshes of {folder} that were tried can be used: {reason}")
        return found


def _reference(canonical: Path, first: Path, head: HeadAssets) -> tuple[str, np.ndarray]:
    """Which rows of the model the meshes have, and the name of the file that says so."""
    path = canonical if is_there(canonical) else first
    try:
        points, faces = read_mesh(path)
        if path == first and len(points) != head.num_vertices:
            raise BadFrame(
                f"does not exist: it says which of the head model's vertices {first.name} has; copy it there"
            )
        return path.name, match(head, points, faces)
    except BadFrame as error:
        raise UserError(f"{canonical}: {error}") from None
    except UserError as error:
        raise UserError(f"{path} {error}") from None


def _one_identity(rows: HeadRows, meshes: list[Mesh]) -> Identity:
    """Without meshes that are not of the same head as most."""
    found, poses = fit_identity(rows, meshes)
    own = rows.with_identity(found.coefficients)
    off = np.array([fit_pose(own, found, mesh, pose)[1] for mesh, pose in zip(meshes, poses, strict=True)])
    kept = [mesh for mesh, o in zip(meshes, off, strict=True) if o <= max(3 * np.median(off), LEAST_SIGMA)]
    return found if len(kept) == len(meshes) else fit_identity(rows, kept)[0]


def _coefficients(path: Path, count: int) -> np.ndarray | None:
    """None where the file is not there or holds something else: then nothing is expected."""
    try:
        return vector(np.array(read_text(path, _MOST_TEXT).split(), np.float64), path.name, count)
    except (UserError, BadFrame, ValueError):
        return None
