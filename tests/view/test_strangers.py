"""What a page of another site and another user of this machine can do to the viewer and its stream."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("viser")
from browsers import chromium, served
from lively import lively_run
from view_client import TOKEN, WIDTH, Page, Started, started
from waiting import until

from avatar.runs.trained_avatar import TrainedAvatar
from avatar.view.player import Player
from avatar.view.receiver import Receiver
from avatar.view.view_renderer import ViewRenderer
from avatar.view.viewer import Viewer

FRAME = b'{"expression": [0.5]}\n'

# A page that tries everything, and says what it got.
HOSTILE = """<!doctype html><script>
const [viewer, stream, token] = location.hash.slice(1).split(",");
const got = [], wait = [];
const socket = url => new Promise(end => {
  const tried = new WebSocket(url, ["viser-v%VERSION%"]);
  tried.onmessage = tried.onopen = () => { got.push("socket " + url); end(); };
  tried.onclose = tried.onerror = end;
});
const asked = (url, options) => fetch(url, options).then(r => r.text())
  .then(text => { if (text) got.push("text " + url); }).catch(() => 0);
for (const port of [viewer, stream])
  for (const path of ["/", `/${token}/`, `/?token=${token}`]) {
    const place = `127.0.0.1:${port}${path}`;
    wait.push(socket("ws://" + place), asked("http://" + place), asked("http://" + place, {credentials: "include"}));
    for (const mode of ["cors", "no-cors"])
      wait.push(asked("http://" + place, {mode, method: "POST", body: %BODY%}));
  }
wait.push(asked(`http://127.0.0.1:${stream}/${"a".repeat(70000)}`, {mode: "no-cors", method: "POST", body: %BODY%}));
Promise.all(wait).then(() => { window.got = got; });
</script>"""

# Gives up its rights, then tries every port.
OTHER_USER = """
import encodings.idna, json, os, socket, sys
os.setgroups([]); os.setgid(65534); os.setuid(65534)
pid, ports = sys.argv[1], list(map(int, sys.argv[2:]))
told = {"command": open(f"/proc/{pid}/cmdline").read(), "answers": []}
try:
    told["environment"] = open(f"/proc/{pid}/environ").read()
except PermissionError:
    pass
upgrade = ("GET / HTTP/1.1\\r\\nHost: 127.0.0.1:%d\\r\\nUpgrade: websocket\\r\\nConnection: Upgrade\\r\\n"
           "Sec-WebSocket-Version: 13\\r\\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\\r\\n\\r\\n")
for port in ports:
    for data in ("GET / HTTP/1.1\\r\\nHost: 127.0.0.1:%d\\r\\n\\r\\n" % port, upgrade % port, '{"expression": [1]}\\n' * 2,
                 '{"token": "guessed"}\\n{"expression": [1]}\\n'):
        with socket.create_connection(("127.0.0.1", port), timeout=5) as client:
            client.sendall(data.encode())
            client.shutdown(socket.SHUT_WR)
            try:
                told["answers"].append(client.recv(1000).decode("latin-1"))
            except ConnectionError:
                told["answers"].append("")
print(json.dumps(told))
"""


@pytest.fixture(scope="module")
def command(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Started]:
    folder = tmp_path_factory.mktemp("strangers")
    run = lively_run(tracked_folder, folder / "run", "model.uv_size=8")
    with started(run, "--stream", 0, "--size", 64, log=folder / "stderr") as viewer:
        yield viewer
        assert "Traceback" not in (folder / "stderr").read_text()


def hostile_page(folder: Path) -> str:
    import viser

    body = json.dumps("\n" + FRAME.decode() * 3)
    (folder / "index.html").write_text(HOSTILE.replace("%VERSION%", viser.__version__).replace("%BODY%", body))
    return "/index.html"


def got(page: Any, address: str) -> list[str]:
    page.goto(address)
    page.wait_for_function("window.got", timeout=60000)
    return page.evaluate("window.got")


def frames(page: Page) -> str:
    page.values.clear()
    page.until(lambda: " frames, " in str(page.values), 5)
    return str(page.values)


@pytest.mark.chromium
def test_a_page_of_another_site_gets_nothing(command: Started, tmp_path: Path) -> None:
    """Even one that is served from this machine, knows the token, and runs in the browser that shows the viewer."""
    path = hostile_page(tmp_path)
    with chromium() as browser, served(tmp_path) as site:
        shared = browser.new_context()
        shared.new_page().goto(command.address)
        assert got(shared.new_page(), f"{site}{path}#{command.port},{command.stream},{command.token}") == []
    with Page(command.page) as page:
        page.next_picture()
        page.until(lambda: "Stream" in page.controls)
        with socket.create_connection(("127.0.0.1", command.stream)) as sender:
            sender.sendall(json.dumps({"token": command.token}).encode() + b"\n" + FRAME)
            page.until(lambda: ": 1 frames, " in str(page.values))


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="only root can act as another user")
def test_another_user_of_this_machine_gets_nothing(command: Started) -> None:
    ports = command.listening()
    assert ports == {command.port, command.stream}
    words = [sys.executable, "-c", OTHER_USER, str(command.process.pid), *map(str, sorted(ports))]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=True)
    told = json.loads(done.stdout)
    assert command.token not in told["command"] and "environment" not in told
    assert len(told["answers"]) == 8 and {answer[:12] for answer in told["answers"]} <= {"", "HTTP/1.1 401"}
    with Page(command.page) as page:
        page.next_picture()


@pytest.fixture
def open_stream(shown_avatar: TrainedAvatar) -> Iterator[tuple[Viewer, Receiver]]:
    receiver = Receiver(shown_avatar, 0)
    player = Player(shown_avatar, {}, time.monotonic, receiver.newest)
    viewer = Viewer(ViewRenderer(shown_avatar), player, WIDTH, "127.0.0.1", 0, TOKEN, None, receiver.status)
    yield viewer, receiver
    viewer.close()
    receiver.close()


@pytest.mark.chromium
def test_what_strangers_send_is_shown_as_plain_text(open_stream: tuple[Viewer, Receiver], tmp_path: Path) -> None:
    """Not as HTML, not as Markdown, in which viser shows files of this machine."""
    viewer, receiver = open_stream
    secret, fifo = tmp_path / "secret.png", tmp_path / "fifo"
    secret.write_bytes(b"\x89PNG secret")
    os.mkfifo(fifo)
    names = "<img src=x onerror=pwned=1>", "<b>B</b>", f"![]({fifo.name})", f"![]({secret.name})", "**bold**"
    with chromium() as browser:
        page = browser.new_page(viewport={"width": 1000, "height": 700})
        page.goto(f"http://127.0.0.1:{viewer.port}/?token={TOKEN}")
        field = page.locator("textarea").first
        field.wait_for(timeout=30000)
        for count, name in enumerate(names, 1):
            with socket.create_connection(("127.0.0.1", receiver.port)) as sender:
                sender.sendall(json.dumps({"expression": {name: 1}}).encode() + b"\n")
            until(lambda: receiver.counts.malformed == count)  # noqa: B023
            page.wait_for_function("text => document.querySelector('textarea').value.includes(text)", arg=name[:40])
            assert name[:40] in field.input_value()
        assert page.evaluate("window.pwned === undefined && !document.querySelector('img[src=x], img[src*=png]')")
        with socket.create_connection(("127.0.0.1", receiver.port)) as sender:
            sender.sendall(FRAME)
            until(lambda: receiver.counts.received == 1)
        page.wait_for_function("document.querySelector('textarea').value.includes(': 1 frames, ')")


@pytest.mark.chromium
def test_a_page_cannot_post_to_an_open_stream(open_stream: tuple[Viewer, Receiver], tmp_path: Path) -> None:
    viewer, receiver = open_stream
    path = hostile_page(tmp_path)
    with chromium() as browser, served(tmp_path) as site:
        assert got(browser.new_page(), f"{site}{path}#{viewer.port},{receiver.port},guessed") == []
    assert receiver.counts.received == 0 and receiver.counts.malformed > 10
    assert "web pages may not send frames" in receiver.status()
