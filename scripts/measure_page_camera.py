"""Measure an exported page that a camera drives: latency, rate, likeness to the webcam (docs/bench/view_results.md).

python scripts/measure_page_camera.py RUN VIDEO [--head PATH] [--seconds 20] [--renderer wasm]

Headless Chromium with software GL takes VIDEO for its camera. A face's latency is from when its picture is there to when
the avatar's picture is on the canvas. Then both ways follow the same frames of VIDEO, one after another, calibrated on the
first four seconds. Needs Chromium, playwright from the extra [test], MediaPipe and what `avatar models` lists for it.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import functools
import http.server
import io
import shutil
import statistics
import subprocess
import tempfile
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import torch
from PIL import Image
from playwright.sync_api import sync_playwright
from torch import Tensor

from avatar.commands.reenact import head_of
from avatar.errors import UserError
from avatar.export.default_view import front_camera
from avatar.export.mediapipe_pack import PACK, make_pack
from avatar.export.web_arrays import reduce_avatar
from avatar.export.web_page import WEB, write_page, write_web_avatar
from avatar.head.lips import lip_gap, lip_pairs
from avatar.motion.rest import stacked
from avatar.runs.run import open_trained
from avatar.runs.trained import TrainedAvatar
from avatar.types import HeadParams
from avatar.view.live import Live
from avatar.view.webcam import Webcam
from data_prep.live.follow import CALIBRATION_SECONDS, FaceFollower
from data_prep.live.pictures import LONGEST, LivePicture, Played
from data_prep.track.footage.pictures import open_footage
from data_prep.track.footage.source import Footage, Span, whole

FLAGS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
COMPARED, EVERY, WIDTH, BATCH = (
    150,
    10,
    128,
    25,
)  # frames; one in so many is drawn, so wide; frames handed over at a time
MODULES = """async () => {
  const [{ loadLandmarker }, { FaceDriver, calmFace }, { parse, unpack }] = await Promise.all(
    ["landmarker", "drive", "core"].map((name) => import(`./avatar-view/${name}.js`)));
  const { header } = parse(await unpack(await (await fetch("a.avatar")).arrayBuffer()));
  const worker = new Worker("avatar-view/watcher.js");
  const ask = (message) => new Promise((resolve, reject) => {
    worker.onmessage = ({ data }) => (data.type === "failed" ? reject(new Error(data.reason)) : resolve(data));
    worker.postMessage(message);
  });
  await ask({ type: "load", files: await loadLandmarker(), delegate: "CPU" });
  Object.assign(window, { ask, header, driver: new FaceDriver(header), calmFace, faces: [] });
}"""
LOOK = """async ([pictures, times]) => {
  for (const [i, text] of pictures.entries()) {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const whole = await createImageBitmap(new Blob([bytes], { type: "image/jpeg" }));
    const share = Math.min(320 / Math.max(whole.width, whole.height), 1), small = (length) => Math.round(share * length);
    const size = { resizeWidth: small(whole.width), resizeHeight: small(whole.height), resizeQuality: "low" };
    const picture = await createImageBitmap(whole, size); // as camera.js does without a GPU
    faces.push(await ask({ type: "picture", picture, taken: 1000 * times[i] }));
  }
}"""
DRIVE = """(seconds) => {
  const seen = faces.filter((face) => face.scores), first = seen[0].taken;
  driver.calibrate(calmFace(seen.filter((face) => face.taken - first <= 1000 * seconds)));
  return faces.map((face) => {
    if (!face.scores) return null;
    const { parameters, rotation } = driver.next(face, face.taken / 1000);
    return { parameters: Array.from(parameters), rotation, milliseconds: face.milliseconds };
  });
}"""


def measure_live(trained: TrainedAvatar, video: Path, seconds: float, renderer: str, folder: Path) -> None:
    film = folder / "film.mjpeg"
    words = ["-loglevel", "error", "-y", "-i", str(video), "-pix_fmt", "yuvj420p", "-q:v", "3", str(film)]
    subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), *words], check=True)
    page_file = write_page(trained, folder / "page.html", webcam=True).path
    camera = ("--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream")
    flags = [*FLAGS, *camera, f"--use-file-for-fake-video-capture={film}"]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=flags)
        page = browser.new_context(offline=True, reduced_motion="reduce").new_page()
        page.goto(f"{page_file.as_uri()}?renderer={renderer}")
        page.locator("#message").wait_for(state="hidden", timeout=60000)
        page.evaluate(
            "() => (window.drawn = [], avatar.addEventListener('drawn', ({ detail: { taken } }) => {"
            " if (taken !== undefined && taken !== drawn.at(-1)?.[1]) drawn.push([performance.now(), taken]); }), 0)"
        )
        page.locator("#camera").click()
        page.wait_for_timeout(2000)
        while page.locator("#neutral").is_disabled():
            page.wait_for_timeout(200)
        page.wait_for_timeout(2000)
        page.evaluate("() => void (drawn.length = 0)")
        page.wait_for_timeout(1000 * seconds)
        drawn = np.array(page.evaluate("drawn"))
        figures, width = page.locator("#camera-figures").inner_text(), page.evaluate("avatar.canvas.width")
        browser.close()
    late = drawn[:, 0] - drawn[:, 1]
    rate = 1000 * (len(drawn) - 1) / (drawn[-1, 0] - drawn[0, 0])
    print(f"page     latency {np.median(late):.0f} ms, of 95 in 100 faces below {np.percentile(late, 95):.0f} ms")
    print(f"page     {rate:.1f} a second, {len(drawn)} faces, {width} pixels wide; at the end: {figures}", flush=True)


class OneByOne:
    """Every picture of a video with its own time, in place of the newest one."""

    def __init__(self, footage: Footage, pictures: list[LivePicture]) -> None:
        self.source, self._pictures = Played(footage), iter(pictures)
        self.read = self.dropped = 0

    def start(self) -> None:
        pass

    def close(self) -> None:
        pass

    def take(self) -> LivePicture:
        for picture in self._pictures:
            self.read += 1
            return picture
        raise UserError("the video has ended")


def frames_of(footage: Footage) -> list[LivePicture]:
    rate = footage.rate or 25.0
    wanted = COMPARED + round(rate * CALIBRATION_SECONDS) + 1
    view, found = whole(footage.width, footage.height, LONGEST), []
    for n, picture in enumerate(footage.read(view, Span(), print)):
        if n == wanted:
            break
        found.append(LivePicture(picture.image, 1.0 + n / rate))
    return found


def by_program(trained: TrainedAvatar, head: Path, footage: Footage, frames: list[LivePicture]) -> dict[float, Live]:
    """What `avatar view --webcam` shows, by the frames' times."""
    follower = FaceFollower(Played(footage), trained.assets, head, print)
    follower.pictures = OneByOne(footage, frames)  # type: ignore[assignment]
    webcam = Webcam(trained, follower, lambda _: None)
    webcam._learn(follower.calibrate(lambda _: None))
    shown: dict[float, Live] = {}
    try:
        while True:
            face = follower.follow()
            webcam._take(face)
            if face is not None and (newest := webcam.newest()) is not None:
                shown[face.taken] = newest
    except UserError:
        follower.close()
        return shown


def by_page(trained: TrainedAvatar, frames: list[LivePicture], folder: Path) -> dict[float, dict[str, Any]]:
    """Poses by the frames' times, of the modules that the page runs."""
    shutil.copytree(WEB, folder / "avatar-view")
    write_web_avatar(trained, folder / "a.avatar", "float")
    (folder / "index.html").write_text("<!doctype html>")
    with served(folder) as url, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=list(FLAGS))
        page = browser.new_page()
        page.goto(f"{url}/index.html")
        page.evaluate(MODULES)
        for k in range(0, len(frames), BATCH):
            part = frames[k : k + BATCH]
            page.evaluate(LOOK, [[as_jpeg(frame.image) for frame in part], [frame.taken for frame in part]])
        found = page.evaluate(DRIVE, CALIBRATION_SECONDS)
        browser.close()
    return {frame.taken: each for frame, each in zip(frames, found, strict=True) if each}


@contextlib.contextmanager
def served(folder: Path) -> Iterator[str]:
    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: Any) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()


def as_jpeg(image: np.ndarray) -> str:
    out = io.BytesIO()
    Image.fromarray(image).save(out, "JPEG", quality=95)
    return base64.b64encode(out.getvalue()).decode()


def as_params(trained: TrainedAvatar, kept: Sequence[int], values: list[float]) -> HeadParams:
    """Of the page's parameters, which hold the expressions `kept`."""
    found, E = torch.tensor(values), len(kept)
    expression = torch.zeros(trained.assets.num_expressions)
    expression[list(kept)] = found[:E]
    return HeadParams(
        expression, found[E : E + 6], found[E + 6 : E + 18], found[E + 18 : E + 20], found[E + 20 : E + 26]
    )


def compare(trained: TrainedAvatar, program: dict[float, Live], page: dict[float, dict[str, Any]]) -> None:
    kept, head, rest = reduce_avatar(trained).kept, trained.avatar.head, trained.rest_params()
    times = sorted(set(program) & set(page))
    ours = [program[time].params for time in times]
    theirs = [as_params(trained, kept, page[time]["parameters"]) for time in times]
    own, front = trained.rest_camera().R_cam_world, front_camera(trained).R_cam_world
    turns = [
        [own.T @ (program[time].camera or trained.rest_camera()).R_cam_world for time in times],
        [front.T @ torch.tensor(page[time]["rotation"]).reshape(3, 3) for time in times],
    ]
    pairs = lip_pairs(head.assets)
    local = torch.arange(pairs.numel()).reshape(-1, 2)

    def lips(motion: list[HeadParams]) -> Tensor:
        expression, jaw = stacked(motion)
        return lip_gap(head.still_vertices(expression, jaw, pairs.flatten()), local)

    quantities = {
        "lips' opening": lips,
        "jaw's angle": lambda motion: torch.stack([p.jaw[5] for p in motion]),
        "lids": lambda motion: torch.stack([p.eyelids.mean() for p in motion]),
        "look to the side": lambda motion: torch.stack([p.eyes[2] for p in motion]),
    }
    landmarks = statistics.median(each["milliseconds"] for each in page.values())
    print(f"compared {len(times)} frames; landmarks {landmarks:.0f} ms a picture where nothing is drawn beside")
    for name, of in quantities.items():
        a, b = of(ours).numpy(), of(theirs).numpy()
        print(
            f"  {name}: correlation {correlation(a, b):.2f}, the page goes {b.std() / max(a.std(), 1e-9):.2f} times as far"
        )
    for name, (row, column) in {"head's yaw": (2, 0), "head's pitch": (2, 1), "head's roll": (1, 0)}.items():
        a, b = (np.array([float(R[row, column]) for R in side]) for side in turns)
        apart = np.degrees(np.abs((a - a.mean()) - (b - b.mean())).mean())
        print(f"  {name}: correlation {correlation(a, b):.2f}, {apart:.1f} degrees apart")
    camera = trained.rest_camera(WIDTH)
    still = trained.render(rest, camera).image.clamp(0, 1)
    chosen = range(0, len(times), EVERY)
    drawn = [[trained.render(motion[i], camera).image.clamp(0, 1) for motion in (ours, theirs)] for i in chosen]
    alike = np.mean([psnr(a, b) for a, b in drawn])
    alone = np.mean([psnr(a, still) for a, _ in drawn])
    print(f"  {len(drawn)} pictures {WIDTH} pixels wide: {alike:.1f} dB apart")
    print(f"  the program's pictures from the face at rest: {alone:.1f} dB")


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(a, b)[0, 1]) if a.std() > 0 and b.std() > 0 else float("nan")


def psnr(a: Tensor, b: Tensor) -> float:
    return float(-10 * torch.log10((a - b).square().mean().clamp(min=1e-12)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("video", type=Path)
    parser.add_argument("--head", type=Path)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--renderer", choices=("wasm", "webgl"), default="wasm")
    arguments = parser.parse_args()
    trained = open_trained(arguments.run, arguments.head)
    print(f"{len(trained.avatar):,} Gaussians")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / PACK).write_bytes(make_pack())
        measure_live(trained, arguments.video, arguments.seconds, arguments.renderer, folder)
        footage = open_footage(arguments.video)
        frames = frames_of(footage)
        page = by_page(trained, frames, folder)
        compare(trained, by_program(trained, head_of(arguments, trained), footage, frames), page)


if __name__ == "__main__":
    main()
