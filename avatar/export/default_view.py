"""How a page shows an avatar at first: from the front, in the middle, its neck faded into the background."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from typing import cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avatar.head.assets import JOINT_NAMES
from avatar.model import FlashAvatar
from avatar.motion.orbit import EDGE, orbited, seen_from
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.types import Camera

DEPTH = 8.0  # layers of Gaussians that stop the light
LEAST_OPACITY = 1e-6  # of a Gaussian, so that its logit is finite
LEAST = 0.01  # metres over which it fades
HAIR = 0.1  # of the head's height, above the mesh
FILLED = 0.85  # of a picture's height
SEEN = 0.1  # difference from the background
PIXELS = 128  # width of the picture in which the neck's end is looked for


@torch.no_grad()
def with_faded_neck(trained: TrainedAvatar) -> TrainedAvatar:
    """The avatar with a neck that fades."""
    avatar = copy.deepcopy(trained.avatar)
    kept = torch.sigmoid(avatar.opacity_logits) * neck_fade(trained)
    avatar.opacity_logits.copy_(torch.logit(kept, LEAST_OPACITY))
    return replace(trained, avatar=avatar)


@torch.no_grad()
def neck_fade(trained: TrainedAvatar) -> Float[Tensor, " G"]:
    """The share of its opacity that each Gaussian keeps: 1 from the chin upwards, 0 where the neck ends.

    -ln(1 - s (1 - e^-D)) / D, so that the share of the light that DEPTH = D layers of Gaussians stop is s = 3t^2 - 2t^3 of
    the height t in the neutral head, 0 where the neck ends and 1 at the chin.
    """
    model = cast(FlashAvatar, trained.avatar)
    embedding = model.embedding
    heights = (model.mesh.neutral_vertices()[embedding.corners, 1] * embedding.barycentric).sum(dim=1)
    end, chin = neck_heights(trained)
    t = ((heights - end) / max(chin - end, 1e-6)).clamp(0, 1)
    s = t * t * (3 - 2 * t)
    return -torch.log1p(-s * (1 - math.exp(-DEPTH))) / DEPTH


def front_camera(trained: TrainedAvatar, size: int | None = None) -> Camera:
    """The lens and distance of `rest_camera`, from the front, as far as training shows it; the head is upright, and in the
    middle together with half of its neck. Where they would fill more than FILLED of the height, it zooms out."""
    end, chin = neck_heights(trained)
    low, high = (end + chin) / 2, float(trained.avatar.head.neutral_vertices()[:, 1].max())
    camera = _from_the_front(trained, (low + high) / 2, size)
    shown = high - low + 2 * HAIR * (high - chin)  # metres, as much below as above
    zoom = min(1.0, FILLED * camera.height * float(camera.t_cam_world[2]) / (camera.fy * shown))
    return orbited(camera, zoom=zoom)


@torch.no_grad()
def neck_heights(trained: TrainedAvatar) -> tuple[float, float]:
    """Heights in the neutral head, metres: where the neck is seen to end, perhaps above the mesh's edge, and the chin."""
    heights = trained.avatar.head.neutral_vertices()[:, 1]
    moved = heights[trained.assets.weights[:, JOINT_NAMES.index("jaw")] > 0.5]
    low = float(heights.min())
    chin = float(moved.min()) if len(moved) else low
    camera = _from_the_front(trained, chin, PIXELS)
    image = trained.render(trained.rest_params(), camera).image
    # Gaussians in the colour of the training's background may lie below: they are not seen.
    seen = ((image - trained.background.to(image)).abs().amax(dim=-1) > SEEN).float()
    middle = seen[:, round(camera.width * 0.45) : round(camera.width * 0.55)]
    rows = middle.mean(dim=1)
    lowest = float((rows >= rows.max() / 2).nonzero().max()) + 1
    end = chin - (lowest - camera.height / 2) / camera.fy * float(camera.t_cam_world[2])
    return max(min(end, chin - LEAST), low), chin


def _from_the_front(trained: TrainedAvatar, height: float, size: int | None) -> Camera:
    """A camera with a height of the head, metres, in the middle of the picture."""
    camera, recording = trained.rest_camera(size), trained.recording
    frames = [seen_from(recording.camera(i)) for i in recording.split.train]
    low, high = np.percentile(np.array(frames), [EDGE, 100 - EDGE], axis=0)
    yaw, elevation = np.clip(0.0, low, high).tolist()
    turned = orbited(replace(camera, R_cam_world=torch.diag(torch.tensor([1.0, -1.0, -1.0]))), -yaw, elevation)
    shift_x, shift_y = (camera.width / 2 - camera.cx) / camera.fx, (camera.height / 2 - camera.cy) / camera.fy
    before = torch.tensor([shift_x, shift_y, 1.0]) * float(camera.t_cam_world[2])
    return replace(turned, t_cam_world=before - turned.R_cam_world @ torch.tensor([0.0, height, 0.0]))
