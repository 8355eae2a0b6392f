"""Record an avatar's page in headless Chromium as a picture that moves and begins where it ends, for a README.

python scripts/record_page.py RUN --out docs/page.webp [--head PATH] [--seconds 4] [--width 640]

Needs Chromium, and playwright from the extra [test]. The page plays held-out motion, there and back, while the camera goes
once round within what training showed.
"""

from __future__ import annotations

import argparse
import io
import math
import shutil
import tempfile
from pathlib import Path
from typing import Any

from PIL import Image
from playwright.sync_api import sync_playwright

from avatar.errors import UserError
from avatar.export.web_page import write_page
from avatar.files.atomic import write_atomically
from avatar.runs.run import open_trained

FLAGS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
FPS, QUALITY = 10, 75  # of the picture; more of either hardly shows and makes it half as large again
LAYOUT = (1000, 628)  # pixels of the window: the avatar beside its sliders
SHARE = 0.9  # of what training showed; beyond, the avatar guesses
# Set the view, seek, and wait until that picture is drawn.
SHOW = """([seconds, yaw, pitch]) => new Promise(done => {
  let timer;
  const rest = () => { avatar.removeEventListener("drawn", wait); done(); };
  const wait = () => { clearTimeout(timer); timer = setTimeout(rest, 250); };
  avatar.addEventListener("drawn", wait);
  avatar.look({yaw, pitch});
  avatar.seek(seconds);
  wait();
})"""


def record(page: Any, seconds: float, width: int) -> list[Image.Image]:
    """Pictures of the whole page, FPS a second; the motion goes there and back, so that the last leads to the first."""
    limits = page.evaluate("avatar.header.orbit")
    count, pictures = round(seconds * FPS), []
    for k in range(count):
        phase = 2 * math.pi * k / count
        there = 0.5 * seconds * (1 - abs(1 - 2 * k / count))
        yaw, pitch = (
            (low + high) / 2 + SHARE * (high - low) / 2 * wave
            for (low, high), wave in zip(
                (limits["yaw"], limits["pitch"]), (math.sin(phase), 0.5 * math.sin(2 * phase)), strict=True
            )
        )
        page.evaluate(SHOW, [there, yaw, pitch])
        picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
        pictures.append(
            picture.resize((width, round(width * picture.height / picture.width)), Image.Resampling.LANCZOS)
        )
    return pictures


def encoded(pictures: list[Image.Image]) -> bytes:
    """A WebP without end."""
    out = io.BytesIO()
    pictures[0].save(
        out,
        "WEBP",
        save_all=True,
        append_images=pictures[1:],
        duration=1000 // FPS,
        loop=0,
        quality=QUALITY,
        method=6,  # the slowest and smallest
    )
    return out.getvalue()


def main() -> None:
    parser = argparse.ArgumentParser(description="An avatar's page as a picture that moves.")
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.webp")
    parser.add_argument("--head", type=Path)
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--width", type=int, default=640)
    arguments = parser.parse_args()
    if arguments.out.suffix != ".webp":
        raise UserError(f"--out must be a .webp, not {arguments.out}")
    trained = open_trained(arguments.run, arguments.head)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        path = write_page(trained, Path(folder) / "page.html", "small").path
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=list(FLAGS))
        page = browser.new_page(viewport=dict(zip(("width", "height"), LAYOUT, strict=True)), reduced_motion="reduce")
        page.goto(f"{path.as_uri()}?width=512&renderer=wasm")
        page.locator("#message").wait_for(state="hidden", timeout=120_000)
        data = encoded(record(page, arguments.seconds, arguments.width))
        browser.close()
    write_atomically(arguments.out, data)
    print(f"{arguments.out}: {len(data) / 2**20:.2f} MiB, {round(arguments.seconds * FPS)} pictures")


if __name__ == "__main__":
    main()
