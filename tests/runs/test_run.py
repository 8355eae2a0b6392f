from __future__ import annotations

import json
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest
from small_runs import run_info

from avatar.errors import UserError
from avatar.runs import run as run_module
from avatar.runs.run import read_run_info, refuse_trained, write_run_info


def test_what_a_run_began_with_comes_back(tmp_path: Path) -> None:
    write_run_info(tmp_path, run_info("dssim"))
    info = read_run_info(tmp_path)
    assert info.perceptual == "dssim" and info.options["experiment"] == "none" and info.config.model.latent_dim == 8
    assert info.source.folder == Path("/x") and info.source.tracking is None and info.source.max_left_out == 0.05


def test_what_is_no_run_is_said_in_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is not a run folder: it has no run.json"):
        read_run_info(tmp_path / "other")
    (tmp_path / "run.json").write_text(json.dumps({"format": 1, "folder": "x"}))
    with pytest.raises(UserError, match="is of format 1, and this program reads 4; train again with this version"):
        read_run_info(tmp_path)
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(UserError, match="cannot be read as JSON"):
        read_run_info(tmp_path)


@pytest.mark.parametrize("key", ["source", "config", "options", "perceptual", "data_hash", "head_fingerprint"])
def test_a_run_that_lacks_something_is_damaged(tmp_path: Path, key: str) -> None:
    info = run_info("dssim")
    del info[key]
    write_run_info(tmp_path, info)
    with pytest.raises(UserError, match=f"run.json is damaged .*{key}.* is missing"):
        read_run_info(tmp_path)


def test_a_library_under_another_name_has_its_version_noted(monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenCV comes as four packages, and any of them will do."""

    def only_the_plain_one(name: str) -> str:
        if name != "opencv-python":
            raise PackageNotFoundError(name)
        return "4.0"

    monkeypatch.setattr(run_module, "version", only_the_plain_one)
    assert run_module.versions()["opencv-contrib-python-headless"] == "4.0"
    assert run_module.versions()["kornia"] == "unknown"


def test_an_avatar_without_its_checkpoints_is_not_trained_over(tmp_path: Path) -> None:
    refuse_trained(tmp_path)
    (tmp_path / "avatar.safetensors").touch()
    with pytest.raises(UserError, match="holds an avatar already, avatar.safetensors: choose another --out"):
        refuse_trained(tmp_path)
