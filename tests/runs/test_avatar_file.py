from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from small_runs import open_small, train_small
from torch import Tensor

import avatar
from avatar.data.split import Split
from avatar.errors import UserError
from avatar.export.glb import encode_glb
from avatar.export.ply import encode_ply
from avatar.export.web_page import write_page, write_web_avatar
from avatar.motion.expression_space import fit_expressions
from avatar.motion.neutral_pose import find_mean
from avatar.runs.avatar_file import read_avatar_file, write_avatar_file
from avatar.runs.trained_avatar import TrainedAvatar


@pytest.fixture(scope="module")
def run(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "run"
    train_small(tracked_folder, folder)
    return folder


@pytest.fixture(scope="module")
def trained(run: Path, tracked_folder: Path) -> TrainedAvatar:
    return avatar.load(run, head=tracked_folder / "head_model")


def test_the_file_draws_what_training_ended_with(trained: TrainedAvatar, tracked_folder: Path, tmp_path: Path) -> None:
    model, _ = train_small(tracked_folder, tmp_path / "again")
    params, camera = trained.recording.params(3), trained.recording.camera(3)
    with torch.no_grad():
        expected = model.draw(model(params, None, camera.R_cam_world), camera, trained.background).image
    torch.testing.assert_close(trained.render(params, camera).image, expected, rtol=0, atol=1e-5)
    assert trained.step == 12 and trained.perceptual == "dssim"


def test_it_holds_the_video_without_its_pictures(trained: TrainedAvatar, tracked_folder: Path) -> None:
    _, subject, _ = open_small(tracked_folder, trained.config)
    own, original = trained.recording, subject.recording
    assert (own.name, own.fps, own.split, own.names) == (original.name, original.fps, original.split, original.names)
    assert own.data_hash == original.data_hash and own.intrinsics == original.intrinsics
    assert all(torch.equal(own.tracks[name], original.tracks[name]) for name in original.tracks)


def test_gaussians_pictures_and_streams_agree(trained: TrainedAvatar) -> None:
    motion = trained.recording.motion(range(4))
    camera = trained.rest_camera()
    pictures = [rendering.image for rendering in trained.stream(motion)]
    assert len(pictures) == 4
    for params, picture in zip(motion, pictures, strict=True):
        assert torch.equal(picture, trained.render(params).image)
        drawn = trained.avatar.draw(trained.gaussians(params, camera), camera, trained.background).image
        torch.testing.assert_close(picture, drawn, rtol=0, atol=1e-6)
    moved = trained.recording.camera(0)
    (other,) = trained.stream([(motion[0], moved)])
    assert torch.equal(other.image, trained.render(motion[0], moved).image)


def test_the_rest_is_that_of_the_neutral_frame(trained: TrainedAvatar) -> None:
    rest = trained.rest_params()
    assert torch.equal(rest.expression, trained.neutral.expression)
    assert trained.neutral.frame is not None
    frame = trained.recording.split.train[trained.neutral.frame]
    assert torch.equal(trained.rest_camera().R_cam_world, trained.recording.camera(frame).R_cam_world)


def later(trained: TrainedAvatar) -> TrainedAvatar:
    """The same of a longer video: its first frames are held out, and frame 0 of the training is another one."""
    recording = trained.recording
    split = Split(tuple(range(6, len(recording))), tuple(range(6)))
    return replace(trained, recording=replace(recording, split=split), neutral=replace(trained.neutral, frame=2))


def test_the_neutral_frame_is_counted_among_those_of_the_training(trained: TrainedAvatar) -> None:
    one = later(trained)
    for name in ("R_cam_world", "t_cam_world"):
        assert torch.equal(getattr(one.rest_camera(), name), getattr(one.recording.camera(8), name))


def test_motion_statistics_are_of_the_training_frames(trained: TrainedAvatar) -> None:
    one = later(trained)
    training = one.recording.motion(one.recording.split.train)
    assert torch.equal(one.statistics.mean.expression, find_mean(training).expression)
    space = fit_expressions(training)
    assert torch.equal(one.statistics.expressions.lowest, space.lowest)
    assert not torch.equal(one.statistics.expressions.lowest, trained.statistics.expressions.lowest)


def test_a_file_with_its_head_needs_nothing_else(run: Path, trained: TrainedAvatar, tmp_path: Path) -> None:
    packed = tmp_path / "packed.safetensors"
    content = read_avatar_file(run / "avatar.safetensors")
    write_avatar_file(packed, content.__class__(**{**content.__dict__, "head": trained.assets}), "a licence")
    alone = avatar.load(packed)
    assert alone.assets.fingerprint == trained.assets.fingerprint
    assert torch.equal(alone.render(alone.rest_params()).image, trained.render(trained.rest_params()).image)
    with safe_open(packed, framework="pt") as file:
        assert json.loads(file.metadata()["avatar"])["head_licence"] == "a licence"


def test_a_file_alone_asks_for_its_head(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = Path(shutil.copy(run / "avatar.safetensors", tmp_path))
    with pytest.raises(UserError, match=r"needs its head model: give --head PATH, or set AVATAR_HEAD"):
        avatar.load(file)
    monkeypatch.setenv("AVATAR_HEAD", str(tmp_path / "nowhere"))
    with pytest.raises(UserError, match="nowhere does not exist"):
        avatar.load(file)


def rewritten(source: Path, target: Path, change: Callable[[dict, dict[str, Tensor]], object]) -> Path:
    """A copy of an avatar file after `change(header, tensors)`."""
    with safe_open(source, framework="pt") as file:
        header = json.loads(file.metadata()["avatar"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    change(header, tensors)
    save_file(tensors, target, metadata={"avatar": json.dumps(header)})
    return target


DAMAGES: dict[str, tuple[Callable[[dict, dict[str, Tensor]], object], str]] = {
    "another format": (lambda h, t: h.update(format=7), r"is not an avatar of this program \(format 7, expected 3\)"),
    "no configuration": (lambda h, t: h.pop("config"), r"is damaged \('config' is missing\)"),
    "impossible configuration": (
        lambda h, t: h["config"]["model"].update(latent_dim=0),
        r"cannot be used: model.latent_dim=0 is out of range",
    ),
    "no frames": (lambda h, t: h.update(frames=[]), r"is damaged \(frames is not a list of names\)"),
    "frames that are not there": (lambda h, t: h.update(train=[0, 99]), r"train is empty or names frames outside"),
    "fps of zero": (lambda h, t: h.update(fps=0), r"fps and focal lengths must be positive"),
    "fps that is text": (lambda h, t: h.update(fps="fast"), r"fps is not a finite number"),
    "a huge picture": (lambda h, t: h.update(size=[10**9, 1]), r"an image size of 1000000000x1 is impossible"),
    "a track missing": (lambda h, t: t.pop("recording.jaw"), r"it lacks jaw"),
    "a track too short": (lambda h, t: t.update({"recording.jaw": t["recording.jaw"][1:].clone()}), r"jaw has N = 29"),
    "a track not finite": (lambda h, t: t["recording.t"].fill_(float("inf")), r"t has 90 non-finite"),
    "a neutral face of another basis": (
        lambda h, t: t.update({"neutral.expression": torch.zeros(3)}),
        r"the neutral face has shapes \[3\]",
    ),
    "a neutral frame beyond the end": (lambda h, t: h.update(neutral_frame=99), r"neutral_frame is 99"),
    "a parameter missing": (lambda h, t: t.pop("model.quats"), r"lacks model.quats; it belongs to another model"),
    "a parameter of another shape": (
        lambda h, t: t.update({"model.opacity_logits": torch.zeros(3)}),
        r"has model.opacity_logits of shape \[3\]",
    ),
    "another head model": (lambda h, t: h.update(head_fingerprint="f" * 64), r"trained with another head model"),
    "names of too many coefficients": (
        lambda h, t: h["expression_names"].update(names=["x"] * 99),
        r"expression_names names 99 coefficients",
    ),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_a_damaged_file_gets_a_sentence(name: str, run: Path, tracked_folder: Path, tmp_path: Path) -> None:
    change, sentence = DAMAGES[name]
    file = rewritten(run / "avatar.safetensors", tmp_path / "damaged.safetensors", change)
    with pytest.raises(UserError, match=sentence) as error:
        avatar.load(file, head=tracked_folder / "head_model")
    assert str(file) in str(error.value) and "\n" not in str(error.value)


def test_checkpoints_are_not_avatars(run: Path) -> None:
    with pytest.raises(UserError, match="is not an avatar of this program"):
        avatar.load(run / "checkpoints" / "step_00000012.safetensors")


def test_what_was_exported_for_others_is_not_called_damaged(trained: TrainedAvatar, tmp_path: Path) -> None:
    """`avatar view avatar.html`."""
    files = {"a.html": "open it in a browser", "a.avatar": "<avatar-view>", "a.ply": "splatting", "a.glb": "glTF"}
    write_page(trained, tmp_path / "a.html")
    write_web_avatar(trained, tmp_path / "a.avatar")
    (tmp_path / "a.ply").write_bytes(encode_ply(trained.gaussians(trained.rest_params()), ""))
    (tmp_path / "a.glb").write_bytes(encode_glb(trained, trained.rest_params(), 64, "")[0])
    for name, purpose in files.items():
        with pytest.raises(UserError, match=f"{name} .*{purpose}.*avatar.safetensors") as error:
            avatar.load(tmp_path / name)
        assert "damaged" not in str(error.value)


def test_a_run_and_the_file_in_it_find_their_head(run: Path, trained: TrainedAvatar, tmp_path: Path) -> None:
    for place in (run, str(run), run / "avatar.safetensors"):
        assert avatar.load(place).assets.fingerprint == trained.assets.fingerprint
    moved = Path(shutil.copytree(run, tmp_path / "moved"))
    info = json.loads((moved / "run.json").read_text())
    info["source"]["head"] = str(tmp_path / "gone")
    (moved / "run.json").write_text(json.dumps(info))
    with pytest.raises(UserError, match=r"that of the training, .*gone, is gone\): give --head PATH"):
        avatar.load(moved)
