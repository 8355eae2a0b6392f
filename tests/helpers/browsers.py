"""Node and Chromium for tests of what runs in browsers; a test is skipped with the reason where one of them is missing."""

from __future__ import annotations

import contextlib
import functools
import http.server
import json
import os
import shutil
import subprocess
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

WEB = Path(__file__).resolve().parents[2] / "avatar" / "web"
# Chromium's own software renderer, so that machines with a GPU and without see the same.
FLAGS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def node(script: Path, *arguments: object, timeout: float = 120.0) -> Any:
    """What a script prints as JSON; `WEB` is its first argument."""
    found = shutil.which("node")
    if found is None:
        pytest.skip("node is not installed (Debian: apt install nodejs)")
    words = [found, "--no-warnings", str(script), WEB.as_uri(), *map(str, arguments)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=timeout)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def chromium_path() -> str:
    path = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("Chromium is not installed (Debian: apt install chromium), nor named by $CHROMIUM")
    return path


@contextlib.contextmanager
def chromium(*flags: str) -> Iterator[Any]:
    """A headless browser of Playwright's, with more flags than `FLAGS`."""
    path = chromium_path()
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as started, launched(started.chromium, path, flags) as browser:
        yield browser


@contextlib.contextmanager
def launched(kind: Any, path: str, flags: Sequence[str]) -> Iterator[Any]:
    """A browser of a kind that Playwright has started."""
    browser = kind.launch(executable_path=path, args=[*FLAGS, *flags])
    try:
        yield browser
    finally:
        browser.close()


def camera_flags(film: Path) -> tuple[str, ...]:
    """A camera that plays a .y4m or .mjpeg again and again, and that every page may use."""
    return (
        "--use-fake-device-for-media-stream",
        "--use-fake-ui-for-media-stream",
        f"--use-file-for-fake-video-capture={film}",
    )


@contextlib.contextmanager
def served(folder: Path) -> Iterator[str]:
    """The URL of a folder on a server of this machine."""

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
