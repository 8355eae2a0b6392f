"""What the viewer shows, as a function of what is set: no server, no clock."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from avatar.files.video import error_map, fitted
from avatar.head.rasterize import rasterize_mesh
from avatar.motion.controls import JOINT_FIELD, joint_ranges, joint_values, posed
from avatar.motion.orbit import orbited
from avatar.runs.motion_clip import Clip
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.splat import checked_drawings
from avatar.tensors import to_8_bit
from avatar.types import Camera, HeadParams, Rendering

Overlay = Literal["none", "mesh", "error"]
OVERLAYS: tuple[Overlay, ...] = ("none", "mesh", "error")
MARGIN = 10.0  # degrees by which the camera may leave what the training video shows
ZOOM = (0.5, 4.0)
LINES = (30, 200, 120)  # RGB of the mesh


@dataclass(frozen=True)
class ViewOffset:
    """How the camera is turned away from that of the frame: degrees, and a factor."""

    yaw: float = 0.0
    pitch: float = 0.0
    zoom: float = 1.0


@dataclass(frozen=True)
class Setting:
    """All that a person has set, but the frame of a motion that is shown."""

    look: ViewOffset = ViewOffset()
    expressions: Mapping[int, float] = field(default_factory=dict)  # number of a control -> how far
    joints: Mapping[str, float] = field(default_factory=dict)
    overlay: Overlay = "none"
    with_truth: bool = False


class ViewRenderer:
    """An avatar with its controls, their ranges and the pictures that it was trained on, if they are there."""

    def __init__(
        self, trained: TrainedAvatar, truth: Callable[[int, int], Float[Tensor, "H W 3"]] | None = None
    ) -> None:
        """`truth(index, width)` is the picture of a frame of the avatar's own video."""
        self.trained, self.truth = trained, truth
        self.controls = trained.expression_controls()
        self.joints = joint_ranges(trained.recording.motion(trained.recording.split.train))
        self.limits = trained.orbit_limits(trained.rest_camera())

    def of(self, newer: TrainedAvatar) -> ViewRenderer:
        """The same for the avatar after more training on the same video, which is moved to where this one computes."""
        newer.avatar.to(self.trained.avatar.quats.device)
        renderer = copy.copy(self)
        renderer.trained = newer
        return renderer

    @property
    def overlays(self) -> tuple[Overlay, ...]:
        """Those that this avatar has."""
        return tuple(name for name in OVERLAYS if name != "error" or self.truth is not None)

    def within(self, look: ViewOffset) -> tuple[ViewOffset, bool]:
        """The nearest offset that is allowed, and whether the training video shows the head from there."""
        (yaw_low, yaw_high), (pitch_low, pitch_high) = self.limits
        kept = ViewOffset(
            min(max(look.yaw, yaw_low - MARGIN), yaw_high + MARGIN),
            min(max(look.pitch, pitch_low - MARGIN), pitch_high + MARGIN),
            min(max(look.zoom, ZOOM[0]), ZOOM[1]),
        )
        return kept, yaw_low <= kept.yaw <= yaw_high and pitch_low <= kept.pitch <= pitch_high

    def params(self, frame: HeadParams, setting: Setting) -> HeadParams:
        """A frame with what was set by hand: expressions are added, joints that were moved replace the frame's."""
        expression = frame.expression
        for number, value in setting.expressions.items():
            expression = expression + value * self.controls[number].direction
        moved = {name: value for name, value in setting.joints.items() if value != 0.0}
        own = {name: float(value) for name, value in joint_values([frame]).items()}
        by_hand = posed(frame, None, {**own, **moved})
        fields = {JOINT_FIELD.get(name, "eyes") for name in moved} - {"eyelids"}
        eyelids = frame.eyelids.clone()
        for k, name in enumerate(("left_lid", "right_lid")):
            eyelids[k] = moved.get(name, eyelids[k])
        turned = {name: getattr(by_hand, name) for name in fields}
        return replace(frame, expression=expression, eyelids=eyelids, **turned)

    def distance(self, params: HeadParams) -> float:
        """From the training expressions: above 1 the avatar guesses."""
        return float(self.trained.statistics.expressions.distances([params])[0])

    @torch.no_grad()
    def draw(
        self, frame: tuple[HeadParams, Camera], setting: Setting, width: int, recorded: int | None = None
    ) -> UInt8[np.ndarray, "H W 3"]:
        """The picture, `width` pixels wide; `recorded` is the number of the frame in the avatar's own video.

        With the truth or the error, which exist for frames of the video only, they stand at its right.
        """
        params = self.params(frame[0], setting)
        seen, truth = frame[1], None
        if self.truth is not None and recorded is not None and (setting.with_truth or setting.overlay == "error"):
            seen, truth = self.trained.recording.camera(recorded), self.truth(recorded, width)  # of one camera
        own = seen.resized(width, max(1, round(width * seen.height / seen.width)))
        look, _ = self.within(setting.look)
        camera = orbited(own, look.yaw, look.pitch, look.zoom)
        with checked_drawings():
            picture = to_8_bit(self.rendered(params, camera).image).cpu().numpy()
        if setting.overlay == "mesh":
            _draw_mesh(picture, self.trained.avatar.vertices(params).cpu(), self.trained.assets.faces, camera)
        beside = [picture]
        if truth is not None:
            if setting.with_truth:
                beside.append(to_8_bit(truth).numpy())
            if setting.overlay == "error":  # of the recorded view, whatever the camera
                with checked_drawings():
                    drawn = self.rendered(frame[0], own).image.cpu()
                beside.append(to_8_bit(error_map(drawn, truth)).numpy())
        return np.concatenate(beside, axis=1)

    def film(self, clip: Clip, setting: Setting, width: int) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
        """The whole clip as `draw` shows it, in pictures of one size: the truths of several cameras may have several."""
        size = None
        for frame, recorded in zip(clip.frames, clip.recorded or (None,) * len(clip), strict=True):
            picture = self.draw(frame, setting, width, recorded)
            size = size or picture.shape[:2]
            yield to_8_bit(fitted(torch.from_numpy(picture) / 255.0, *size)).numpy()

    @torch.no_grad()
    def rendered(self, params: HeadParams, camera: Camera) -> Rendering:
        """The avatar alone, where it computes."""
        return self.trained.render(params, camera)


def _draw_mesh(picture: np.ndarray, vertices: Float[Tensor, "V 3"], faces: Tensor, camera: Camera) -> None:
    """The edges of the faces that are seen, into the picture; OpenCV counts the centres of pixels as whole numbers."""
    screen = camera.project(vertices).numpy()
    corners = faces.numpy()
    seen = np.unique(rasterize_mesh(screen, corners, camera.height, camera.width).face_id)
    outlines = np.round((screen[corners[seen[seen >= 0]], :2] - 0.5) * 16).astype(np.int32)
    cv2.polylines(picture, list(outlines), True, LINES, 1, cv2.LINE_AA, shift=4)
