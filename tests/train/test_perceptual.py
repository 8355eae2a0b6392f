"""Which perceptual term a run trains with, and what is said where it is another than the one that was meant."""

from __future__ import annotations

import pytest

from avatar.config import load_config
from avatar.errors import UserError
from avatar.losses.lpips import MissingWeights
from avatar.losses.lpips_network import Net
from avatar.train import loss as loss_module
from avatar.train.loss import choose_perceptual


@pytest.fixture(autouse=True)
def no_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(net: Net, **_: object) -> None:
        raise MissingWeights(net, f"no LPIPS weights for {net!r} in /a/folder: put " + "https://somewhere/ " * 9)

    monkeypatch.setattr(loss_module, "load_lpips", missing)


@pytest.mark.parametrize("name", ["paper", "mlp_256x40", "mlp_512x11", "gha_paper"])
def test_the_papers_experiments_never_train_without_lpips(name: str) -> None:
    said: list[str] = []
    config = load_config([f"experiment={name}"]).trainer
    with pytest.raises(UserError, match=r"no LPIPS weights for 'vgg'.*trainer\.perceptual=dssim"):
        choose_perceptual(config, said.append)
    assert config.perceptual.startswith("lpips") and said == []
    by_name = load_config([f"experiment={name}", "trainer.perceptual=dssim"]).trainer
    assert choose_perceptual(by_name, said.append).name == "dssim"


def test_the_default_says_in_one_short_line_that_it_trains_without_lpips() -> None:
    said: list[str] = []
    assert choose_perceptual(load_config().trainer, said.append).name == "dssim"
    assert len(said) == 1 and len(said[0]) < 130 and "avatar models" in said[0] and "http" not in said[0]
