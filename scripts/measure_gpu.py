"""What can only be learnt on a GPU: parity at full size, repeatability, waiting, graph capture, tuning and times.

    python scripts/measure_gpu.py [--out docs/bench] [--size 512] [--splats 14876] [--uv-size 128] [--repeats 50]

Writes OUT/gpu.md and ends with status 1 where a check fails. `gpu_session.sh` runs it with all other checks. With
TRITON_INTERPRET=1 and small numbers it runs, slowly, without a GPU, for its own test; the times then mean nothing.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
import triton
from count_launches import Rehearsal
from torch import Tensor

from avatar.bench.clock import Time, paired_medians, synchronize
from avatar.bench.splat import device_of
from avatar.compute.cuda_graph import own_stream
from avatar.compute.device import CPU, interpreted
from avatar.demo.head import demo_head
from avatar.demo.scene import head_assets
from avatar.losses.photometric import dssim, masked_lpips, on_head
from avatar.pipeline.choose_device import choose_device
from avatar.render import Renderer
from avatar.splat import gpu_draw, splat
from avatar.splat.scenes import HEAD_SPLATS, head_camera, head_shell
from avatar.train.loss import PerceptualTerm, Weighted
from avatar.train.step_runner import WARM, StepRunner
from avatar.types import Gaussians

IMAGE_TOLERANCE, GRADIENT_TOLERANCE = 1e-5, 1e-4  # mean over the pixels, of a field's norm; cut-offs may decide a pixel
STREAMED = 20
STAND_IN = PerceptualTerm("dssim", Weighted(dssim, 0.05))


class Scene:
    """The shell of a head on one device, to draw and to differentiate."""

    def __init__(self, count: int, size: int, device: torch.device) -> None:
        self.leaves = Gaussians(*(t.to(device).requires_grad_() for t in head_shell(count)))
        self.camera, self.background = head_camera(size), torch.ones(3, device=device)
        self.cotangent = torch.rand(size, size, 3, generator=torch.Generator().manual_seed(0)).to(device)
        self.drawn: list[Tensor] = []

    def forward(self, backend: str = "gpu") -> None:
        self.drawn = [splat(self.leaves, self.camera, self.background, backend=backend).image]  # type: ignore[arg-type]
        synchronize(self.background.device)

    def backward(self) -> tuple[Tensor, ...]:
        gradients = torch.autograd.grad(self.drawn.pop(), self.leaves, self.cotangent)
        synchronize(self.background.device)
        return gradients

    def both(self, backend: str = "gpu") -> list[Tensor]:
        self.forward(backend)
        return [self.drawn[0].detach(), *self.backward()]


def check_parity(scene: Scene, count: int, size: int) -> str:
    on_cpu = Scene(count, size, torch.device("cpu"))
    (image, *gradients), (expected, *wanted) = (scene.both(), on_cpu.both("cpu"))
    off = float((image.cpu() - expected).abs().mean())
    worst = max(float((a.cpu() - b).norm() / b.norm()) for a, b in zip(gradients, wanted, strict=True))
    assert off < IMAGE_TOLERANCE and worst < GRADIENT_TOLERANCE, f"image off by {off:.1e}, gradients by {worst:.1e}"
    return f"image off by {off:.1e} on average, gradients by {worst:.1e} of their norm"


def check_repeats(scene: Scene, repeats: int) -> str:
    expected = scene.both()
    for _ in range(repeats):
        assert all(torch.equal(a, b) for a, b in zip(scene.both(), expected, strict=True)), "the bits differ"
    return f"{repeats + 1} drawings and gradients, the same bits"


def check_no_waiting(rehearsal: Rehearsal, device: torch.device) -> str:
    """Steps and frames with torch set to raise where the host waits for the GPU; the first ones may wait."""
    renderer = Renderer(rehearsal.avatar, rehearsal.background)
    for mode in ("default", "error") if device.type == "cuda" else ("default",):
        if device.type == "cuda":
            torch.cuda.set_sync_debug_mode(mode)
        try:
            for late in (False, True):
                rehearsal.train(STAND_IN, late)
            renderer.render(rehearsal.params, rehearsal.camera)
        finally:
            if device.type == "cuda":
                torch.cuda.set_sync_debug_mode("default")
    return "training steps and frames wait for nothing"


def check_capture(scene: Scene) -> str:
    """A drawing and its gradients as a CUDA graph, replayed."""
    if not torch.cuda.is_available() or interpreted():
        return "not tried: no GPU"
    expected = scene.both()
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        scene.both()
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, stream=stream):
        image = splat(scene.leaves, scene.camera, scene.background).image
        found = [image.detach(), *torch.autograd.grad(image, scene.leaves, scene.cotangent)]
    graph.replay()
    torch.cuda.synchronize()
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True)), "a replayed graph gives other bits"
    return "a drawing and its gradients can be captured and replayed"


class Replays:
    """The steps of a rehearsal, which are replayed after the first ones."""

    def __init__(self, rehearsal: Rehearsal, perceptual: PerceptualTerm = STAND_IN) -> None:
        self.rehearsal = rehearsal
        self.steps = StepRunner(rehearsal.state(perceptual))

    def train(self, late: bool) -> None:
        r = self.rehearsal
        self.steps.make(r.number(late), r.frame, r.guard.check_gradients)


def check_replays(make: Callable[[], Rehearsal]) -> str:
    """As many steps launched as replayed, from the same values."""
    torch.manual_seed(0)
    launched = make()
    torch.manual_seed(0)
    replays = Replays(make())
    for late in (False, True):
        for _ in range(2 * WARM):
            launched.train(STAND_IN, late)
            replays.train(late)
    states = launched.avatar.state_dict().items(), replays.rehearsal.avatar.state_dict().values()
    different = [name for (name, own), other in zip(*states, strict=True) if not torch.equal(own, other)]
    assert replays.steps.replayed == 2 * WARM, f"{replays.steps.replayed} of {4 * WARM} steps were replayed"
    assert not different, f"the bits differ in {', '.join(different)}"
    return f"{replays.steps.replayed} replayed training steps, the bits of launched ones"


def tune(scene: Scene, repeats: int, quick: bool) -> list[tuple[gpu_draw.Tuning, Time, Time]]:
    """Tile, steps and warps, each with the times of both directions, fastest sum first."""
    usual = gpu_draw.TUNING
    choices = itertools.product((8, 16), (4, 8, 16), (2, 4, 8), (1, 2, 4), (1, 2, 4))
    tunings = [gpu_draw.Tuning(tile, a, b, warps, back) for tile, a, b, warps, back in choices]
    rows = []
    try:
        for tuning in [usual, *tunings][: 2 if quick else None]:
            gpu_draw.TUNING = tuning
            times = paired_medians(
                {"forward": scene.forward, "backward": scene.backward}, repeats, warm_up=min(3, repeats - 1)
            )
            rows.append((tuning, times["forward"], times["backward"]))
    finally:
        gpu_draw.TUNING = usual
    return sorted(rows, key=lambda row: row[1].median + row[2].median)


def time_all(scene: Scene, rehearsal: Rehearsal, device: torch.device, repeats: int) -> dict[str, Time]:
    renderer, replays = Renderer(rehearsal.avatar, rehearsal.background), Replays(rehearsal)
    lpips = Weighted(on_head(masked_lpips(rehearsal.lpips)), 0.05, crops=True)
    with_lpips = Replays(rehearsal, PerceptualTerm("lpips", lpips))
    frame = rehearsal.params.to(CPU), rehearsal.camera

    def synchronized(function: Callable[[], object]) -> Callable[[], None]:
        def run() -> None:
            function()
            synchronize(device)

        return run

    functions: dict[str, Callable[[], object]] = {
        "splatting, forward": scene.forward,
        "splatting, backward": scene.backward,
        "posing": synchronized(lambda: renderer.avatar.vertices(rehearsal.params)),
        "network, HyperGaussians and placing": synchronized(lambda: renderer.gaussians(rehearsal.params)),
        "a rendered frame": synchronized(
            lambda: renderer.draw(renderer.gaussians(*frame), frame[1], renderer.background)
        ),
        "the same, replayed": synchronized(lambda: renderer.render(*frame)),
        f"{STREAMED} frames, streamed to the CPU": lambda: sum(1 for _ in renderer.stream([frame] * STREAMED)),
        "a training step, first half": synchronized(lambda: rehearsal.train(STAND_IN, late=False)),
        "a training step with D-SSIM": synchronized(lambda: rehearsal.train(STAND_IN, late=True)),
        "the same two, replayed": synchronized(lambda: (replays.train(False), replays.train(True))),
        "a training step with LPIPS, replayed": synchronized(lambda: with_lpips.train(True)),
    }
    return paired_medians(functions, repeats, warm_up=min(WARM + 1, repeats - 1))


def report(
    name: str,
    arguments: argparse.Namespace,
    checks: dict[str, str],
    times: dict[str, Time],
    tunings: Sequence[tuple[gpu_draw.Tuning, Time, Time]],
) -> str:
    lines = [
        f"# On {name}",
        "",
        f"torch {torch.__version__}, Triton {triton.__version__}; {arguments.splats:,} splats, {arguments.size} x "
        f"{arguments.size} pixels, an avatar with {arguments.uv_size} texels a side. `python scripts/measure_gpu.py` "
        "writes this.",
        "",
        *(f"- {check}: {said}" for check, said in checks.items()),
        "",
        "| what | ms, median | 95th percentile |",
        "|---|---|---|",
        *(f"| {what} | {time.median:.3f} | {time.p95:.3f} |" for what, time in times.items()),
        "",
        "| tile | step | backward | warps | backward | forward ms | backward ms |",
        "|---|---|---|---|---|---|---|",
    ]
    for tuning, forward, backward in tunings[:10]:
        t = tuning
        cells = (t.tile, t.step, t.backward_step, t.warps, t.backward_warps)
        lines.append(f"| {' | '.join(map(str, cells))} | {forward.median:.3f} | {backward.median:.3f} |")
    return "\n".join(lines) + "\n"


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/bench"))
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--splats", type=int, default=HEAD_SPLATS)
    parser.add_argument("--uv-size", type=int, default=128)
    parser.add_argument("--repeats", type=int, default=50)
    parser.add_argument("--quick", action="store_true", help="try two tunings only")
    arguments = parser.parse_args(argv)
    device = device_of("gpu") if interpreted() else choose_device("cuda", print)
    name = "Triton's interpreter" if interpreted() else torch.cuda.get_device_name(device)
    with own_stream(device):
        return measure(arguments, device, name)


def measure(arguments: argparse.Namespace, device: torch.device, name: str) -> int:
    assets = head_assets(demo_head())
    scene = Scene(arguments.splats, arguments.size, device)

    def rehearse() -> Rehearsal:
        return Rehearsal(assets, arguments.uv_size, arguments.size, device=device)

    rehearsal = rehearse()
    tries: dict[str, Callable[[], str]] = {
        "parity with the CPU": lambda: check_parity(scene, arguments.splats, arguments.size),
        "repeatability": lambda: check_repeats(scene, min(arguments.repeats, 20)),
        "waiting": lambda: check_no_waiting(rehearsal, device),
        "graph capture": lambda: check_capture(scene),
        "replaying": lambda: check_replays(rehearse),
    }
    checks, failed = {}, 0
    for check, attempt in tries.items():
        try:
            checks[check] = attempt()
        except (AssertionError, RuntimeError) as error:
            checks[check] = f"FAILED, {str(error).splitlines()[0]}"
            failed += 1
        print(f"{check}: {checks[check]}", flush=True)
    times = time_all(scene, rehearsal, device, arguments.repeats)
    tunings = tune(scene, arguments.repeats, arguments.quick)
    arguments.out.mkdir(parents=True, exist_ok=True)
    text = report(name, arguments, checks, times, tunings)
    (arguments.out / "gpu.md").write_text(text, encoding="utf-8")
    print(text)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
