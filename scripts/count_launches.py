"""Count what a training step and a rendered frame launch on a GPU, without one.

    python scripts/count_launches.py [--uv-size 128] [--size 512]

Steps run on torch's meta device, where tensors have shapes and nothing is computed; what the dispatcher is asked for is
counted, and every start of a kernel of ours. A number that is read back cannot be had there: it would raise.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from avatar.config import load_config
from avatar.data.frame import Frame
from avatar.demo.head import demo_head
from avatar.demo.scene import head_assets
from avatar.head.assets import HeadAssets
from avatar.kernels.launch import watched
from avatar.losses.lpips_network import Lpips
from avatar.losses.photometric import dssim, masked_lpips, on_head
from avatar.render import Renderer
from avatar.runs.model_registry import make_avatar
from avatar.splat.scenes import head_camera
from avatar.train.loss import SPARSE_EVERY, PerceptualTerm, TrainingLoss, Weighted
from avatar.train.optimizer import make_optimizer, schedule, set_rates
from avatar.train.pose_corrections import make_pose_corrections
from avatar.train.step import TrainState, train_step
from avatar.train.step_monitor import Guard
from avatar.train.step_runner import StepRunner
from avatar.types import IDENTITY_6D, HeadParams

META = torch.device("meta")

# Operators that give a tensor without touching its memory.
NOTHING = {
    "_unsafe_view",
    "alias",
    "as_strided",
    "detach",
    "expand",
    "lift_fresh",
    "permute",
    "reshape",
    "select",
    "slice",
}
NOTHING |= {"split", "split_with_sizes", "squeeze", "t", "transpose", "unbind", "unsqueeze", "view"}
NOTHING |= {"empty", "empty_like", "empty_strided", "new_empty", "new_empty_strided"}
# Operators of more than one launch; all others count as one. A sort of 64-bit keys by CUB takes a histogram, a scan and a
# pass for every byte, one of 16-bit keys three launches for each of three passes; torch numbers the keys and copies them.
MORE = {"convolution": 2, "convolution_backward": 2, "cumsum": 2, "_foreach_norm": 2}
SORT = {torch.float64: 12, torch.int16: 11, torch.int32: 14}


class LaunchCounter(TorchDispatchMode):
    """Launches by operator, of what happens on the meta device."""

    def __init__(self) -> None:
        super().__init__()
        self.launches: Counter[str] = Counter()

    def __torch_dispatch__(self, function: Any, types: Any, arguments: Any = (), named: Any = None) -> Any:
        made = function(*arguments, **(named or {}))
        name = function.overloadpacket.__name__
        given = [leaf for leaf in tree_leaves((arguments, named, made)) if isinstance(leaf, Tensor)]
        if any(tensor.is_meta for tensor in given) and name not in NOTHING:
            self.launches[name] += SORT[given[0].dtype] if name == "sort" else MORE.get(name, 1)
        return made

    def start(self, kernel: Any, *_: Any) -> None:
        self.launches[f"our {kernel.fn.__name__}"] += 1


@contextmanager
def counting() -> Iterator[Counter[str]]:
    counter = LaunchCounter()
    with watched(counter.start), counter:
        yield counter.launches


class Rehearsal:
    """An avatar of the default recipe, with one frame; on the meta device, or on one that computes."""

    def __init__(
        self,
        assets: HeadAssets,
        uv_size: int,
        size: int,
        overrides: tuple[str, ...] = (),
        device: torch.device = META,
    ) -> None:
        config = load_config([f"model.uv_size={uv_size}", *overrides])
        avatar = make_avatar(assets, torch.zeros(1), config.model)
        avatar.embedding.touching(avatar.mesh.assets.num_vertices)  # made once, and only of numbers that are there
        self.avatar = avatar.to(device)
        self.config, self.trainer = config, config.trainer
        self.corrections = make_pose_corrections(self.avatar, (0, 1), config.trainer)
        self.optimizer = make_optimizer(self.avatar, config.trainer, self.corrections)
        self.guard = Guard(self.optimizer, device)
        self.background = torch.ones(3, device=device)
        rest = torch.tensor(IDENTITY_6D)
        still = HeadParams(torch.zeros(assets.num_expressions), rest, rest.repeat(2), torch.zeros(2), rest)
        self.params, self.camera = still.to(device), head_camera(size)
        planes = [torch.rand(size, size, *channels, device=device) for channels in ((3,), (), (), ())]
        box = slice(size // 8, size), slice(size // 4, 3 * size // 4)
        self.frame = Frame(0, "rehearsed", self.camera, self.params, *planes, head_box=box)
        self.steps = StepRunner(self.state(PerceptualTerm("none")))
        self.steps.vertices(self.frame)
        self.lpips = Lpips("squeeze").on(device)

    def step(self, perceptual: PerceptualTerm, late: bool) -> Counter[str]:
        """What one training step launches; `late`: in the second half of the training."""
        with counting() as launches:
            self.train(perceptual, late)
        return launches

    def train(self, perceptual: PerceptualTerm, late: bool) -> None:
        step = self.number(late)
        set_rates(self.optimizer, schedule(step, self.trainer))
        train_step(self.state(perceptual), step, self.steps.inputs(step, self.frame), self.guard.check_gradients)

    def state(self, perceptual: PerceptualTerm) -> TrainState:
        objective = TrainingLoss(self.trainer, self.background, perceptual)
        return TrainState(self.avatar, self.optimizer, objective, self.corrections)

    def number(self, late: bool) -> int:
        """Of a step in the second half, or in the first."""
        return self.trainer.iterations - SPARSE_EVERY if late else self.trainer.iterations // 4

    def rendered(self) -> Counter[str]:
        renderer = Renderer(self.avatar, self.background)
        with counting() as launches:
            renderer.render(self.params, self.camera)
        return launches


def count_all(assets: HeadAssets, uv_size: int, size: int) -> dict[str, Counter[str]]:
    rehearsal = Rehearsal(assets, uv_size, size)
    stand_in = Weighted(dssim, 0.05)
    lpips = Weighted(on_head(masked_lpips(rehearsal.lpips)), 0.05, crops=True)
    return {
        "step, first half": rehearsal.step(PerceptualTerm("dssim", stand_in), late=False),
        "step with D-SSIM": rehearsal.step(PerceptualTerm("dssim", stand_in), late=True),
        "step with LPIPS (each tenth of the second half)": rehearsal.step(
            PerceptualTerm("lpips", lpips, SPARSE_EVERY, stand_in), late=True
        ),
        "rendered frame": rehearsal.rendered(),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--uv-size", type=int, default=128)
    parser.add_argument("--size", type=int, default=512)
    arguments = parser.parse_args()
    assets = head_assets(demo_head())
    for name, launches in count_all(assets, arguments.uv_size, arguments.size).items():
        own = sum(count for what, count in launches.items() if what.startswith("our "))
        print(f"{name}: {launches.total()} launches, {own} of them kernels of this program")
        for what, count in launches.most_common():
            print(f"    {count:4} {what}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
