"""Draw an avatar's mouth where training opened it widest, as the camera saw it and from other sides; a row for each run.

    python scripts/draw_mouth.py RUN [RUN ...] docs/teeth.png [--head HEAD] [--size 1024]

docs/teeth.png has a run with model.teeth=false above one of the default (docs/bench/recipe_results.md).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import torch
from jaxtyping import Float
from torch import Tensor

from avatar.errors import UserError
from avatar.files.atomic import write_atomically
from avatar.head.features import mouth_rim
from avatar.motion.orbit import orbited
from avatar.runs.trained import TrainedAvatar, load_avatar

SIDES = (0.0, 0.0), (30.0, 0.0), (-30.0, 0.0), (0.0, -20.0)  # degrees to the right and upwards from the camera at rest
WIDTHS = 1.9  # of the mouth, that a picture shows
SIDE = 192  # pixels of each


@torch.no_grad()
def draw_mouth(trained: TrainedAvatar, size: int) -> Float[Tensor, "h w 3"]:
    """The mouth from all SIDES beside each other. Raises UserError for a head model without an opening for a mouth."""
    rim = torch.from_numpy(mouth_rim(trained.assets))
    if len(rim) == 0:
        raise UserError(f"the head model of {trained.source} has no opening between the lips")
    head, motion = trained.avatar.head, trained.recording.motion(trained.recording.split.train)

    def height(i: int) -> float:
        low, high = head.vertices(motion[i])[rim, 1].aminmax()
        return float(high - low)

    params, front = motion[max(range(len(motion)), key=height)], trained.rest_camera(size)
    lips = head.vertices(params)[rim]
    left, right = front.project(lips)[:, 0].aminmax()
    reach, pictures = int(WIDTHS * float(right - left) / 2), []
    for yaw, pitch in SIDES:
        camera = orbited(front, yaw, pitch)
        x, y = camera.project(lips)[:, :2].mean(dim=0).round().int().tolist()
        picture = trained.render(params, camera).image.clamp(0.0, 1.0).numpy()
        cut = picture[max(y - reach, 0) : y + reach, max(x - reach, 0) : x + reach]
        pictures.append(torch.from_numpy(cv2.resize(cut, (SIDE, SIDE), interpolation=cv2.INTER_AREA)))
    return torch.cat(pictures, dim=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("out", type=Path)
    parser.add_argument("--head", type=Path)
    parser.add_argument("--size", type=int, default=1024)
    arguments = parser.parse_args()
    try:
        rows = [draw_mouth(load_avatar(run, arguments.head), arguments.size) for run in arguments.runs]
    except UserError as error:
        raise SystemExit(str(error)) from None
    pixels = (255.0 * torch.cat(rows)).round().byte().numpy()
    write_atomically(arguments.out, cv2.imencode(".png", pixels[..., ::-1])[1].tobytes())
    print(f"Picture  {arguments.out}")


if __name__ == "__main__":
    main()
