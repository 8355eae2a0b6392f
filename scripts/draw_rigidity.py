"""Draw which Gaussians keep with the skull and which with the skin: frames, and under them the learned shares.

    python scripts/draw_rigidity.py RUN docs/rigidity.png --frames 820 930 [--head HEAD] [--size 256]

Blue keeps with the skin, red with the skull (docs/bench/recipe_results.md).
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
from avatar.runs.trained import TrainedAvatar, load_avatar
from avatar.splat.sh import C0

SKIN, SKULL = torch.tensor([0.1, 0.2, 0.9]), torch.tensor([1.0, 0.25, 0.0])


@torch.no_grad()
def draw_shares(trained: TrainedAvatar, frame: int, size: int) -> Float[Tensor, "2*h w 3"]:
    """A frame of the recording above the same with each Gaussian in the colour of its share. Raises UserError for an avatar
    that has learned none."""
    if (rigidity := trained.avatar.rigidity) is None:
        raise UserError(f"{trained.source} has learned no rigidity; train one with model.rigidity=true")
    params, camera = trained.recording.params(frame), trained.recording.camera(frame, size)
    colours = torch.lerp(SKIN, SKULL, rigidity[:, None])
    gaussians = trained.avatar(params, None, camera.R_cam_world)._replace(sh=((colours - 0.5) / C0)[:, None])
    shares = trained.avatar.draw(gaussians, camera, trained.background).image
    return torch.cat((trained.render(params, camera).image, shares)).clamp(0.0, 1.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--frames", type=int, nargs="+", required=True, help="positions in the video")
    parser.add_argument("--head", type=Path)
    parser.add_argument("--size", type=int, default=256)
    arguments = parser.parse_args()
    try:
        trained = load_avatar(arguments.run, arguments.head)
        columns = [draw_shares(trained, frame, arguments.size) for frame in arguments.frames]
    except UserError as error:
        raise SystemExit(str(error)) from None
    pixels = (255.0 * torch.cat(columns, dim=1)).round().byte().numpy()
    write_atomically(arguments.out, cv2.imencode(".png", pixels[..., ::-1])[1].tobytes())
    print(f"Picture  {arguments.out}")


if __name__ == "__main__":
    main()
