from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from heads import grid_head
from small_runs import small_config

from avatar.data.loader import BYTES_PER_PIXEL
from avatar.errors import UserError
from avatar.runs.memory_estimate import MESH_BYTES, count_gaussians, drawing_needs, training_needs
from avatar.runs.model_registry import make_avatar

TESTS = Path(__file__).parents[1]
MIB = 2**20
PAPER = ("experiment=paper", "data.size=null", "trainer.perceptual=dssim")


@pytest.mark.parametrize(
    "overrides",
    [
        (),
        ("experiment=paper", "model.latent_dim=3"),
        ("model=flashavatar", "model.mlp_layers=1"),
        ("model.mlp_layers=5", "model.mlp_width=7", "model.uv_size=9"),
        ("model=covariance", "model.latent_dim=3"),
        ("experiment=paper", "model=covariance"),
        ("model=ndgs", "model.latent_dim=5"),
        ("model=splattingavatar",),
        ("model=monogaussianavatar", "model.uv_size=9"),
        ("model=gaussianheadavatar", "model.upsampling=4"),
        ("model=gaussianheadavatar_hyper", "model.mlp_width=40", "model.latent_dim=3"),
        ("model=gaussianheadavatar_ndgs",),
    ],
)
def test_the_shapes_are_those_of_the_avatar_that_is_made(overrides: tuple[str, ...]) -> None:
    config, assets = small_config(*overrides).model, grid_head()
    avatar = make_avatar(assets, torch.zeros(3), config)
    gaussians = count_gaussians(config, assets)
    assert gaussians == len(avatar)
    assert avatar.shapes(config, assets.num_expressions, gaussians) == {
        k: tuple(v.shape) for k, v in avatar.state_dict().items()
    }
    assert len(getattr(avatar, "code", ())) <= avatar.most_places(config, gaussians)


def test_gaussians_of_a_finer_raster_are_counted() -> None:
    config, assets = small_config("model.uv_detail=2").model, grid_head(rows=31, columns=41)
    coarse = small_config("model.uv_detail=1").model
    gaussians = count_gaussians(config, assets)
    assert gaussians == len(make_avatar(assets, torch.zeros(3), config)) > count_gaussians(coarse, assets)


def test_a_map_too_coarse_for_a_single_gaussian_gets_a_sentence() -> None:
    with pytest.raises(UserError, match="model.uv_size=2 is too small: no texel of a 2 x 2 raster"):
        grid = grid_head()
        on_rim = dict(grid.regions, boundary=torch.arange(grid.num_vertices))
        count_gaussians(small_config("model.uv_size=2").model, grid.__class__(**{**vars(grid), "regions": on_rim}))


MEASURE = """
import resource, sys
sys.path[:0] = {path!r}
from pathlib import Path
from small_runs import *
from avatar.gaussianheadavatar import initial_motion, initial_surface
from avatar.runs.memory_estimate import training_needs

initial_motion.STEPS = initial_surface.STEPS = 2  # each takes as much as the others

def bytes_of(field):
    return 1024 * int(next(line for line in open("/proc/self/status") if line.startswith(field)).split()[1])

folder, run = Path(sys.argv[1]), Path(sys.argv[2])
train_small(folder, run / "warm", ["trainer.iterations=1"])
config = small_config("trainer.iterations=2", "trainer.checkpoint_every=2", *sys.argv[3:])
source, subject, assets = open_small(folder, config)
before = bytes_of("VmRSS")
avatar = new_avatar(assets, subject, config)
train(avatar, subject, config, run / "run", choose_perceptual(config.trainer, lambda _: None))
needs = training_needs(config, assets, frames=len(subject.split.train), size=subject.image_size(), perceptual="dssim")
print(bytes_of("VmHWM") - before, sum(need.size for need in needs))
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize(
    "overrides",
    [
        (*PAPER, "model.uv_size=256", "model.mlp_width=256", "model.mlp_layers=4"),  # activations
        ("model.uv_size=128", "model.latent_dim=50"),  # HyperGaussians, which are largest while they are saved
        ("model.mlp_width=1800", "model.mlp_layers=5"),  # the network, likewise
        ("model=covariance", "model.uv_size=200", "model.latent_dim=8"),
        ("model=ndgs", "model.uv_size=160", "model.latent_dim=30"),
        ("model=gaussianheadavatar_hyper", "model.uv_size=128", "model.mlp_width=256"),
    ],
    ids=["activations", "heads", "network", "covariances", "n-dimensional", "features"],
)
def test_training_takes_what_is_estimated(overrides: tuple[str, ...], tracked_folder: Path, tmp_path: Path) -> None:
    script = MEASURE.format(path=[str(p) for p in (TESTS / "helpers", TESTS / "data_prep")])
    process = subprocess.run(
        [sys.executable, "-c", script, str(tracked_folder), str(tmp_path), *overrides],
        capture_output=True,
        text=True,
        check=True,
    )
    taken, estimated = map(int, process.stdout.split())
    assert estimated > 400 * MIB, "too small to tell from the libraries' own"
    assert 0.75 < taken / estimated < 1.25, (taken / MIB, estimated / MIB)


def test_the_largest_part_is_what_is_to_be_lowered() -> None:
    assets, size = grid_head(), (512, 512)

    def largest(*overrides: str) -> str:
        needs = training_needs(small_config(*overrides), assets, frames=2000, size=size, perceptual="dssim")
        return max(needs, key=lambda need: need.size).what

    assert largest("model.mlp_width=65536", "model.mlp_layers=1000") == "the deformation network"
    assert largest("model.uv_size=1024", "model.latent_dim=64") == "the HyperGaussians"
    assert (
        largest("experiment=paper", "model.uv_size=2048", "model.mlp_width=1024")
        == "the network's layers at every place"
    )
    assert largest() == "the cache of decoded frames"


def test_posed_meshes_are_counted_up_to_what_is_kept_of_them() -> None:
    def cached(frames: int, rows: int) -> int:
        needs = training_needs(small_config(), grid_head(rows), frames=frames, size=(1, 1), perceptual="none")
        return needs[0].size - frames * BYTES_PER_PIXEL

    assert cached(100, 7) == 100 * 3 * 4 * grid_head(7).num_vertices
    assert cached(10**6, 70) == MESH_BYTES


def test_drawing_takes_less_than_training_and_grows_with_what_it_holds() -> None:
    assets = grid_head()
    config = small_config("model.uv_size=512")
    gaussians = count_gaussians(config.model, assets)

    def total(*overrides: str) -> int:
        return sum(need.size for need in drawing_needs(small_config(*overrides).model, assets, gaussians))

    training = training_needs(config, assets, frames=10, size=(64, 64), perceptual="none")
    assert total("model.uv_size=512") < sum(need.size for need in training)
    assert total("model.latent_dim=64") > 3 * total("model.latent_dim=8")
    assert total("model.mlp_width=4096") > total() + 4096**2 * 4
