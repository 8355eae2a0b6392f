"""A trained avatar, opened from its file: what others build on (docs/api.md)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.config import Config
from avatar.data.recording import Recording
from avatar.errors import UserError
from avatar.files.environment import named_path
from avatar.files.third_party import HEAD_VARIABLE
from avatar.gaussians.base_model import Avatar
from avatar.head.assets import HeadAssets, load_head_assets
from avatar.motion.controls import ExpressionControl, expression_controls, fixed_controls, posed_by_name
from avatar.motion.neutral_pose import RestPose
from avatar.motion.orbit import OrbitLimits, orbit_limits, orbited
from avatar.motion.statistics import MotionStatistics, learn_statistics
from avatar.render import Renderer
from avatar.runs.avatar_file import AVATAR_FILE, build_avatar, read_avatar_file
from avatar.runs.check_inputs import check_pose, checked_camera, checked_params, checked_size
from avatar.splat import checked_drawings
from avatar.types import IDENTITY_6D, Camera, Gaussians, HeadParams, Rendering


@dataclass(frozen=True, repr=False)
class TrainedAvatar:
    """An avatar with everything that drawing and driving it needs; the video that it was trained on is not.

    Camera and parameters follow the conventions of `avatar.types`.
    """

    source: Path  # the file
    avatar: Avatar
    config: Config
    recording: Recording  # how its person moved in the training video
    neutral: RestPose
    step: int  # optimizer steps that it was trained for
    perceptual: str

    def __repr__(self) -> str:
        return (
            f"<avatar of {self.name}: {len(self.avatar):,} Gaussians ({self.config.model.name}), trained for "
            f"{self.step:,} steps on {len(self.recording.split.train)} frames, {self.source}>"
        )

    @property
    def name(self) -> str:
        return self.recording.name

    @property
    def assets(self) -> HeadAssets:
        return self.avatar.head.assets

    @property
    def background(self) -> Float[Tensor, " 3"]:
        """The colour that it was trained over."""
        return torch.tensor(self.config.data.background)

    @cached_property
    def renderer(self) -> Renderer:
        return Renderer(self.avatar, self.background)

    @cached_property
    def statistics(self) -> MotionStatistics:
        """Rests and expressions of the training frames."""
        return learn_statistics(self.recording.motion(self.recording.split.train), self.avatar.head, self.neutral)

    def rest_camera(self, size: int | None = None) -> Camera:
        """The camera of the neutral face, `size` pixels wide; by default as in training. Raises UserError for a size that
        is no whole number of pixels."""
        size = checked_size(size)
        train = self.recording.moments(self.recording.split.train)
        return self.recording.reference_camera(
            train[self.neutral.frame or 0], self.config.data.size if size is None else size
        )

    def rest_params(self) -> HeadParams:
        """The neutral face, looking ahead with open eyes."""
        rest = torch.tensor(IDENTITY_6D)
        jaw = self.neutral.jaw[:2].reshape(6)
        return HeadParams(self.neutral.expression, jaw, rest.repeat(2), torch.zeros(2), rest)

    def expression_controls(self) -> list[ExpressionControl]:
        """What moves the neutral face by hand, as far as the training frames do."""
        train = self.recording.times(self.recording.split.train)
        return expression_controls(
            self.recording.tracks["expression"][train], self.neutral.expression, self.avatar.head
        )

    def orbit_limits(self, rest: Camera) -> OrbitLimits:
        """How far the camera may turn from its place at rest."""
        return orbit_limits(rest, [self.recording.camera(i) for i in self.recording.split.train])

    def gaussians(self, params: HeadParams, camera: Camera | None = None) -> Gaussians:
        """The Gaussians of one frame, activated, world space (metres), as `camera` sees the head; by default turned as on
        average in training. To avatars without `model.head_rotation` it is the same. Raises UserError as `render`."""
        return self.renderer.gaussians(self._params(params), None if camera is None else checked_camera(camera))

    def render(self, params: HeadParams, camera: Camera | None = None) -> Rendering:
        """One picture, by default from the camera of the neutral face; [H, W, 3] and alpha [H, W], not clamped.

        Raises UserError, naming the tensor, for parameters or a camera of another type, shape or dtype, or not finite; and
        where nothing can be drawn, for which a GPU is waited for.
        """
        with checked_drawings():
            return self.renderer.render(
                self._params(params), self.rest_camera() if camera is None else checked_camera(camera)
            )

    def pose(
        self, *, yaw: float = 0.0, pitch: float = 0.0, zoom: float = 1.0, size: int | None = None, **values: float
    ) -> Rendering:
        """A picture of the neutral face with some values set: expressions by name, as far as training moved them, from the
        neutral one (smile_left=1; without names mouth_smile and the like, as in the viewer), jaw, look_down, look_left and,
        of the torso, lean and turn in radians, left_lid and right_lid from 0 to 1. The head is
        turned by `yaw` and `pitch` degrees.

        Raises UserError, with the names that there are, for another name and for a joint that moves no vertex of the head
        model; for values that are no numbers; for a size or zoom of no picture; and as `render`.
        """
        check_pose(zoom, yaw=yaw, pitch=pitch, **values)
        fixed = fixed_controls(self.assets.fixed_joints)
        params = posed_by_name(values, self.expression_controls(), self.rest_params(), fixed)
        return self.render(params, orbited(self.rest_camera(size), yaw, pitch, zoom))

    def _repr_png_(self) -> bytes:
        return self.render(self.rest_params()).png()

    def stream(self, motion: Iterable[HeadParams | tuple[HeadParams, Camera]]) -> Iterator[Rendering]:
        """Pictures in order, several drawn at a time; `motion` may be endless.

        Raises UserError as `render` does, when the frame's turn comes.
        """
        if not isinstance(motion, Iterable):
            raise UserError(f"a stream takes frames one after another, in a list or an iterator, not {motion!r:.60}")
        rest = self.rest_camera()
        return self.renderer.stream(self._frame(item, rest) for item in motion)

    def _frame(self, item: object, rest: Camera) -> tuple[HeadParams, Camera]:
        if isinstance(item, tuple) and len(item) == 2:
            return self._params(item[0]), checked_camera(item[1])
        return self._params(item), rest

    def _params(self, params: object) -> HeadParams:
        recorded = self.recording.tracks["expression"].shape[1]
        return checked_params(params, {recorded, self.assets.num_expressions})


def load_avatar(
    path: Path | str, head: Path | str | None = None, *, recorded_head: Path | None = None
) -> TrainedAvatar:
    """Open RUN/avatar.safetensors, or RUN, or a copy of the file anywhere.

    `head` is the FLAME-format head model, a file or folder; None takes the one packed into the file, else
    `recorded_head`, else $AVATAR_HEAD. Raises UserError when the file or the head model is missing, damaged, or the head
    model is another one than the avatar was trained with.
    """
    path = avatar_path(Path(path))
    content = read_avatar_file(path)
    if head is not None:
        assets = load_head_assets(Path(head))
    elif content.head is not None:
        assets = content.head
    else:
        assets = load_head_assets(_find_head(path, recorded_head))
    assets = replace(assets, names=content.names)
    return TrainedAvatar(
        source=path,
        avatar=build_avatar(content, assets, path),
        config=content.config,
        recording=content.recording,
        neutral=content.neutral,
        step=content.step,
        perceptual=content.perceptual,
    )


def avatar_path(path: Path) -> Path:
    """The avatar file of a run folder, or `path` itself. Raises UserError where a folder holds none."""
    if not path.is_dir():
        return path
    if not (path / AVATAR_FILE).is_file():
        if (path / "run.json").is_file():
            raise UserError(
                f"{path} holds no {AVATAR_FILE}: no checkpoint has been written yet; wait for the first where the training "
                "runs (trainer.checkpoint_every), else train again"
            )
        raise UserError(
            f"{path} is neither a run nor an avatar file; give the folder that avatar train wrote (--out), or its "
            f"{AVATAR_FILE}{runs_in(path)}"
        )
    return path / AVATAR_FILE


def runs_in(folder: Path) -> str:
    """The end of a sentence about a folder that is no run: which runs it holds."""
    runs = sorted(path.parent for pattern in ("*/run.json", "rounds/*/run/run.json") for path in folder.glob(pattern))
    return f"; {folder} holds {', '.join(map(str, runs[:3]))}{' ...' if len(runs) > 3 else ''}" if runs else ""


def _find_head(path: Path, recorded: Path | None) -> Path:
    if recorded is not None and recorded.exists():
        return recorded
    if named := named_path(HEAD_VARIABLE):
        return named
    gone = f" (that of the training, {recorded}, is gone)" if recorded is not None else ""
    raise UserError(
        f"{path} needs its head model{gone}: give --head PATH, or set {HEAD_VARIABLE}; avatar export --with-head makes "
        "files that hold it"
    )
