"""Avatar files of strangers: what they hold must be finite numbers, and their names choose no place."""

from __future__ import annotations

import json
from argparse import Namespace
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from command_line import avatar as command
from safetensors import safe_open
from safetensors.torch import save_file
from small_runs import open_small, small_config, train_small
from torch import Tensor

import avatar
from avatar.commands import export, reenact, refine
from avatar.commands.arguments import parse
from avatar.data.manifest import MANIFEST_FILE, read_manifest
from avatar.errors import UserError
from avatar.export.ply import encode_ply
from avatar.export.web_file import encode_avatar
from avatar.files.names import MAX_NAME_BYTES, safe_name, shortened
from avatar.runs.avatar_file import AVATAR_FILE, read_avatar_file, write_avatar_file
from avatar.runs.checkpoint import list_checkpoints, load_checkpoint
from avatar.runs.trained_avatar import load_avatar

HOSTILE_NAMES = {
    "a folder above": "../outside/index",
    "an absolute path": "/etc/passwd",
    "only dots": "..",
    "nothing": "",
    "a hidden file": ".bashrc",
    "an option": "--out=x",
    "a home folder": "~root",
    "windows": "C:\\windows\\x",
    "a zero byte": "a\0b",
    "lines": "a\nb\r\x1b[2J",
    "right to left": "a\u202egpj.exe",
    "not UTF-8": "caf\udce9",
    "half an emoji": "\ud83d",
    "255 letters": "ä" * 255,
}


@pytest.fixture(scope="module")
def head(tracked_folder: Path) -> Path:
    return tracked_folder / "head_model"


@pytest.fixture(scope="module")
def run(tracked_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "run"
    train_small(tracked_folder, folder)
    return folder


def changed(run: Path, target: Path, change: Callable[[dict, dict[str, Tensor]], object]) -> Path:
    """A copy of the run's avatar after `change(header, tensors)`."""
    with safe_open(run / AVATAR_FILE, framework="pt") as file:
        header = json.loads(file.metadata()["avatar"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    change(header, tensors)
    save_file(tensors, target, metadata={"avatar": json.dumps(header)})
    return target


def poisoned(name: str, value: float) -> Callable[[dict, dict[str, Tensor]], object]:
    return lambda _, tensors: tensors[name].reshape(-1)[2:3].fill_(value)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["model.sh_dc", "model.quats", "model.opacity_logits", "recording.t", "neutral.jaw"])
def test_a_value_that_is_not_finite_is_refused_with_the_tensors_name(
    name: str, value: float, run: Path, head: Path, tmp_path: Path
) -> None:
    file = changed(run, tmp_path / "a.safetensors", poisoned(name, value))
    with pytest.raises(UserError, match=rf"{name} has 1 non-finite of"):
        avatar.load(file, head=head)


@pytest.mark.parametrize(
    "words",
    [
        *(f"export {{file}} --head {{head}} --out {{tmp}}/a{suffixes[0]}" for suffixes in export.SUFFIXES.values()),
        "view {file} --head {head} --port 0",
        "reenact {file} --head {head} --driver {tmp}/x.csv --out {tmp}/a.mp4",
    ],
)
def test_no_command_takes_an_avatar_that_is_not_finite(words: str, run: Path, head: Path, tmp_path: Path) -> None:
    file = changed(run, tmp_path / "a-poisoned.safetensors", poisoned("model.sh_dc", float("nan")))
    (tmp_path / "x.csv").write_text("expression_0\n0\n")
    before = sorted(tmp_path.iterdir())
    said = command(*(word.format(file=file, head=head, tmp=tmp_path) for word in words.split()), status=1)
    assert "model.sh_dc has 1 non-finite" in said and sorted(tmp_path.iterdir()) == before


def test_a_packed_head_and_a_checkpoint_that_are_not_finite_are_refused(run: Path, head: Path, tmp_path: Path) -> None:
    packed = tmp_path / "packed.safetensors"
    write_avatar_file(packed, replace(read_avatar_file(run / AVATAR_FILE), head=load_avatar(run, head).assets))
    with safe_open(packed, framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
        metadata = file.metadata()
    tensors["head.template"][3, 1] = float("nan")
    save_file(tensors, packed, metadata=metadata)
    with pytest.raises(UserError, match=r"head\.template has 1 non-finite"):
        avatar.load(packed)
    checkpoint = tmp_path / "step_00000012.safetensors"
    with safe_open(list_checkpoints(run / "checkpoints")[-1], framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
        metadata = file.metadata()
    tensors["model.quats"][0, 0] = float("inf")
    save_file(tensors, checkpoint, metadata=metadata)
    with pytest.raises(UserError, match=r"model\.quats has 1 non-finite"):
        load_checkpoint(checkpoint)


@pytest.mark.parametrize("dtype", ["float8_e4m3fn", "float8_e5m2", "complex64", "uint16", "uint64"])
@pytest.mark.parametrize("name", ["model.sh_dc", "recording.t"])
def test_a_tensor_of_a_type_that_nothing_computes_with_is_refused(
    name: str, dtype: str, run: Path, head: Path, tmp_path: Path
) -> None:
    kind = getattr(torch, dtype)
    file = changed(run, tmp_path / "a.safetensors", lambda _, t: t.update({name: t[name].abs().to(kind)}))
    with pytest.raises(UserError, match=rf"{name} has values of type \w+, not of F64"):
        avatar.load(file, head=head)


def test_finite_parameters_that_stand_for_infinite_sizes_are_not_exported(
    run: Path, head: Path, tmp_path: Path
) -> None:
    trained = load_avatar(changed(run, tmp_path / "a.safetensors", poisoned("model.log_scales", 1e4)), head)
    with pytest.raises(UserError, match="has a scale_2 of inf"):
        encode_ply(trained.gaussians(trained.rest_params(), trained.rest_camera()))
    with torch.no_grad():
        trained.avatar.log_scales.fill_(float("nan"))
    with pytest.raises(UserError, match="cannot be drawn: scales has .* non-finite"):
        encode_avatar(trained)


def is_name(text: str) -> bool:
    return bool(text) and text == Path(text).name and text.isprintable() and text[0] not in ".-~ " and "\\" not in text


@pytest.mark.parametrize("kind", HOSTILE_NAMES)
def test_a_name_becomes_a_files_name(kind: str) -> None:
    name = safe_name(HOSTILE_NAMES[kind])
    assert is_name(name) and len(name.encode()) <= MAX_NAME_BYTES and safe_name(name) == name


def test_usual_names_stay() -> None:
    for name in ("anna", "Zoë", "王小明", "take 2", "my.video-1_b"):
        assert safe_name(name) == name == shortened(name)
    long = [shortened("x" * 250 + end) for end in "ab"]
    assert long[0] != long[1] and max(map(len, long)) <= MAX_NAME_BYTES


@pytest.mark.parametrize("kind", HOSTILE_NAMES)
def test_every_place_that_is_derived_from_an_avatars_name_is_here(
    kind: str, run: Path, head: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = changed(run, tmp_path / "a.safetensors", lambda header, _: header.update(name=HOSTILE_NAMES[kind]))
    name = read_avatar_file(file).recording.name
    assert is_name(name)  # of pictures and videos that the viewer saves, too
    monkeypatch.setattr(export, "open_trained", lambda *_: Namespace(name=name, source=file))
    monkeypatch.chdir(tmp_path)
    places: list[Path] = []

    def note(trained: Namespace, out: Path, arguments: Namespace) -> None:
        places.append(out)

    for format in export.WRITERS:
        monkeypatch.setitem(export.WRITERS, format, note)
        export.run_export(parse(["export", str(file), "--head", str(head), "--format", format]))
    assert len(places) == len(export.SUFFIXES) and all(place.name == str(place) for place in places)
    assert {is_name(place.name) for place in places} == {True}


def test_an_export_writes_nothing_outside(
    run: Path, head: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "index.ply").write_text("mine")
    (here := tmp_path / "here").mkdir()
    file = changed(run, here / "a.safetensors", lambda header, _: header.update(name="../outside/index"))
    monkeypatch.chdir(here)
    assert "Splats" in command("export", file, "--head", head, "--format", "ply")
    assert (tmp_path / "outside" / "index.ply").read_text() == "mine"
    assert len(list(here.glob("*.ply"))) == 1


@pytest.mark.parametrize("kind", HOSTILE_NAMES)
def test_a_prepared_subjects_name_chooses_no_place(
    kind: str, tracked_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, subject, _ = open_small(tracked_folder, small_config())
    content = json.loads((subject.folder / MANIFEST_FILE).read_text())
    (tmp_path / MANIFEST_FILE).write_text(json.dumps({**content, "name": HOSTILE_NAMES[kind]}))
    manifest = read_manifest(tmp_path)
    assert is_name(manifest.name)
    found: list[Path] = []
    run = Namespace(subject=Namespace(name=manifest.name, manifest=manifest))
    monkeypatch.setattr(refine, "open_run", lambda *_: run)
    monkeypatch.setattr(refine, "refine_run", lambda run, target, device: found.append(target) or 1)
    refine.run_refine(parse(["refine", str(tmp_path / "run")]))
    assert found[0].parent == tmp_path / "run" / refine.REFINED_FOLDER


@pytest.mark.parametrize("name", ["x" * 250 + ".npz", "caf\udce9.npz", ".npz", "a b.csv"])
def test_a_drivers_name_makes_a_name_that_fits(name: str, tmp_path: Path) -> None:
    choices = Namespace(transfer="relative")
    place = reenact.default_video(tmp_path, tmp_path / name, choices)  # type: ignore[arg-type]
    assert place.parent == Path("reenact") and is_name(place.name) and len(place.name.encode()) < 200
