"""The avatar of browsers, in node: it draws what the program draws, and damaged files get a sentence."""

from __future__ import annotations

import hashlib
import json
import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from browsers import WEB, node
from lively import lively_avatar, psnr

from avatar.errors import UserError
from avatar.export.default_view import with_faded_neck
from avatar.export.web_page import write_web_avatar
from avatar.motion.orbit import orbited
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.types import Camera, HeadParams

pytestmark = pytest.mark.slow

HERE = Path(__file__).parent
SIZE = 64
MODELS = {
    "grid": ("model=hypergaussians",),
    "no grid": ("model=hypergaussians", "model.latent_grid=null"),
    "no HyperGaussians": ("model=flashavatar",),
    "covariance": ("model=covariance",),
    "detail": ("model.uv_detail=2",),
    "skull binding": ("model.skull_binding=true",),
    "head rotation": ("model.head_rotation=true",),
    "blur": ("model.blur=1.5",),
    "teeth": ("model.teeth=true",),
}


def parameters(params: HeadParams, trained: TrainedAvatar) -> list[float]:
    """In the file's order; the small subject moves every coefficient."""
    return torch.cat((params.expression, params.jaw, params.eyes, params.eyelids, params.neck)).tolist()


def described(camera: Camera) -> dict[str, object]:
    return {
        "rotation": camera.R_cam_world.flatten().tolist(),
        "translation": camera.t_cam_world.tolist(),
        **{name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")},
    }


def chosen_frames(trained: TrainedAvatar) -> list[tuple[HeadParams, Camera]]:
    """Frames of the video, some of them seen from beside, from above and from near, every other one with a turned neck."""
    recording, frames = trained.recording, []
    for i in range(20):
        camera = recording.camera(i, SIZE)
        params = recording.params(i)
        if i % 2:
            params = replace(params, neck=torch.tensor([1.0, -0.1, 0.3, 0.1, 1.0, 0.0]))
        frames.append((params, orbited(camera, 4.0 * (i % 5) - 8, 3.0 * (i % 3), 1.0 + 0.2 * (i % 2))))
    return frames


def drawn_by_node(trained: TrainedAvatar, precision: str, folder: Path) -> torch.Tensor:
    write_web_avatar(trained, folder / "a.avatar", precision)  # type: ignore[arg-type]
    return pictures_of_node(trained, folder)


def pictures_of_node(trained: TrainedAvatar, folder: Path) -> torch.Tensor:
    frames = [
        {"parameters": parameters(p, trained), "camera": described(c), "width": c.width, "height": c.height}
        for p, c in chosen_frames(trained)
    ]
    (folder / "frames.json").write_text(json.dumps(frames))
    node(HERE / "draw.mjs", folder / "a.avatar", folder / "frames.json", folder / "out.rgba")
    pixels = np.fromfile(folder / "out.rgba", np.uint8).reshape(len(frames), SIZE, SIZE, 4)
    assert (pixels[..., 3] == 255).all()
    return torch.from_numpy(pixels[..., :3].copy()) / 255.0


def drawn_here(trained: TrainedAvatar) -> torch.Tensor:
    exported = with_faded_neck(trained)
    images = torch.stack([exported.render(*frame).image for frame in chosen_frames(trained)])
    return (images.clamp(0, 1) * 255).round() / 255


@pytest.mark.parametrize("model", MODELS)
def test_webassembly_draws_the_same_pictures(
    model: str, tracked_folder: Path, open_mouth_folder: Path, tmp_path: Path
) -> None:
    folder = open_mouth_folder if model == "teeth" else tracked_folder
    trained = lively_avatar(folder, tmp_path / "run", *MODELS[model])
    with torch.no_grad():
        trained.avatar.opacity_logits[::9] = -9.0  # too faint to be seen: these are left out
    truth = drawn_here(trained)
    assert 0.1 < float((truth != trained.background).float().mean()) < 0.95, "something to see, and something around it"
    assert psnr(truth[0], truth[1]) < 30, "frames differ"
    picture = drawn_by_node(trained, "float", tmp_path)
    assert min(psnr(a, b) for a, b in zip(picture, truth, strict=True)) > 60


def test_opacities_that_change_are_refused_in_a_sentence(tracked_folder: Path, tmp_path: Path) -> None:
    trained = lively_avatar(tracked_folder, tmp_path / "run", "model=ndgs")
    with pytest.raises(UserError, match="model=ndgs cannot be exported for browsers"):
        write_web_avatar(trained, tmp_path / "a.avatar")
    assert not (tmp_path / "a.avatar").exists()


@pytest.mark.parametrize("model", ["splattingavatar", "monogaussianavatar", "gaussianheadavatar"])
def test_models_that_the_page_does_not_know_are_refused_in_a_sentence(
    tracked_folder: Path, tmp_path: Path, model: str
) -> None:
    trained = lively_avatar(tracked_folder, tmp_path / "run", f"model={model}")
    with pytest.raises(UserError, match=f"model={model} cannot be exported for browsers"):
        write_web_avatar(trained, tmp_path / "a.avatar")
    assert not (tmp_path / "a.avatar").exists()


def test_quantised_parameters_lose_little_and_save_much(tracked_folder: Path, tmp_path: Path) -> None:
    trained = lively_avatar(tracked_folder, tmp_path / "run")
    truth, small = drawn_here(trained), drawn_by_node(trained, "small", tmp_path)
    least = min(psnr(a, b) for a, b in zip(small, truth, strict=True))
    assert 35 < least < 60, "quantised, but not much"
    bytes_small = (tmp_path / "a.avatar").stat().st_size
    assert bytes_small < 0.5 * write_web_avatar(trained, tmp_path / "b.avatar", "float")


def test_expressions_that_the_video_never_used_are_left_out(tracked_folder: Path, tmp_path: Path) -> None:
    trained = lively_avatar(tracked_folder, tmp_path / "run")
    trained.recording.tracks["expression"][:, 3:5] = 0.0
    write_web_avatar(trained, tmp_path / "a.avatar", "float")
    (tmp_path / "frames.json").write_text("[]")
    said = node(HERE / "draw.mjs", tmp_path / "a.avatar", tmp_path / "frames.json", tmp_path / "out")
    assert len(said["rest"]) == trained.assets.num_expressions - 2 + 26


def test_damaged_files_get_a_sentence(tracked_folder: Path, tmp_path: Path) -> None:
    trained = lively_avatar(tracked_folder, tmp_path / "run", "model.uv_size=12")
    write_web_avatar(trained, tmp_path / "a.avatar")
    cases = max(int(os.environ.get("AVATAR_FUZZ_CASES", 1000)) // 2, 50)
    found = node(HERE / "damage.mjs", tmp_path / "a.avatar", cases, timeout=600)
    assert found["wrong"] == []
    assert found["refused"] > 0.4 * cases and found["drawn"] > 0 and found["refused"] + found["drawn"] == cases


def test_sizes_whose_latents_no_memory_holds_are_refused() -> None:
    usual = [5023, 100, 14_876, 4096, 8, 256, 6, 16, 1, 1, 0, 0]
    many = [1, 0, 1, 1 << 16, 1 << 16, 1, 1, 1, 1, 1, 0, 0]  # of all nodes 2^32 values, and no array is large
    assert node(HERE / "measure.mjs", json.dumps([usual, many])) == [1, 0]


def test_the_module_is_what_its_sources_compile_to() -> None:
    """scripts/build_wasm.sh records what it read and what it wrote; `make wasm` brings both up to date."""
    root = WEB.parents[1]
    lines = [line.split() for line in (WEB / "avatar.wasm.sha256").read_text().splitlines()]
    recorded = {name: digest for digest, name in lines}
    assert {"avatar/web/avatar.wasm", "scripts/build_wasm.sh", "avatar/csrc/web/web_avatar.cpp"} <= set(recorded)
    stale = [
        name for name, digest in recorded.items() if hashlib.sha256((root / name).read_bytes()).hexdigest() != digest
    ]
    assert not stale, f"make wasm: {', '.join(stale)} changed since avatar.wasm was compiled"


def test_every_source_of_the_web_core_is_recorded() -> None:
    recorded = (WEB / "avatar.wasm.sha256").read_text()
    for path in (WEB.parent / "csrc" / "web").iterdir():
        assert f"avatar/csrc/web/{path.name}" in recorded


def test_the_package_lists_every_module_that_it_needs() -> None:
    listed = set(json.loads((WEB / "package.json").read_text())["files"])
    needed, found = ["index.js"], set()
    while needed:
        name = needed.pop()
        found.add(name)
        text = (WEB / name).read_text()
        named = re.findall(r'from "\./([\w.]+)"|new URL\("([\w.]+)", BASE\)', text)
        needed += [a or b for a, b in named if (a or b).endswith(".js") and (a or b) not in found]
    assert (
        found | {"avatar.wasm", "index.d.ts"} == listed and {"camera.js", "landmarker_worker.js", "worker.js"} <= found
    )
