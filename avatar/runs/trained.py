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
from avatar.files.places import named_path
from avatar.head.assets import HeadAssets, load_head_assets
from avatar.model import Avatar
from avatar.motion.repertoire import Repertoire, learn_repertoire
from avatar.motion.rest import RestPose
from avatar.render import Renderer
from avatar.runs.avatar_file import AVATAR_FILE, build_avatar, read_portrait
from avatar.types import IDENTITY_6D, Camera, Gaussians, HeadParams, Rendering

HEAD_VARIABLE = "AVATAR_HEAD"


@dataclass(frozen=True)
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

    @property
    def name(self) -> str:
        return self.recording.name

    @property
    def assets(self) -> HeadAssets:
        return self.avatar.head.assets

    @property
    def background(self) -> Float[Tensor, 3]:
        """The colour that it was trained over."""
        return torch.tensor(self.config.data.background)

    @cached_property
    def renderer(self) -> Renderer:
        return Renderer(self.avatar, self.background)

    @cached_property
    def repertoire(self) -> Repertoire:
        """Rests and expressions of the training frames."""
        return learn_repertoire(self.recording.motion(self.recording.split.train), self.avatar.head, self.neutral)

    def rest_camera(self, size: int | None = None) -> Camera:
        """The camera of the neutral face, `size` pixels wide; by default as in training."""
        train = self.recording.split.train
        return self.recording.camera(train[self.neutral.frame or 0], size or self.config.data.size)

    def rest_params(self) -> HeadParams:
        """The neutral face, looking ahead with open eyes."""
        rest = torch.tensor(IDENTITY_6D)
        jaw = self.neutral.jaw[:2].reshape(6)
        return HeadParams(self.neutral.expression, jaw, rest.repeat(2), torch.zeros(2), rest)

    def gaussians(self, params: HeadParams, camera: Camera | None = None) -> Gaussians:
        """The Gaussians of one frame, activated, world space (metres), as `camera` sees the head; by default turned as on
        average in training. To avatars without `model.facing` it is the same."""
        return self.renderer.gaussians(params, camera)

    def render(self, params: HeadParams, camera: Camera | None = None) -> Rendering:
        """One picture, by default from the camera of the neutral face; [H, W, 3] and alpha [H, W], not clamped."""
        return self.renderer.render(params, camera or self.rest_camera())

    def stream(self, motion: Iterable[HeadParams | tuple[HeadParams, Camera]]) -> Iterator[Rendering]:
        """Pictures in order, several drawn at a time; `motion` may be endless."""
        rest = self.rest_camera()
        return self.renderer.stream((item, rest) if isinstance(item, HeadParams) else item for item in motion)


def load_avatar(
    path: Path | str, head: Path | str | None = None, *, recorded_head: Path | None = None
) -> TrainedAvatar:
    """Open RUN/avatar.safetensors, or RUN, or a copy of the file anywhere.

    `head` is the FLAME-format head model, a file or folder; None takes the one packed into the file, else
    `recorded_head`, else $AVATAR_HEAD. Raises UserError when the file or the head model is missing, damaged, or the head
    model is another one than the avatar was trained with.
    """
    path = avatar_path(Path(path))
    portrait = read_portrait(path)
    if head is not None:
        assets = load_head_assets(Path(head))
    elif portrait.head is not None:
        assets = portrait.head
    else:
        assets = load_head_assets(_find_head(path, recorded_head))
    assets = replace(assets, names=portrait.names)
    return TrainedAvatar(
        source=path,
        avatar=build_avatar(portrait, assets, path),
        config=portrait.config,
        recording=portrait.recording,
        neutral=portrait.neutral,
        step=portrait.step,
        perceptual=portrait.perceptual,
    )


def avatar_path(path: Path) -> Path:
    """The avatar file of a run folder, or `path` itself. Raises UserError where a folder holds none."""
    if not path.is_dir():
        return path
    if not (path / AVATAR_FILE).is_file():
        if (path / "run.json").is_file():
            raise UserError(
                f"{path} holds no {AVATAR_FILE}: no checkpoint has been written yet, or another version of the program "
                "made the run; train it (further) with this one"
            )
        raise UserError(
            f"{path} is neither a run nor an avatar file; give the folder that avatar train wrote (--out), or its "
            f"{AVATAR_FILE}"
        )
    return path / AVATAR_FILE


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
