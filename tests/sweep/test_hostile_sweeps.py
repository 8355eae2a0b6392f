"""Sweeps' files that would fill memory, and such as say where jobs write."""

from __future__ import annotations

import json
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from watch import memory_cap

from avatar.errors import UserError
from avatar.evaluation.protocol import builtin_protocols, read_protocol
from avatar.files.plain_yaml import MAX_NODES, read_yaml
from avatar.sweep.spec import MAX_VARIANTS, Job, Resources, read_spec
from avatar.sweep.state import read_job, read_sweep

pytestmark = pytest.mark.slow

ALIASES = "\n".join(
    ["a0: &a0 [x, x, x, x, x, x, x, x, x]", *(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12))]
)
# At most 800 bytes each.
BOMBS = {
    "aliases of aliases": f"subjects: [a]\n{ALIASES}\nvariants: *a11",
    "aliases in a product": f"subjects: [a]\n{ALIASES}\nproduct: {{trainer.seed: *a11}}",
    "merged tables": "subjects: [a]\nx: &x {a: 1}\nvariants: {<<: *x}",
    "a product of many keys": "subjects: [a]\nproduct:\n" + "\n".join(f" {k}: [1,2,3,4,5,6,7,8]" for k in "abcdefghijkl"),
    "subjects times a product": f"subjects: [{','.join(f's{i}' for i in range(60))}]\nseeds: {list(range(90))}\n"
    "product: {a: [1,2,3,4,5,6,7,8], b: [1,2,3,4,5,6,7,8]}",
    "a number without end": f"subjects: [a]\nseeds: [0x{'f' * 700}]",
    "depth": f"subjects: {'[' * 700}",
}  # fmt: skip


@pytest.mark.timeout(20)
@pytest.mark.parametrize("name", BOMBS)
@pytest.mark.parametrize("read", [read_spec, read_protocol])
def test_a_small_file_that_stands_for_gigabytes_is_refused_at_once(name: str, read: Any, tmp_path: Path) -> None:
    path = tmp_path / "sweep.yaml"
    path.write_text(BOMBS[name])
    assert path.stat().st_size <= 800
    begin = time.process_time()
    with memory_cap(), pytest.raises(UserError) as refusal:
        read(path)
    assert str(path) in str(refusal.value) and "\n" not in str(refusal.value) and len(str(refusal.value)) < 1000
    assert time.process_time() - begin < 5


def test_the_bounds_are_said(tmp_path: Path) -> None:
    path = tmp_path / "sweep.yaml"
    path.write_text(f"subjects: [a]\nproduct: {{a: {list(range(40))}, b: {list(range(40))}}}")
    with pytest.raises(UserError, match=f"product makes 1,600 variants; up to {MAX_VARIANTS:,}"):
        read_spec(path)
    path.write_text(f"[{'1,' * MAX_NODES}1]")
    with pytest.raises(UserError, match=f"more than {MAX_NODES:,} values"):
        read_yaml(path, 2**20)
    path.write_text("{[1]: 2}")
    with pytest.raises(UserError, match="a key is a list"):
        read_yaml(path, 2**20)
    path.write_text("a: 1\na: 2")
    with pytest.raises(UserError, match="'a' stands there twice"):
        read_yaml(path, 2**20)
    path.write_text("variants: {1: [], yes: []}")
    with pytest.raises(UserError, match="two keys mean the same"):
        read_yaml(path, 2**20)


def test_the_protocols_of_the_program_are_plain() -> None:
    assert all(read_protocol(path) for path in builtin_protocols().values())


@pytest.mark.parametrize("key", ["data_format", "fps", "frame_offset"])
def test_a_value_of_a_subject_cannot_be_an_option(key: str, tmp_path: Path) -> None:
    path = tmp_path / "sweep.yaml"
    path.write_text(json.dumps({"subjects": [{"folder": "a", key: "--out=/elsewhere"}]}))
    with pytest.raises(UserError, match=f"{key} is '--out=/elsewhere'"):
        read_spec(path)


JOB = asdict(Job("j-abc-seed0", "s", "v", 0, {"folder": "/f", "frame_offset": -1}, ("trainer.seed=0",), ("strict",)))
HOSTILE_JOBS: dict[str, dict[str, Any]] = {
    "another folder's name": {"name": "other"},
    "a name that leaves the sweep": {"name": "../../elsewhere"},
    "an override that is an option": {"overrides": ["--out=/elsewhere"]},
    "a protocol that is an option": {"protocols": ["--run"]},
    "a source that is an option": {"source": {"folder": "--out=/elsewhere"}},
    "a source without a folder": {"source": {}},
    "a source that is a list": {"source": ["/f"]},
    "an unknown part of a source": {"source": {"folder": "/f", "out": "/elsewhere"}},
    "overrides that are a number": {"overrides": 3},
    "a table among the overrides": {"overrides": [{}]},
    "a number among the overrides": {"overrides": [1]},
    "no name": {"name": 3},
}


@pytest.mark.parametrize("name", HOSTILE_JOBS)
def test_a_hostile_job_is_refused(name: str, tmp_path: Path) -> None:
    folder = tmp_path / "jobs" / "j-abc-seed0"
    folder.mkdir(parents=True)
    (folder / "job.json").write_text(json.dumps(JOB))
    assert read_job(folder).source["frame_offset"] == -1
    (folder / "job.json").write_text(json.dumps({**JOB, **HOSTILE_JOBS[name]}))
    with pytest.raises(UserError, match="is damaged"):
        read_job(folder)


@pytest.mark.parametrize("wrong", [{"threads": "2"}, {"memory_gb": None}, {"gpus": []}, [3]])
def test_resources_of_another_kind_are_refused(wrong: object, tmp_path: Path) -> None:
    content = {"format": 1, "jobs": [], "resources": {"threads": 2}, "retries": 0}
    (tmp_path / "sweep.json").write_text(json.dumps(content))
    assert read_sweep(tmp_path).resources == Resources()
    (tmp_path / "sweep.json").write_text(json.dumps({**content, "resources": wrong}))
    with pytest.raises(UserError, match=r"sweep\.json is damaged"):
        read_sweep(tmp_path)


@pytest.mark.parametrize("name", ["../../elsewhere", "..", "", "/elsewhere", "a/../../../elsewhere"])
def test_a_sweep_that_names_a_folder_outside_writes_nothing_there(name: str, tmp_path: Path) -> None:
    sweep, outside = tmp_path / "in" / "sweep", tmp_path / "in" / "elsewhere"
    (sweep / "jobs").mkdir(parents=True)
    outside.mkdir()
    for folder in (outside, sweep, sweep / "jobs"):
        (folder / "job.json").write_text(json.dumps({**JOB, "name": folder.name}))
    content = {"format": 1, "jobs": [name], "resources": {}, "retries": 0}
    (sweep / "sweep.json").write_text(json.dumps(content))
    try:
        jobs = read_sweep(sweep).jobs
    except UserError:
        return
    for job in jobs:  # where their files go
        assert (sweep / "jobs" / job.name).resolve().parent == (sweep / "jobs").resolve()
