"""scripts/paper: what each table trains is what the paper says, and what it prints is what was measured."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
import systems
import table
import yaml
from small_runs import SMALL
from tracked_folder import write_tracked_folder

from avatar.config import flatten, load_config
from avatar.sweep.spec import read_spec
from avatar.sweep.state import read_state

pytestmark = pytest.mark.slow

MAY_DIFFER = {"model.name", "model.latent_dim", "model.mlp_width", "model.mlp_layers"}


def rows(name: str) -> list[dict]:
    return systems.read_table(name)["rows"]


OF_ONE_CAMERA = ["ablation", "table1"]


def test_systems_of_several_cameras_differ_in_the_model_alone() -> None:
    first, *others = (flatten(load_config(row["overrides"]).to_dict()) for row in rows("gha"))
    assert len(others) == 2 and sorted([*OF_ONE_CAMERA, "gha"]) == systems.TABLES
    for own in others:
        assert {key for key, value in own.items() if value != first[key]} == {"model.name"}


@pytest.mark.parametrize("name", OF_ONE_CAMERA)
def test_systems_differ_from_the_papers_own_in_the_model_alone(name: str) -> None:
    paper = flatten(load_config(["experiment=paper"]).to_dict())
    models = set()
    for row in rows(name):
        if "overrides" in row:
            own = flatten(load_config(row["overrides"]).to_dict())
            assert {key for key, value in own.items() if value != paper[key]} <= MAY_DIFFER, row["name"]
            models.add(tuple(own[key] for key in sorted(MAY_DIFFER)))
    assert len(models) == sum("overrides" in row for row in rows(name)), "no system is there twice"


def test_what_two_tables_call_the_same_is_the_same() -> None:
    first, second = ({row["name"]: row for row in rows(name)} for name in OF_ONE_CAMERA)
    both = first.keys() & second.keys()
    assert both == {"FlashAvatar", "HyperGaussians n=8"}
    assert all(first[name] == second[name] for name in both)


@pytest.mark.parametrize("name", systems.TABLES)
def test_a_table_is_a_sweep_that_can_be_read(name: str, tmp_path: Path) -> None:
    content = systems.sweep_spec(rows(name), [systems.subject(Path("someone"), None, 1)], [0, 1], ["data.size=64"])
    (tmp_path / "sweep.yaml").write_text(yaml.safe_dump(content))
    spec = read_spec(tmp_path / "sweep.yaml")
    assert len(spec.jobs) == 2 * sum("overrides" in row for row in rows(name))
    assert {job.protocols for job in spec.jobs} == {("hypergaussians",)}
    assert {load_config(job.overrides).data.size for job in spec.jobs} == {64}


@pytest.mark.slow
def test_a_table_holds_what_was_measured_and_is_not_made_twice(tmp_path: Path) -> None:
    write_tracked_folder(tmp_path / "someone", frames=12, size=32)
    out = tmp_path / "out"
    words = ["table1", str(tmp_path / "someone"), "--head", str(tmp_path / "someone" / "head_model"), "--out", str(out)]
    words += [*SMALL, "data.size=32", "trainer.perceptual=dssim"]
    words += ["--frame-offset", "1", "--side-by-side", "--systems", "NDGS n=8"]
    assert table.main(words) == 0
    (job,) = (path for path in (out / "jobs").iterdir() if "NDGS" in path.name)
    means = json.loads((job / "run" / "eval" / "results.json").read_text())["protocols"]["hypergaussians"]["means"]
    found = {row["system"]: row for row in csv.DictReader((out / "table1.csv").open())}
    assert list(found) == [row["name"] for row in rows("table1")]
    ours = found["NDGS n=8"]
    assert float(ours["psnr"]) == pytest.approx(means["psnr"]) and float(ours["ssim"]) == pytest.approx(means["ssim"])
    assert float(ours["fps"]) > 0 and float(ours["minutes"]) == pytest.approx(read_state(job).seconds / 60)
    G = read_parameters(job)["mean"].shape[1]
    n = 8
    network = 24 * (51 + 10 + 20 + 1) + 24 * 25 + n * 25
    assert int(ours["parameters"]) == network + G * (3 + n + n * (n + 1) // 2 + 3 * n)
    assert found["HyperGaussians n=8"]["psnr"] == "" and found["HyperGaussians n=8"]["published_psnr"] == "29.99"
    page = (out / "table1.md").read_text().splitlines()
    (line,) = (line for line in page if line.startswith("| MonoGaussianAvatar"))
    assert line == f"| MonoGaussianAvatar {'| not measured ' * 6}| 29.94 | 0.9456 | 0.06545 | - | - |"
    assert (out / "table1.png").read_bytes().startswith(b"\x89PNG")

    before = read_state(job)
    assert table.main(words) == 0 and read_state(job) == before
    with pytest.raises(SystemExit, match="there is no system 'NDGS' to train; the table has FlashAvatar, Hyper"):
        table.main([*words[:-1], "NDGS"])


def read_parameters(job: Path) -> dict:
    from safetensors import safe_open

    with safe_open(job / "run" / "avatar.safetensors", framework="pt") as file:
        return {name.rpartition(".")[2]: file.get_tensor(name) for name in file.keys() if ".hyper." in name}  # noqa: SIM118
