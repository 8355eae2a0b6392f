"""Measure an exported page in headless Chromium, and the viewer's pictures (docs/bench/view_results.md).

python scripts/measure_page.py RUN [--head PATH]      needs Chromium, and playwright from the extra [test]
"""

from __future__ import annotations

import argparse
import io
import shutil
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from playwright.sync_api import sync_playwright

from avatar.export.default_view import with_faded_neck
from avatar.export.web_page import write_page
from avatar.runs.run import open_trained
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.splat.cpu import thread_count
from avatar.view.view_renderer import Setting, ViewOffset, ViewRenderer

FLAGS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
FRAMES, SIZE, SECONDS, MIB = 20, 256, 6, 2**20
# Shows the picture at a time: nothing has been drawn for 0.4 s after it, or for 5 s where it was there already.
SEEK = """seconds => new Promise(done => {
  const rest = () => { avatar.removeEventListener("drawn", wait); done(); };
  let timer = setTimeout(rest, 5000);
  const wait = () => { clearTimeout(timer); timer = setTimeout(rest, 400); };
  avatar.addEventListener("drawn", wait);
  avatar.seek(seconds);
})"""


def open_page(browser: Any, path: Path, renderer: str) -> tuple[Any, float]:
    """The page with a still face, and the seconds until its first picture."""
    page = browser.new_page(reduced_motion="reduce")
    begin = time.perf_counter()
    page.goto(f"{path.as_uri()}?width={SIZE}&renderer={renderer}")
    page.locator("#message").wait_for(state="hidden", timeout=60000)
    return page, time.perf_counter() - begin


def fitter(page: Any, trained: TrainedAvatar) -> tuple[float, float]:
    """Lowest and mean PSNR to our renderer over FRAMES held-out frames, 8 bits a channel."""
    test, exported = list(trained.recording.split.test), with_faded_neck(trained)
    page.evaluate("avatar.background = null")  # that of training
    found = []
    for k in range(FRAMES):
        frame = k * len(test) // FRAMES
        page.evaluate(SEEK, frame / page.evaluate("avatar.header.fps"))
        data = page.evaluate("avatar.screenshot().then(b => b.arrayBuffer()).then(b => Array.from(new Uint8Array(b)))")
        picture = iio.imread(io.BytesIO(bytes(data)))[..., :3].astype(np.float64)
        index = test[frame]
        image = exported.render(trained.recording.params(index), trained.recording.camera(index, SIZE)).image
        truth = (image.clamp(0, 1) * 255).round().numpy().astype(np.float64)
        found.append(-10 * np.log10(max(np.square((picture - truth) / 255).mean(), 1e-12)))
    return min(found), statistics.mean(found)


def speed(page: Any) -> tuple[float, float]:
    """Pictures a second while the recorded motion plays at a frame rate that it cannot reach, and ms of the worker."""
    page.evaluate("avatar.header.fps = 240; avatar.play('recorded')")
    page.wait_for_timeout(2500)
    count = "(window.drawn = 0, avatar.addEventListener('drawn', () => ++drawn), performance.now())"
    begin = page.evaluate(count)
    page.wait_for_timeout(1000 * SECONDS)
    drawn, end = page.evaluate("[drawn, performance.now()]")
    return 1000 * drawn / (end - begin), page.evaluate("avatar.statistics.milliseconds")


def quad_pixels(trained: TrainedAvatar, width: int) -> float:
    """Pixels that a GPU shades for a picture: of the boxes that avatar/web/webgl_renderer.js draws, inside it."""
    counts = []
    for index in list(trained.recording.split.test)[:FRAMES]:
        camera = trained.recording.camera(index, width)
        means, quats, scales, opacities, _ = trained.gaussians(trained.recording.params(index))
        seen = opacities >= 1 / 255
        axes = quaternion_to_rotation_matrix(quats[seen]) * scales[seen, None]
        p = means[seen] @ camera.R_cam_world.T + camera.t_cam_world
        x, y, z = p.unbind(-1)
        zero = torch.zeros_like(z)
        rows = [camera.fx / z, zero, -camera.fx * x / z**2, zero, camera.fy / z, -camera.fy * y / z**2]
        J = torch.stack(rows, -1).unflatten(-1, (2, 3))
        variances = (J @ camera.R_cam_world @ axes).square().sum(-1) + 0.3
        half = (2 * (255 * opacities[seen]).log()[:, None] * variances).sqrt() + 1
        size = torch.tensor([camera.width, camera.height])
        centre = camera.project(means[seen])[:, :2]
        corners = [(centre + sign * half).clamp(min=torch.zeros(2), max=size) for sign in (-1, 1)]
        counts.append(float((corners[1] - corners[0]).prod(-1).sum()))
    return statistics.mean(counts)


def measure_viewer(trained: TrainedAvatar) -> None:
    renderer = ViewRenderer(trained)
    frames = list(trained.recording.split.test)[:40]
    for width in (SIZE, 2 * SIZE):
        times = []
        for k, i in enumerate(frames):
            begin = time.perf_counter()
            renderer.draw(
                (trained.recording.params(i), trained.recording.camera(i)), Setting(ViewOffset(0.1 * k)), width
            )
            times.append(1000 * (time.perf_counter() - begin))
        print(f"viewer   {width}x{width}: {statistics.median(times):.1f} ms a picture, {thread_count()} threads")


def main() -> None:
    parser = argparse.ArgumentParser(description="Sizes, speed and likeness of an avatar's page.")
    parser.add_argument("run", type=Path)
    parser.add_argument("--head", type=Path)
    arguments = parser.parse_args()
    trained = open_trained(arguments.run, arguments.head)
    print(f"avatar   {len(trained.avatar):,} Gaussians")
    measure_viewer(trained)
    for width in (SIZE, 2 * SIZE):
        print(f"webgl    {width}x{width}: {quad_pixels(trained, width) / 1e6:.2f} million pixels of quads a picture")
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=list(FLAGS))
        for precision in ("small", "float"):
            page_file = write_page(trained, Path(folder) / f"{precision}.html", precision)
            print(
                f"page     {precision}: {page_file.bytes / MIB:.2f} MiB, of it avatar {page_file.avatar_bytes / MIB:.2f}"
            )
            for renderer in ("wasm", "webgl"):
                page, first = open_page(browser, page_file.path, renderer)
                least, mean = fitter(page, trained)
                line = f"{precision}, {renderer}: PSNR at least {least:.1f} dB, mean {mean:.1f}"
                line += f"; first picture {first:.1f} s"
                if precision == "small":
                    rate, milliseconds = speed(page)
                    line += f"; {rate:.1f} pictures a second at {SIZE}x{SIZE} ({milliseconds:.0f} ms in the worker)"
                print(f"page     {line}", flush=True)
                page.close()
        browser.close()


if __name__ == "__main__":
    main()
