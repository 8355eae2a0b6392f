"""avatar view: an avatar on the screen, and what drives it live."""

from __future__ import annotations

import functools
import os
import re
import secrets
import socket
import threading
import time
import urllib.parse
from argparse import Namespace
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from jaxtyping import Float
from torch import Tensor

from avatar.commands.reenact import head_of
from avatar.errors import UserError, check_installed
from avatar.files.names import as_text
from avatar.pipeline import INTERRUPTED, OK
from avatar.pipeline.choose_device import choose_device
from avatar.pipeline.open_inputs import DRIVE_SUFFIXES, open_drive_file, open_run
from avatar.runs.motion_clip import Clip, driven_clip, own_clip
from avatar.runs.run import RUN_FILE, Run, open_trained
from avatar.runs.trained_avatar import TrainedAvatar, avatar_path
from avatar.runs.training_curves import read_curves
from avatar.view.auth import LOCAL
from avatar.view.newest_checkpoint import NewestAvatar, progress
from avatar.view.player import Player
from avatar.view.receiver import Receiver
from avatar.view.view_renderer import ViewRenderer
from avatar.view.webcam import Webcam
from data_prep.live.face_tracker import LiveFaceTracker
from data_prep.live.picture_sources import open_source

if TYPE_CHECKING:
    from avatar.view.viewer import Viewer

WIDTHS = (64, 2048)
CACHED_PICTURES = 64
EVERY_ADDRESS = ("0.0.0.0", "::", "")
END_SECONDS = 5.0  # after Ctrl-C
POLL_SECONDS = 1.0


def run_view(arguments: Namespace) -> int:
    newest = NewestAvatar(avatar_path(arguments.run))
    run = open_with_video(arguments)
    trained = open_trained(arguments.run, arguments.head) if run is None else run.trained
    if arguments.size is not None and not WIDTHS[0] <= arguments.size <= WIDTHS[1]:
        raise UserError(f"--size must be from {WIDTHS[0]} to {WIDTHS[1]}, not {arguments.size}")
    width = arguments.size or min(trained.recording.image_size(trained.config.data.size)[0], WIDTHS[1])
    if arguments.open_stream and arguments.stream is None:
        raise UserError("--open-stream belongs to --stream")
    if arguments.fov is not None and arguments.webcam is None:
        raise UserError("--fov belongs to --webcam: it is the field of view of that camera")
    url = None if arguments.url is None else checked_url(arguments.url)
    token = checked_token(arguments.token) or secrets.token_hex(16)
    check_installed("avatar view", "view", "viser")
    from avatar.view.viewer import Viewer

    motions = clips(trained, arguments.drive)
    trained.avatar.to(choose_device(arguments.device or "auto", print))
    renderer = ViewRenderer(trained, None if run is None else truth_of(run))
    live = open_live(arguments, trained, token)
    try:
        frames, name = (None, "") if live is None else (live.newest, live.name)
        player = Player(trained, motions, time.monotonic, frames, name)
        about = (None, None) if live is None else (live.status, live.calibrate)
        viewer = Viewer(renderer, player, width, arguments.host, arguments.port, token, url, *about)
        try:
            print(f"Open     {address(arguments.host, viewer.port, url)}?token={token}", flush=True)
            if isinstance(live, Receiver):
                print(f"Stream   {about_stream(live.port, None if arguments.open_stream else token)}", flush=True)
            elif live is not None:
                live.start(viewer.wake.set)
            print("Ctrl-C ends it.", flush=True)
            follow(viewer, newest, arguments)
        except KeyboardInterrupt:
            end = threading.Timer(END_SECONDS, os._exit, (INTERRUPTED,))  # whatever a library's thread still waits for
            end.daemon = True
            end.start()
            raise
        finally:
            viewer.close()
    finally:
        if live is not None:
            live.close()
    return OK


def follow(viewer: Viewer, newest: NewestAvatar, arguments: Namespace) -> None:
    """Show each newer avatar of a run and how far its training is, for ever."""
    shown = viewer.renderer.trained
    run = shown.source.parent
    viewer.panel.draw_curves(read_curves(run), shown.step < shown.config.trainer.iterations)
    while True:
        viewer.progress = progress(shown, run)
        time.sleep(POLL_SECONDS)
        if (newer := newest.poll(shown, lambda: open_trained(arguments.run, arguments.head))) is not None:
            viewer.follow(shown := newer)
            viewer.panel.draw_curves(read_curves(run), True)


def checked_token(given: str | None) -> str | None:
    """That of the command line or of $AVATAR_TOKEN. Raises UserError when it is not one."""
    token = given or os.environ.get("AVATAR_TOKEN")
    if token is not None and not re.fullmatch(r"[A-Za-z0-9_-]{8,200}", token):
        raise UserError("--token (or $AVATAR_TOKEN) must be at least 8 letters, digits, - or _")
    return token


def checked_url(given: str) -> str:
    """Raises UserError when it is no address of a page."""
    try:
        parts = urllib.parse.urlsplit(given)
        is_page = parts.scheme in ("http", "https") and parts.hostname and not (parts.query or parts.fragment)
    except ValueError:
        is_page = False
    if not is_page:
        raise UserError("--url takes the address that a proxy shows, such as https://hub.example.org/proxy/8080/")
    return given.rstrip("/") + "/"


def address(host: str, port: int, url: str | None = None) -> str:
    """What to open in a browser; for a viewer that listens everywhere, the address by which others find this machine."""
    if url is not None:
        return url
    if host in EVERY_ADDRESS:
        host = socket.gethostname()
        with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect(("192.0.2.1", 9))  # sends nothing; the system chooses the address to send from
            host = probe.getsockname()[0]
    elif host in LOCAL:
        host = (
            "[::1]" if ":" in host else "127.0.0.1"
        )  # a name could lead to another address, and other people's program
    return f"http://[{host}]:{port}/" if ":" in host and "[" not in host else f"http://{host}:{port}/"


def about_stream(port: int, token: str | None) -> str:
    if token is None:
        return f"127.0.0.1:{port}: lines of JSON (TCP), OSC and Live Link Face (UDP), from everybody on this machine"
    return f'127.0.0.1:{port}: {{"token": "{token}"}}, then lines of JSON (TCP)'


def open_live(arguments: Namespace, trained: TrainedAvatar, token: str) -> Receiver | Webcam | None:
    """What drives the avatar live: nothing, a stream or a face in front of a camera."""
    if arguments.stream is not None:
        return Receiver(trained, arguments.stream, None if arguments.open_stream else token)
    if arguments.webcam is None:
        return None

    def say(words: str) -> None:
        print(f"Webcam   {words}", flush=True)

    source = open_source(arguments.webcam)
    say(f"{source.name}, {source.size[0]} x {source.size[1]} pixels")
    try:
        follower = LiveFaceTracker(source, trained.assets, head_of(arguments, trained), say, arguments.fov)
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
            raise UserError(f"--drive takes drive files (.npz, .csv, .json), not {path}")
        name = as_text(path.name if as_text(path.name) not in found else str(path.absolute()))
        found[name] = driven_clip(trained, open_drive_file(path, trained))
    return found


def truth_of(run: Run) -> Callable[[int, int], Float[Tensor, "H W 3"]]:
    @functools.lru_cache(CACHED_PICTURES)
    def truth(index: int, width: int) -> Float[Tensor, "H W 3"]:
        return run.subject.frame(index, width).composite(run.trained.background)

    return truth
