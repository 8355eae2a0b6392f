"""What `avatar bench quality RUN RUN...` leaves: a table on the terminal, bench_quality.json and bench_quality.png."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from avatar.bench import Request
from avatar.bench.quality import Curve, measure, pareto
from avatar.bench.results import new_figure, write_report

FRAMES, FULL_FRAMES, QUICK_FRAMES = 50, 10_000, 2
REPEATS, QUICK_REPEATS = 11, 1
NEAR = 0.3  # dB below a run's own last figure


def run(request: Request) -> None:
    """Measure, print and write. The first run is the yardstick. `full` takes every held-out frame."""
    frames = QUICK_FRAMES if request.quick else FULL_FRAMES if request.full else FRAMES
    repeats = QUICK_REPEATS if request.quick else REPEATS
    curves = measure(request.inputs, request.head, frames=frames, repeats=repeats)
    content = {"curves": [asdict(curve) for curve in curves]}
    write_report(request.out, "bench_quality", table(curves), content, lambda path: write_plot(curves, path))


def table(curves: Sequence[Curve]) -> list[str]:
    """The last and the best checkpoint of each run, and how soon each has what the first run ends with."""
    yardstick, front = curves[0], pareto(curves)
    goals = [f"to {point.psnr:.2f} dB" for point in (yardstick.last, yardstick.best)]
    lines = [
        f"{'run':>16} {'steps':>6} {'ms/step':>15} {'minutes':>8} {'PSNR':>6} {'SSIM':>7} {'LPIPS':>6} {'best PSNR':>16} "
        f"{goals[0]:>11} {goals[1]:>11} {f'within {NEAR} dB':>13}"
    ]
    for curve in curves:
        last, best = curve.last, curve.best
        lpips = "-" if curve.lpips is None else f"{curve.lpips:.4f}"
        finest = f"{best.psnr:.2f} ({best.minutes:.2f})"
        lines.append(
            f"{Path(curve.run).name:>16} {last.step:6} {f'{curve.early.median:.1f}, {curve.late.median:.1f}':>15} "
            f"{last.minutes:8.2f} {last.psnr:6.2f} {last.ssim:7.4f} {lpips:>6} {finest:>16} "
            f"{minutes(curve.minutes_to(yardstick.last.psnr)):>11} {minutes(curve.minutes_to(yardstick.best.psnr)):>11} "
            f"{minutes(curve.minutes_to(last.psnr - NEAR)):>13}"
        )
    lines += [
        "",
        f"{curves[0].frames} held-out frames, head mask alone, driven by the tracker's tracking. ms/step: before and after "
        "the perceptual term takes part.",
        f"Minutes of training at that rate, at the checkpoints that were kept: to the last and to the best PSNR of "
        f"{Path(yardstick.run).name}, and within {NEAR} dB of the run's own last.",
        f"No other run is as good in less time: {', '.join(Path(curve.run).name for curve in front)}",
    ]
    return lines


def minutes(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def write_plot(curves: Sequence[Curve], path: Path) -> None:
    """PSNR and SSIM against training time; the last checkpoints that are best for their time are joined."""
    figure = new_figure(11, 4.2)
    front = pareto(curves)
    for axes, name, unit in zip(figure.subplots(1, 2), ("psnr", "ssim"), ("PSNR, dB", "SSIM"), strict=True):
        for curve in curves:
            times, values = [p.minutes for p in curve.points], [getattr(p, name) for p in curve.points]
            (line,) = axes.plot(times, values, marker=".", ms=4, lw=1, label=Path(curve.run).name)
            axes.plot(times[-1], values[-1], marker="o", color=line.get_color())
        axes.plot([c.last.minutes for c in front], [getattr(c.last, name) for c in front], "k:", lw=1)
        axes.set(xscale="log", xlabel="minutes of training", ylabel=f"{unit}, held-out frames, head mask")
        axes.grid(alpha=0.3, which="both")
        axes.legend(fontsize=8)
    figure.savefig(path, dpi=100)
