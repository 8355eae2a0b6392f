"""The exported page driven by a camera, in headless Chromium: a film stands for the camera, a fake for the landmarker.

The fake goes the whole way that MediaPipe's own files go in test_mediapipe_pack.py.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from browsers import WEB, camera_flags, chromium, chromium_path, launched, served
from lively import lively_avatar, psnr
from pages import says, shown, until

from avatar.export.mediapipe_pack import PACK, encode_pack
from avatar.export.web_page import write_page, write_web_avatar
from avatar.runs.trained_avatar import TrainedAvatar

FAKE = {
    "vision_bundle.mjs": (Path(__file__).parent / "fake_landmarker.mjs").read_bytes(),
    "vision_wasm_internal.js": b"loader",
    "vision_wasm_internal.wasm": b"binary",
    "face_landmarker.task": b"model",
}
FPS, WIDTH, HEIGHT = 10, 352, 64
CALM, BRIGHT, DARK = 80, 230, 20  # luminances of the film: a calm face, a wide mouth, nobody
FOLLOWS, NOBODY = "The avatar follows you.", "There is no face in the picture."


def film(path: Path, levels: list[int]) -> Path:
    """A .y4m of grey pictures."""
    header = f"YUV4MPEG2 W{WIDTH} H{HEIGHT} F{FPS}:1 Ip A1:1 C420jpeg\n".encode()
    chroma = bytes([128]) * (WIDTH * HEIGHT // 2)
    path.write_bytes(header + b"".join(b"FRAME\n" + bytes([level]) * (WIDTH * HEIGHT) + chroma for level in levels))
    return path


def knowing(text: str, files: dict[str, bytes]) -> str:
    """A page, or a module, that takes these files for the landmarker's."""
    for name, data in files.items():
        text, count = re.subn(rf'("{name}": ")[0-9a-f]{{64}}"', rf'\g<1>{hashlib.sha256(data).hexdigest()}"', text)
        assert count == 1, name
    return text


@pytest.fixture(scope="module")
def trained(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainedAvatar:
    return lively_avatar(tracked_folder, tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture(scope="module")
def page_text(trained: TrainedAvatar, tmp_path_factory: pytest.TempPathFactory) -> str:
    path = write_page(trained, tmp_path_factory.mktemp("page") / "someone.html", "float", webcam=True).path
    return knowing(path.read_text(encoding="utf-8"), FAKE)


@pytest.fixture
def folder(page_text: str, tmp_path: Path) -> Path:
    """The page and the fake beside it."""
    (tmp_path / "someone.html").write_text(page_text, encoding="utf-8")
    (tmp_path / PACK).write_bytes(encode_pack(FAKE))
    return tmp_path


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    levels = [CALM] * 6 * FPS + [BRIGHT] * 2 * FPS + [DARK] * 2 * FPS
    with chromium(*camera_flags(film(tmp_path_factory.mktemp("film") / "film.y4m", levels))) as opened:
        yield opened


@pytest.fixture
def open_page(browser: Any) -> Iterator[Callable[[str], Any]]:
    """Opens an address; errors on the console and requests that leave the machine fail the test."""
    wrong: list[str] = []
    pages = []

    def opened(url: str, script: str | None = None) -> Any:
        page = browser.new_page(reduced_motion="reduce", viewport={"width": 1100, "height": 760})
        pages.append(page)
        page.on("pageerror", lambda error: wrong.append(str(error)))
        local = ("file:", "blob:", "data:", "http://127.0.0.1:")
        page.on("request", lambda request: None if request.url.startswith(local) else wrong.append(request.url))
        if script:
            page.add_init_script(script)
        page.goto(url)
        page.locator("#message").wait_for(state="hidden", timeout=20000)
        return page

    yield opened
    for page in pages:
        page.close()
    assert not wrong


def address(folder: Path) -> str:
    return f"{(folder / 'someone.html').as_uri()}?width=64"


def is_off(page: Any) -> bool:
    button = page.locator("#camera").inner_text() == "Drive with your camera"
    return button and page.evaluate("document.getElementById('video').srcObject === null")


@pytest.mark.chromium
def test_a_face_drives_the_page_from_a_file(open_page: Callable[..., Any], folder: Path) -> None:
    page = open_page(address(folder))
    before = shown(page)
    page.get_by_role("button", name="Drive with your camera").click()
    says(page, "Look into the camera for a moment, calmly")
    assert page.locator("#video").is_visible() and page.get_by_role("button", name="Stop the camera").is_visible()
    assert page.locator("#neutral").is_disabled()
    says(page, f"{FOLLOWS} Its head model names no expressions")
    assert page.evaluate("avatar.motion") in ("driven", "rest")
    assert psnr(shown(page), before) > 35, "a calm face is the neutral one"
    assert page.evaluate("avatar.header.drive.high[avatar.header.sizes.expressions]") > 0.02, "training opened the jaw"
    until(page, f"({DIFFERENCE})({json.dumps(picture(page))}) > 3 || avatar.motion !== 'driven'")
    assert page.evaluate("avatar.motion") == "driven", "the wide mouth shows"
    says(page, NOBODY)
    figures = "document.getElementById('camera-figures').textContent"
    says(page, FOLLOWS)
    until(page, f"/^\\d+ ms from your face to the picture, \\d+ a second; landmarks \\d+ ms$/.test({figures})")
    page.locator("#small").uncheck()
    assert not page.locator("#video").is_visible()
    page.get_by_role("button", name="Stop the camera").click()
    assert is_off(page) and not page.locator("#video").is_visible() and page.evaluate(figures) == ""
    until(page, "avatar.motion === 'rest'")


DIFFERENCE = """(before) => {
  const { data } = avatar.canvas.getContext("2d").getImageData(0, 0, 64, 64);
  return before.reduce((sum, value, i) => sum + Math.abs(value - data[4 * i]), 0) / before.length;
}"""


def picture(page: Any) -> list[int]:
    """The red values of the canvas."""
    return (shown(page)[..., 0] * 255).round().int().flatten().tolist()


@pytest.mark.chromium
def test_over_http_and_with_something_else_played(open_page: Callable[..., Any], folder: Path) -> None:
    with served(folder) as url:
        page = open_page(f"{url}/someone.html?width=64")
        page.get_by_role("button", name="Drive with your camera").click()
        says(page, FOLLOWS)
        page.locator("#neutral").click()
        assert page.locator("#video.mirror").is_visible()
        page.locator("#mirror").uncheck()
        assert page.locator("#video.mirror").count() == 0
        says(page, FOLLOWS)
        page.get_by_role("button", name="Play", exact=True).click()
        until(page, "document.getElementById('camera').textContent === 'Drive with your camera'")
        assert is_off(page) and page.evaluate("avatar.isPlaying"), "one motion at a time"


@pytest.mark.chromium
def test_a_page_without_its_landmarker_takes_a_chosen_one(open_page: Callable[..., Any], folder: Path) -> None:
    (folder / PACK).rename(folder / "elsewhere.js")
    page = open_page(address(folder))
    assert not page.locator("#chooser").is_visible()
    page.locator("#camera").click()
    says(page, f"{PACK} is not beside this page")
    assert page.locator("#chooser").is_visible() and is_off(page)
    (folder / "wrong.js").write_bytes(encode_pack(FAKE | {"face_landmarker.task": b"another"}))
    (folder / "old.js").write_bytes(encode_pack(FAKE, "0.10.20"))
    (folder / "less.js").write_bytes(
        encode_pack({**FAKE, "vision_bundle.mjs": b""}).replace(b"vision_bundle.mjs", b"x")
    )
    (folder / "text.js").write_text("alert(1)")
    (folder / "call.js").write_text("avatarLandmarker(null);")
    for name, sentence in (
        ("wrong.js", "The landmarker's face_landmarker.task is another one than this page knows"),
        ("old.js", "The landmarker is of version 0.10.20, this page takes 0.10.21"),
        ("less.js", "The landmarker's vision_bundle.mjs is missing or damaged"),
        ("text.js", f"text.js is not {PACK}, or it is damaged."),
        ("call.js", f"call.js is not {PACK}, or it is damaged."),
    ):
        page.locator("#pack").set_input_files(folder / name)
        says(page, sentence)
        assert is_off(page)
    drop = """(text) => {
      const carried = new DataTransfer();
      carried.items.add(new File([text], "dropped.js"));
      const drop = new DragEvent("drop", { dataTransfer: carried, cancelable: true });
      document.getElementById("camera-card").dispatchEvent(drop);
    }"""
    page.evaluate(drop, "dropped")
    says(page, f"dropped.js is not {PACK}")
    page.locator("#pack").set_input_files(folder / "elsewhere.js")
    says(page, FOLLOWS)
    assert not page.locator("#chooser").is_visible()


WITHOUT_FILES = """(() => {
  const post = Worker.prototype.postMessage;
  Worker.prototype.postMessage = function (message) { post.call(this, { ...message, files: message.files && {} }); };
})()"""


INSECURE = """delete Navigator.prototype.mediaDevices;
Object.defineProperty(crypto, "subtle", { value: undefined });"""


@pytest.mark.chromium
@pytest.mark.parametrize(
    ("script", "sentence"),
    [
        (INSECURE, "gives a page at such an address no camera"),
        (
            "navigator.mediaDevices.getUserMedia = async () => { throw new DOMException('', 'NotAllowedError'); }",
            "The camera was not allowed.",
        ),
        (
            "navigator.mediaDevices.getUserMedia = async () => { throw new DOMException('', 'NotReadableError'); }",
            "The camera is in use by another program, or does not work.",
        ),
        ("delete HTMLVideoElement.prototype.requestVideoFrameCallback", "This browser is too old to follow a face."),
        (WITHOUT_FILES, "The landmarker cannot be started in this browser ("),
    ],
)
def test_what_fails_is_said(open_page: Callable[..., Any], folder: Path, script: str, sentence: str) -> None:
    page = open_page(address(folder), script)
    page.locator("#camera").click()
    says(page, sentence)
    assert is_off(page)


@pytest.mark.chromium
def test_a_camera_that_is_unplugged_and_one_that_is_not_there(
    browser: Any, open_page: Callable[..., Any], folder: Path
) -> None:
    page = open_page(address(folder))
    page.locator("#camera").click()
    says(page, "calmly")
    page.evaluate("document.getElementById('video').srcObject.getTracks()[0].dispatchEvent(new Event('ended'))")
    says(page, "The camera has stopped.")
    assert is_off(page)
    with launched(browser.browser_type, chromium_path(), ["--use-fake-ui-for-media-stream"]) as bare:
        page = bare.new_page()
        page.goto(address(folder))
        page.locator("#message").wait_for(state="hidden", timeout=20000)
        page.locator("#camera").click()
        says(page, "There is no camera on this machine.")
        page.close()


@pytest.mark.chromium
def test_the_element_is_driven(browser: Any, trained: TrainedAvatar, tmp_path: Path) -> None:
    shutil.copytree(WEB, tmp_path / "avatar-view")
    module = tmp_path / "avatar-view" / "landmarker.js"
    module.write_text(knowing(module.read_text(), FAKE))
    write_web_avatar(trained, tmp_path / "someone.avatar", "float")
    (tmp_path / PACK).write_bytes(encode_pack(FAKE))
    (tmp_path / "index.html").write_text(
        '<!doctype html><script type="module" src="avatar-view/index.js"></script><avatar-view src="someone.avatar">'
    )
    with served(tmp_path) as url:
        page = browser.new_page(reduced_motion="reduce")
        page.goto(f"{url}/index.html")
        until(page, "(window.element = document.querySelector('avatar-view')).view?.header")
        page.evaluate("(window.avatar = element.view).resize(64)")
        wide = "element.drive({ jawOpen: 1, mouthSmileLeft: 1 }, null)"
        page.evaluate(wide)
        assert page.evaluate("avatar.motion") == "driven"
        refused = "(() => { try { element.drive({ jawOpen: NaN }); } catch (e) { return e.message; } })()"
        assert page.evaluate(refused) == "A face is scores by name and 16 numbers of its pose."
        page.evaluate("element.startCamera().then(camera => (window.camera = camera))")
        until(page, "window.camera?.state === 'following'")
        until(page, "camera.statistics.framesPerSecond > 1 && camera.statistics.latency > 0")
        page.evaluate("element.stopCamera()")
        assert page.evaluate("[camera.state, avatar.motion]") == ["off", "rest"]
        gone = page.evaluate("element.startCamera('gone.js').catch(e => e.message)")
        assert gone.startswith(f"{PACK} is not beside this page")
        page.close()
