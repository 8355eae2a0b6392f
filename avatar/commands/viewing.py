"""avatar view and send: an avatar on the screen, and what drives it live."""

from __future__ import annotations

import functools
import re
import secrets
import time
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from avatar.commands import OK
from avatar.commands.driving import head_of
from avatar.commands.opening import DRIVE_SUFFIXES, open_drive_file, open_run
from avatar.compute.choose import choose_device
from avatar.errors import UserError
from avatar.head.assets import load_head_assets
from avatar.motion.drive_file import read_drive
from avatar.runs.clips import Clip, driven_clip, own_clip
from avatar.runs.run import RUN_FILE, Run, open_trained
from avatar.runs.trained import TrainedAvatar
from avatar.view.gate import LOCAL
from avatar.view.player import Player
from avatar.view.receiver import Receiver
from avatar.view.sender import send
from avatar.view.server import Viewer
from avatar.view.stage import Stage
from avatar.view.webcam import Webcam
from data_prep.live.follow import FaceFollower
from data_prep.live.pictures import open_source

WIDTHS = (64, 2048)
CACHED_PICTURES = 64


def run_view(arguments: Namespace) -> int:
    run = open_with_video(arguments)
    trained = open_trained(arguments.run, arguments.head) if run is None else run.trained
    if arguments.size is not None and not WIDTHS[0] <= arguments.size <= WIDTHS[1]:
        raise UserError(f"--size must be from {WIDTHS[0]} to {WIDTHS[1]}, not {arguments.size}")
    width = arguments.size or min(trained.recording.image_size(trained.config.data.size)[0], WIDTHS[1])
    if arguments.fov is not None and arguments.webcam is None:
        raise UserError("--fov belongs to --webcam: it is the field of view of that camera")
    token = arguments.token
    if token is not None and not re.fullmatch(r"[A-Za-z0-9_-]{8,200}", token):
        raise UserError("--token must be at least 8 letters, digits, - or _")
    if arguments.host not in LOCAL:
        token = token or secrets.token_urlsafe(16)
    motions = clips(trained, arguments.drive)
    trained.avatar.to(choose_device(arguments.device or "auto", print))
    stage = Stage(trained, None if run is None else truth_of(run))
    live = open_live(arguments, trained)
    try:
        newest, name = (None, "") if live is None else (live.newest, live.name)
        player = Player(trained, motions, time.monotonic, newest, name)
        about = (None, None) if live is None else (live.status, live.calibrate)
        viewer = Viewer(stage, player, width, arguments.host, arguments.port, token, *about)
        try:
            shown = "localhost" if arguments.host in LOCAL else arguments.host
            print(f"Open     http://{shown}:{viewer.port}/" + (f"?token={token}" if token else ""), flush=True)
            if isinstance(live, Receiver):
                print(f"Stream   127.0.0.1:{live.port}: lines of JSON (TCP), OSC and Live Link Face (UDP)", flush=True)
            elif live is not None:
                live.start(viewer.wake.set)
            print("Ctrl-C ends it.", flush=True)
            while True:
                time.sleep(3600)
        finally:
            viewer.close()
    finally:
        if live is not None:
            live.close()
    return OK


def open_live(arguments: Namespace, trained: TrainedAvatar) -> Receiver | Webcam | None:
    """What drives the avatar live: nothing, a stream or a face in front of a camera."""
    if arguments.stream is not None:
        return Receiver(trained, arguments.stream)
    if arguments.webcam is None:
        return None

    def say(words: str) -> None:
        print(f"Webcam   {words}", flush=True)

    source = open_source(arguments.webcam)
    say(f"{source.name}, {source.size[0]} x {source.size[1]} pixels")
    try:
        follower = FaceFollower(source, trained.assets, head_of(arguments, trained), say, arguments.fov)
    except BaseException:
        source.close()
        raise
    return Webcam(trained, follower, say)


def open_with_video(arguments: Namespace) -> Run | None:
    """The run with its video, for the truth beside; None where the video is not there."""
    if not (arguments.run / RUN_FILE).is_file():
        return None
    try:
        return open_run(arguments.run, arguments.head, arguments.folder)
    except UserError as error:
        if arguments.folder is not None:
            raise
        print(f"Note: without the truth beside, because {error}", flush=True)
        return None


def clips(trained: TrainedAvatar, drives: list[Path]) -> dict[str, Clip]:
    split = trained.recording.split
    found = {name: own_clip(trained, name) for name in ("test", "train") if len(getattr(split, name))}
    for path in drives:
        if path.suffix.lower() not in DRIVE_SUFFIXES:
            raise UserError(f"--drive takes drive files (.npz, .csv), not {path}")
        found[path.name] = driven_clip(trained, open_drive_file(path, trained))
    return found


def truth_of(run: Run) -> Callable[[int, int], Float[Tensor, "H W 3"]]:
    @functools.lru_cache(CACHED_PICTURES)
    def truth(index: int, width: int) -> Float[Tensor, "H W 3"]:
        return run.subject.frame(index, width).composite(run.trained.background)

    return truth


def run_send(arguments: Namespace) -> int:
    drive = read_drive(arguments.drive, load_head_assets(arguments.head), width=512)
    count = send(drive, "127.0.0.1", arguments.port, arguments.loop)
    print(f"{count} frames of {arguments.drive} sent to port {arguments.port}")
    return OK
