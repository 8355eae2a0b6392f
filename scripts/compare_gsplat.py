"""Our GPU splatter beside gsplat's: the same scenes, images compared first, then time and memory of both directions.

    python scripts/compare_gsplat.py [--out docs/bench] [--avatar RUN] [--counts N ...] [--sizes N ...] [--repeats N]

Needs a GPU and gsplat (`pip install gsplat`). Scenes are random shells of a head's shape and, with --avatar, a
trained avatar in its first held-out frame. Calls take turns in one process; times are medians through the public
functions with autograd, waited for. "Replayed" is our forward and backward pass as one CUDA graph; gsplat's waits for
the number of its pairs of tile and splat, so it cannot be captured. Writes OUT/gpu_gsplat.md.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from avatar.bench.clock import paired_medians, synchronize
from avatar.pipeline.choose_device import choose_device
from avatar.runs.run import open_trained
from avatar.splat import splat
from avatar.splat.scenes import HEAD_SPLATS, head_camera, head_shell
from avatar.types import Camera, Gaussians, Rendering

COUNTS = (10_000, HEAD_SPLATS, 30_000, 100_000, 300_000)
SIZES = (256, 512, 1024, 2048)
COLUMNS = (
    "scene",
    "pixels",
    "image, mean difference",
    *(f"{whose}, {way} ms" for way in ("forward", "backward") for whose in ("ours", "gsplat")),
    "ours, both replayed ms",
    "ours, MiB",
    "gsplat, MiB",
)


class Scene(NamedTuple):
    name: str
    gaussians: Gaussians  # on the GPU, to be differentiated
    camera: Camera


class Splatter:
    """One of the two, drawing one scene."""

    def __init__(self, scene: Scene, draw: Callable[[Gaussians, Camera], Rendering]) -> None:
        self._scene, self._draw = scene, draw
        self._cotangent = torch.ones(scene.camera.height, scene.camera.width, 3, device="cuda")
        self._image: Tensor | None = None

    def forward(self) -> Tensor:
        self._image = self._draw(self._scene.gaussians, self._scene.camera).image
        synchronize(self._image.device)
        return self._image

    def backward(self) -> None:
        assert self._image is not None
        torch.autograd.grad(self._image, self._scene.gaussians, self._cotangent)
        self._image = None
        torch.cuda.synchronize()

    def peak_mib(self) -> float:
        """Memory that both directions take beside the scene."""
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        self.forward()
        self.backward()
        return (torch.cuda.max_memory_allocated() - before) / 2**20


def ours(gaussians: Gaussians, camera: Camera) -> Rendering:
    return splat(gaussians, camera, torch.zeros(3, device="cuda"))


def splat_gsplat(gaussians: Gaussians, camera: Camera) -> Rendering:
    """By gsplat (Ye et al., 2024), over black, with its own cut-offs; its ellipses end where ours do, or before."""
    from gsplat import rasterization  # pyright: ignore[reportMissingImports]  # nobody has to have it

    device = gaussians.means.device
    view = torch.eye(4)
    view[:3, :3], view[:3, 3] = camera.R_cam_world, camera.t_cam_world
    intrinsics = torch.tensor([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    image, alpha, _ = rasterization(
        *gaussians,
        view[None].to(device),
        intrinsics[None].to(device),
        camera.width,
        camera.height,
        sh_degree=round(gaussians.sh.shape[1] ** 0.5) - 1,
        packed=False,
    )
    return Rendering(image[0], alpha[0, ..., 0])


def captured(scene: Scene) -> Callable[[], None]:
    """Our forward and backward pass as one graph."""
    background, cotangent = torch.zeros(3, device="cuda"), torch.ones(scene.camera.height, scene.camera.width, 3).cuda()

    def both() -> None:
        image = splat(scene.gaussians, scene.camera, background).image
        torch.autograd.grad(image, scene.gaussians, cotangent)

    both()
    stream, graph = torch.cuda.Stream(), torch.cuda.CUDAGraph()
    with torch.cuda.stream(stream):
        both()
    torch.cuda.synchronize()
    with torch.cuda.graph(graph, stream=stream):
        both()

    def replay() -> None:
        graph.replay()
        torch.cuda.synchronize()

    return replay


def compare(scene: Scene, repeats: int) -> str:
    own, theirs = Splatter(scene, ours), Splatter(scene, splat_gsplat)
    with torch.no_grad():
        difference = float((own.forward() - theirs.forward()).abs().mean())
    memory = [splatter.peak_mib() for splatter in (own, theirs) for _ in range(2)][1::2]
    calls = {
        "ours forward": own.forward,
        "ours backward": own.backward,
        "gsplat forward": theirs.forward,
        "gsplat backward": theirs.backward,
        "replayed": captured(scene),
    }
    times = {name: time.median for name, time in paired_medians(calls, repeats, warm_up=5).items()}
    cells = [
        scene.name,
        f"{scene.camera.width}",
        f"{difference:.1e}",
        *(f"{times[f'{who} {way}']:.2f}" for way in ("forward", "backward") for who in ("ours", "gsplat")),
        f"{times['replayed']:.2f}",
        *(f"{mib:.0f}" for mib in memory),
    ]
    return f"| {' | '.join(cells)} |"


def on_gpu(gaussians: Gaussians) -> Gaussians:
    return Gaussians(*(t.detach().cuda().requires_grad_() for t in gaussians))


def scenes(run: Path | None, counts: Sequence[int], sizes: Sequence[int]) -> list[Scene]:
    found = []
    if run is not None:
        trained = open_trained(run)
        first = trained.recording.split.test[0]
        with torch.no_grad():
            camera = trained.recording.camera(first, None)
            gaussians = on_gpu(trained.avatar(trained.recording.params(first), None, camera.R_cam_world))
        name = f"avatar, {len(gaussians.means):,}"
        found += [Scene(name, gaussians, trained.recording.camera(first, size)) for size in sizes]
    for count, size in itertools.product(counts, sizes):
        found.append(Scene(f"shell, {count:,}", on_gpu(head_shell(count)), head_camera(size)))
    return found


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/bench"))
    parser.add_argument("--avatar", type=Path, metavar="RUN")
    parser.add_argument("--counts", type=int, nargs="+", default=COUNTS)
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES)
    parser.add_argument("--repeats", type=int, default=30)
    given = parser.parse_args(argv)
    device = choose_device("cuda", print)
    import gsplat  # pyright: ignore[reportMissingImports]

    lines = [
        f"# Beside gsplat {gsplat.__version__} on {torch.cuda.get_device_name(device)}",
        "",
        f"`python scripts/compare_gsplat.py` writes this; torch {torch.__version__}, {given.repeats} calls each, medians.",
        "",
        f"| {' | '.join(COLUMNS)} |",
        f"|{'---|' * len(COLUMNS)}",
    ]
    given.out.mkdir(parents=True, exist_ok=True)
    for scene in scenes(given.avatar, given.counts, given.sizes):
        lines.append(compare(scene, given.repeats))
        print(lines[-1], flush=True)
        (given.out / "gpu_gsplat.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
