"""What a run of the benchmark leaves: a table on the terminal, bench_splat.json and bench_splat.png."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from importlib.util import find_spec
from typing import Any

from avatar.bench import Request
from avatar.bench.floor import measured_copy_bandwidth, measured_flops
from avatar.bench.machine import available_simd
from avatar.bench.results import leave
from avatar.bench.splat import Row, all_variants, measure
from avatar.bench.splat_gpu import ON_GPU, gpu_backends
from avatar.bench.splat_plot import total, write_plot
from avatar.bench.splat_work import Work, floors, work_of
from avatar.splat.scenes import HEAD_SPLATS

QUICK_SIZES, QUICK_COUNTS, QUICK_COUNT, QUICK_SIZE = (32, 64), (200, 500), 500, 64
USUAL_SIZES, USUAL_COUNTS = (256, 512), (HEAD_SPLATS, 50_000)
FULL_SIZES, FULL_COUNTS = (128, 256, 512, 1024), (1_000, 5_000, HEAD_SPLATS, 50_000, 200_000)
# Packages that draw Gaussians, on a GPU only. gsplat is timed beside the others where there is one.
OTHER_SPLATTERS = ("gsplat", "diff_gaussian_rasterization", "diff_surfel_rasterization", "msplat")


def run(request: Request) -> None:
    """Measure, print and write; `quick` takes scenes too small to say anything. A GPU is measured beside the CPU."""
    is_left_out = ON_GPU if request.device == "cpu" else ()
    if request.quick:
        variants = all_variants(
            QUICK_SIZES, QUICK_COUNTS, count=QUICK_COUNT, size=QUICK_SIZE, plain_sizes=QUICK_SIZES, all_threads=True
        )
        repeats, validation_size = 3, QUICK_SIZE
    else:
        sizes, counts = (FULL_SIZES, FULL_COUNTS) if request.full else (USUAL_SIZES, USUAL_COUNTS)
        variants, repeats, validation_size = all_variants(sizes, counts, all_threads=request.full), 21, 512
    variants = [variant for variant in variants if variant.backend not in is_left_out]
    rows = measure(variants, repeats=repeats, validation_size=validation_size)
    works = [
        work_of(*scene, with_memory=not request.quick)
        for scene in dict.fromkeys((row.variant.count, row.variant.size) for row in rows)
    ]
    lines = [*table(rows), *work_table(rows, works), others_line()]
    leave(request.out, "bench_splat", lines, as_json(rows, works), lambda path: write_plot(rows, path))


def as_json(rows: Sequence[Row], works: Sequence[Work]) -> dict[str, Any]:
    """All figures, with the machine that they belong to; milliseconds, bytes, and operations and bytes a second."""
    threads = sorted({row.variant.threads for row in rows})
    return {
        "limits": [
            {"threads": t, "operations": measured_flops(t), "bytes": measured_copy_bandwidth(t)} for t in threads
        ],
        "rows": [asdict(row) for row in rows],
        "work": [asdict(work) | {"floors": {t: floors(work, t) for t in threads}} for work in works],
        "other_splatters": installed_splatters(),
    }


def installed_splatters() -> list[str]:
    return [name for name in OTHER_SPLATTERS if find_spec(name)]


def others_line() -> str:
    found = installed_splatters()
    if not found:
        return f"Other splatters ({', '.join(OTHER_SPLATTERS)}): none installed"
    if "gsplat" in gpu_backends():
        return f"Other splatters: {', '.join(found)} installed, gsplat timed"
    return f"Other splatters: {', '.join(found)} installed, not timed: they draw on a GPU only"


def table(rows: Iterable[Row]) -> list[str]:
    """Milliseconds as median (95th percentile); errors against the float64 reference with the usual cut-offs."""
    lines = [
        f"{'backend':>12} {'cut-off':>11} {'splats':>7} {'size':>5} {'threads':>7} {'forward ms':>17} {'backward ms':>17} "
        f"{'sum':>8} {'image error':>11} {'rms error':>9} {'gradient error':>14}"
    ]
    for row in rows:
        variant, accuracy, timing = row.variant, row.accuracy, row.timing
        forward = f"{timing.forward.median:.2f} ({timing.forward.p95:.2f})"
        backward = f"{timing.backward.median:.2f} ({timing.backward.p95:.2f})"
        backend = f"{variant.backend} {variant.simd}".strip()
        errors = (
            f"{accuracy.image:11.1e} {accuracy.rms:9.1e} {accuracy.gradient:14.1e}"
            if accuracy
            else f"{'is the truth':>36}"
        )
        lines.append(
            f"{backend:>12} {variant.changed or 'usual':>11} {variant.count:7,} {variant.size:5} {variant.threads:7} "
            f"{forward:>17} {backward:>17} {total(row):8.2f} {errors}"
        )
    return lines


def work_table(rows: Sequence[Row], works: Sequence[Work]) -> list[str]:
    """What every scene asks for, and which part of the time of the fastest kernel the machine's own limits explain.

    Pairs are of a splat and a tile: by the exact ellipse, and by a square of three standard deviations.
    """
    fastest = available_simd()[-1]
    best = [row for row in rows if row.variant.simd == fastest and row.variant.has_usual_cutoffs]
    lines = [
        "",
        f"{'splats':>7} {'size':>5} {'pairs':>9} {'by 3 sigma':>10} {'evaluated':>11} {'composited':>11} {'memory MB':>9} "
        f"{'threads':>7} {'floor ms':>13} {'reached':>13}",
    ]
    for work in works:
        n = work.counters
        memory = "-" if work.memory is None else f"{work.memory / 1e6:.1f}"
        for row in (r for r in best if (r.variant.count, r.variant.size) == (work.count, work.size)):
            limits = floors(work, row.variant.threads)
            times = row.timing.forward.median, row.timing.backward.median
            floor_cell = " + ".join(f"{limit:.1f}" for limit in limits)
            reached = " + ".join(f"{limit / time:.0%}" for limit, time in zip(limits, times, strict=True))
            lines.append(
                f"{work.count:7,} {work.size:5} {n['pairs']:9,} {n['pairs_in_squares']:10,} {n['pixels_evaluated']:11,} "
                f"{n['pixels_composited']:11,} {memory:>9} {row.variant.threads:7} {floor_cell:>13} "
                f"{reached:>13}"
            )
    for threads in sorted({row.variant.threads for row in best}):
        rates = measured_flops(threads) / 1e9, measured_copy_bandwidth(threads) / 1e9
        lines.append(
            f"The floor, threads {threads}: {rates[0]:.1f} GFLOP/s of a matrix product, {rates[1]:.1f} GB/s of a copy"
        )
    return lines
