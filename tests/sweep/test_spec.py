from __future__ import annotations

from pathlib import Path

import pytest

from avatar.errors import UserError
from avatar.sweep.spec import read_spec


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_a_sweep_is_every_subject_with_every_variant_and_seed(tmp_path: Path) -> None:
    spec = read_spec(
        write(
            tmp_path / "sweep.yaml",
            """
            subjects: [anna, {folder: /data/carla, head: models/flame, frame_offset: 1, tracking: null}]
            head: head_model
            variants: {n8: [], n32: [model.latent_dim=32]}
            overrides: [data.size=64]
            seeds: [0, 5]
            protocols: [strict]
            threads: 1
            """,
        )
    )
    assert len(spec.jobs) == len({job.name for job in spec.jobs}) == 8
    first, last = spec.jobs[0], spec.jobs[-1]
    assert (first.subject, first.variant, first.seed) == ("anna", "n8", 0)
    assert first.source == {"folder": str(tmp_path / "anna"), "head": str(tmp_path / "head_model")}
    assert first.overrides == ("data.size=64", "trainer.seed=0") and first.protocols == ("strict",)
    assert last.source == {"folder": "/data/carla", "head": str(tmp_path / "models/flame"), "frame_offset": 1}
    assert last.overrides == ("data.size=64", "model.latent_dim=32", "trainer.seed=5")
    assert (spec.resources.threads, spec.resources.gpus, spec.retries) == (1, None, 2)


def test_a_product_is_every_combination(tmp_path: Path) -> None:
    text = "subjects: [a]\nproduct: {model.latent_dim: [4, 8], experiment: [demo, paper], data.size: [null]}\n"
    spec = read_spec(write(tmp_path / "sweep.yaml", text))
    assert [job.variant for job in spec.jobs] == [
        "model.latent_dim=4 experiment=demo data.size=null",
        "model.latent_dim=4 experiment=paper data.size=null",
        "model.latent_dim=8 experiment=demo data.size=null",
        "model.latent_dim=8 experiment=paper data.size=null",
    ]


def test_a_list_of_variants_is_named_by_its_overrides(tmp_path: Path) -> None:
    text = "subjects: [a]\nvariants: [[], [model=flashavatar], model.latent_dim=2]\n"
    spec = read_spec(write(tmp_path / "sweep.yaml", text))
    assert [job.variant for job in spec.jobs] == ["default", "model=flashavatar", "model.latent_dim=2"]


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_specification_is_read_as_an_editor_on_windows_saves_it(encoding: str, tmp_path: Path) -> None:
    (tmp_path / "sweep.yaml").write_bytes("subjects: [Zoë]\r\nseeds: [3]\r\n".encode(encoding))
    (job,) = read_spec(tmp_path / "sweep.yaml").jobs
    assert job.subject == "Zoë" and job.seed == 3


MISTAKES = {
    "not YAML": ("subjects: [", "cannot be read as YAML"),
    "nothing": ("", "holds no keys"),
    "code": ("subjects: !!python/object/apply:os.system [touch x]", "cannot be read as YAML"),
    "unknown key": ("subjects: [a]\nseed: [1]", "there is no key 'seed'"),
    "a tag without a value": ("subjects: [!!int '']", "cannot be read as YAML"),
    "a tag of another kind": ("subjects: [!!timestamp x]", "cannot be read as YAML"),
    "a folder that no system has": ('subjects: ["a\\0b"]', "not a path"),
    "a protocol that is none": ("subjects: [a]\nprotocols: [hypergausians]", "there is no protocol 'hypergausians'"),
    "a protocol's file that is not there": ("subjects: [a]\nprotocols: [mine.yaml]", "mine.yaml does not exist"),
    "no subjects": ("seeds: [1]", "subjects must be a list with at least one entry"),
    "a subject without folder": ("subjects: [{head: x}]", "names no folder"),
    "an unknown key of a subject": ("subjects: [{folder: a, size: 3}]", "a subject has no key 'size'"),
    "two subjects of one name": ("subjects: [x/a, y/a]", "two subjects are called a; give them a `name`"),
    "an override that is none": (
        "subjects: [a]\nvariants: {x: [model.latent=3]}",
        "variant x: there is no configuration",
    ),
    "a value out of range": ("subjects: [a]\noverrides: [data.size=1]", "data.size=1 is out of range"),
    "seeds that are text": ("subjects: [a]\nseeds: [one]", "seeds holds 'one'"),
    "a seed that no training takes": (f"subjects: [a]\nseeds: [0, {2**40}]", f"trainer.seed={2**40} is out of range"),
    "a seed as a variant": ("subjects: [a]\nproduct: {trainer.seed: [1, 2]}", "trainer.seed is what seeds says"),
    "a seed as an override": ("subjects: [a]\noverrides: [trainer.seed=1]", "trainer.seed is what seeds says"),
    "a seed twice": ("subjects: [a]\nseeds: [1, 1]", "seeds names one twice"),
    "variants and product": (
        "subjects: [a]\nvariants: [[]]\nproduct: {experiment: [demo]}",
        "variants or product, not both",
    ),
    "variants that are a number": ("subjects: [a]\nvariants: 3", "variants must name at least one list of overrides"),
    "no variants": ("subjects: [a]\nvariants: {}", "variants must name at least one list of overrides"),
    "a product that is a list": ("subjects: [a]\nproduct: [4]", "product must hold a list of values for each key"),
    "an empty product": ("subjects: [a]\nproduct: {experiment: []}", "product must hold a list of values for each key"),
    "too many": (
        f"subjects: [a]\nseeds: {list(range(318))}\nproduct: {{trainer.dssim_weight: {list(range(1, 316))}}}",  # 100,170
        "more than 100,000 jobs",
    ),
    "threads that are none": ("subjects: [a]\nthreads: many", "threads is 'many'; it must lie between 1 and 1024"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_gets_a_sentence(name: str, tmp_path: Path) -> None:
    text, sentence = MISTAKES[name]
    path = write(tmp_path / "sweep.yaml", text)
    with pytest.raises(UserError, match=sentence) as error:
        read_spec(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)
