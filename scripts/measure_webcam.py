"""Measure `avatar view RUN --webcam`: latency and rate on a video (docs/bench/view_results.md).

python scripts/measure_webcam.py RUN VIDEO [--head PATH] [--browser]     --browser: with the page open in headless Chromium

A frame's latency is from when its picture is there to when the avatar's picture has been handed to the page's server.
"""

from __future__ import annotations

import argparse
import contextlib
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from avatar.commands.reenact import head_of
from avatar.head.assets import HeadAssets
from avatar.runs.run import open_trained
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.view.live import LiveFrame, LiveTiming
from avatar.view.player import WEBCAM, Player
from avatar.view.view_renderer import ViewRenderer
from avatar.view.viewer import Viewer
from avatar.view.webcam import Webcam
from data_prep.live.face_tracker import LiveFaceTracker
from data_prep.live.frame_fit import FrameFit
from data_prep.live.picture_sources import LONGEST, open_source
from data_prep.track.faces.detect import Face, FaceDetector
from data_prep.track.faces.landmarks import Landmarks
from data_prep.track.fit.camera import Pinhole
from data_prep.track.fit.fit_clip import find_embedding
from data_prep.track.fit.focal import choose_focal
from data_prep.track.fit.landmark_fit import eye_distance, fit_landmarks
from data_prep.track.fit.levenberg_marquardt import concatenated
from data_prep.track.footage.picture_folder import open_footage
from data_prep.track.footage.source import Span, whole

COMPARED = 200  # frames
TOKEN = "measured"


class Record(LiveTiming):
    """Keeps all."""

    def __init__(self) -> None:
        super().__init__()
        self.drawn: list[tuple[float, float]] = []
        self._newest = 0.0

    def add(self, taken: float, now: float) -> None:
        super().add(taken, now)
        if taken != self._newest:
            self._newest = taken
            self.drawn.append((now, now - taken))


@contextlib.contextmanager
def page(port: int, wanted: bool) -> Iterator[None]:
    if not wanted:
        yield
        return
    from playwright.sync_api import sync_playwright

    flags = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=flags)
        shown = browser.new_page(viewport={"width": 800, "height": 600})
        shown.goto(f"http://127.0.0.1:{port}/{TOKEN}/")
        yield
        browser.close()


def measure_live(trained: TrainedAvatar, head: Path, video: Path, with_page: bool) -> None:
    said: list[str] = []
    follower = LiveFaceTracker(open_source(str(video)), trained.assets, head, print)
    webcam = Webcam(trained, follower, said.append)
    parts: list[dict[str, float]] = []

    def newest() -> LiveFrame | None:
        parts.append(dict(follower.milliseconds))
        return webcam.newest()

    player = Player(trained, {}, time.monotonic, newest, WEBCAM)
    viewer = Viewer(ViewRenderer(trained), player, trained.rest_camera().width, "127.0.0.1", 0, TOKEN)
    viewer.timing = record = Record()
    drawing: list[float] = []
    with page(viewer.port, with_page):
        webcam.start(viewer.wake.set)
        while not said or "ended" not in said[-1]:
            time.sleep(0.2)
            drawing.append(viewer.milliseconds)
        width = 0 if viewer.picture is None else viewer.picture.shape[1]
        webcam.close()
        viewer.close()
    late = 1000 * np.array([seconds for _, seconds in record.drawn])
    times = np.array([when for when, _ in record.drawn])
    dropped, count = follower.dropped()
    print(f"{'with the page in Chromium' if with_page else 'without a browser'}: {said[-1]}")
    print(f"  latency {np.median(late):.0f} ms, of 95 in 100 frames below {np.percentile(late, 95):.0f} ms")
    print(
        f"  rate {(len(times) - 1) / (times[-1] - times[0]):.1f} a second, {len(times)} frames, up to {width} pixels wide"
    )
    for name in ("landmarks", "fit"):
        print(f"  {name} {np.median([part[name] for part in parts if name in part]):.1f} ms")
    print(
        f"  drawing {np.median(drawing):.1f} ms; {dropped} of {count} pictures dropped, most of them while calibrating"
    )


def measure_fit(assets: HeadAssets, head: Path, video: Path) -> None:
    """The frame-by-frame fit beside the fit of the whole clip, on the same landmarks."""
    footage = open_footage(video)
    faces = list(_faces(footage, lambda pictures: pictures))[:COMPARED]
    view = whole(footage.width, footage.height, LONGEST)
    size, fps = (view.width, view.height), footage.rate or 25.0
    points = np.stack([face.points for face in faces])
    seen = Landmarks(points, np.stack([face.scores for face in faces]), np.ones(len(faces), bool), size, fps)
    focal = choose_focal(*size, points, equivalent=footage.equivalent_focal).pixels
    camera = Pinhole(focal, focal, size[0] / 2, size[1] / 2)
    embedding = find_embedding(head, assets)
    clip = fit_landmarks(assets, embedding, seen, camera)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # as the viewer does
    live = FrameFit(assets, embedding, clip, camera, size)
    begin = time.perf_counter()
    motions = [live.next(face, n / fps) for n, face in enumerate(faces)]
    each = 1000 * (time.perf_counter() - begin) / len(faces)
    torch.set_num_threads(threads)
    alone = concatenated([motion for motion in motions if motion is not None])
    eyes = float((eye_distance(assets) * focal / clip.motion.t[:, 2]).mean()) / 100
    print(f"frame by frame, {len(faces)} frames, {each:.1f} ms each")
    for words, motion in (("whole clip", clip.motion), ("frame by frame", alone)):
        error = float(clip.term.errors(clip.identity, motion).mean()) / eyes
        jitter = float(motion.expression.diff(n=2, dim=0).square().mean().sqrt())
        print(
            f"  {words}: landmark error {error:.2f} % of the eyes' distance, expression's second differences {jitter:.4f}"
        )
    apart = float((alone.expression - clip.motion.expression).square().mean().sqrt())
    spread = float(clip.motion.expression.std(0).square().mean().sqrt())
    angle = (alone.R @ clip.motion.R.transpose(1, 2)).diagonal(dim1=1, dim2=2).sum(1)
    degrees = torch.rad2deg(torch.arccos(((angle - 1) / 2).clamp(-1, 1))).mean()
    print(f"  apart: expression {apart:.3f} (its own spread is {spread:.3f}), head {float(degrees):.2f} degrees")


def _faces(footage: Any, progress: Callable[[Iterable[Any]], Iterable[Any]]) -> Iterator[Face]:
    view = whole(footage.width, footage.height, LONGEST)
    with FaceDetector() as detector:
        for n, picture in enumerate(progress(footage.read(view, Span(), print))):
            if n == COMPARED:
                return
            if found := detector.find(picture.image):
                yield found[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("video", type=Path)
    parser.add_argument("--head", type=Path)
    parser.add_argument("--browser", action="store_true")
    arguments = parser.parse_args()
    trained = open_trained(arguments.run, arguments.head)
    head = head_of(arguments, trained)
    print(f"{len(trained.avatar)} Gaussians")
    measure_fit(trained.assets, head, arguments.video)
    measure_live(trained, head, arguments.video, arguments.browser)


if __name__ == "__main__":
    main()
