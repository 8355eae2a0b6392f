"""The random zoom of training pictures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from heads import grid_head
from small_runs import new_avatar, open_small, small_config
from torch import Tensor

from avatar.config import Config, load_config
from avatar.data.camera_rig import CameraRig, RigCamera
from avatar.data.frame import Frame
from avatar.data.gpu_frame_cache import GpuFrameCache
from avatar.data.loader import FrameLoader
from avatar.data.recording import Recording
from avatar.runs.model_registry import make_avatar
from avatar.splat import splat_features
from avatar.train.loss import PerceptualTerm, TrainingLoss, Weighted, at_size
from avatar.train.optimizer import make_optimizer
from avatar.train.step import TrainState, train_step
from avatar.train.step_runner import StepRunner
from avatar.train.zoom import Zoom, make_zoom, zoomed
from avatar.types import Camera, HeadParams, Rendering

WIDTH, HEIGHT = 60, 44
CAMERA = Camera(torch.eye(3), torch.tensor([0.0, 0.0, 1.0]), 70.0, 75.0, 24.0, 27.0, WIDTH, HEIGHT)
FACTORS = [0.8, 0.9, 1.0, 1.25]
LIMITS = 0.8, 1.25


def drawn(camera: Camera) -> Rendering:
    """A few soft blobs over white; without blur, so that they scale as the picture does."""
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(12, 3, generator=generator) * torch.tensor([0.6, 0.4, 0.2]) - torch.tensor([0.3, 0.2, 0.1])
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(12, 1)
    colours, opacities = torch.rand(12, 3, generator=generator), torch.full((12,), 0.6)
    return splat_features(
        means, quats, torch.full((12, 3), 0.1), opacities, colours, camera, torch.ones(3), blur=0.0, alpha_min=1e-5
    )


def made(image: Tensor, alpha: Tensor, camera: Camera = CAMERA) -> Frame:
    params = HeadParams(torch.zeros(1), torch.zeros(6), torch.zeros(12), torch.zeros(2), torch.zeros(6))
    return Frame(0, "0", camera, params, image, alpha, torch.ones_like(alpha), 0.5 * alpha, (slice(0, 9), slice(0, 9)))


@pytest.mark.parametrize("factor", FACTORS)
def test_the_zoomed_camera_draws_what_the_zoomed_picture_shows(factor: float) -> None:
    """Up to what the picture's pixels lose when they are interpolated."""
    seen_small = zoomed(made(*drawn(CAMERA)), factor)
    again = drawn(seen_small.camera)
    assert seen_small.seen is not None
    seen = seen_small.seen
    assert (again.image - seen_small.image)[seen].abs().max() < 4e-3
    assert (again.alpha - seen_small.alpha)[seen].abs().max() < 4e-3
    torch.testing.assert_close(seen_small.mouth_mask, 0.5 * seen_small.alpha)
    for wrong in ({"cx": CAMERA.cx}, {"cy": CAMERA.cy}, {"fx": CAMERA.fx}, {"fy": CAMERA.fy}):
        other = drawn(replace(seen_small.camera, **wrong))
        assert factor == 1.0 or (other.image - seen_small.image)[seen].abs().max() > 0.02


@pytest.mark.parametrize("factor", FACTORS)
def test_zoomed_pads_with_white_of_no_mask_that_is_not_seen(factor: float) -> None:
    frame = zoomed(made(torch.zeros(HEIGHT, WIDTH, 3), torch.ones(HEIGHT, WIDTH)), factor)
    rows, columns = ((torch.arange(n) + 0.5 - n / 2).abs() / factor for n in (HEIGHT, WIDTH))
    inside = (rows < HEIGHT / 2 - 0.5 + 1e-4)[:, None] & (columns < WIDTH / 2 - 0.5 + 1e-4)
    beyond = (rows > HEIGHT / 2 + 0.5)[:, None] | (columns > WIDTH / 2 + 0.5)
    assert inside.any() and beyond.any() == (factor < 1)
    assert frame.seen is not None and torch.equal(frame.seen, inside)
    for plane, padded in ((frame.image, 1.0), (frame.alpha, 0.0), (frame.head_mask, 0.0), (frame.mouth_mask, 0.0)):
        assert plane.shape[:2] == (HEIGHT, WIDTH) and plane.is_contiguous()
        assert (plane[beyond] == padded).all()
    torch.testing.assert_close(frame.image[inside], torch.zeros(int(inside.sum()), 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(frame.head_mask[inside], torch.ones(int(inside.sum())), atol=1e-5, rtol=0)


def test_pixels_that_are_not_seen_cost_nothing_at_either_size() -> None:
    frame = zoomed(made(torch.rand(HEIGHT, WIDTH, 3), torch.ones(HEIGHT, WIDTH)), 0.8)
    term = PerceptualTerm("l1", Weighted(lambda image, target, mask: (image - target).abs().mean(), 1.0))
    objective = TrainingLoss(small_config().trainer, torch.zeros(3), term)
    images = [torch.full((HEIGHT // n, WIDTH // n, 3), 2.0, requires_grad=True) for n in (1, 2)]
    objective.loss(9999, frame, images[0], frame.composite(torch.zeros(3)), None, images[1:]).total.backward()
    large, small = (image.grad for image in images)
    assert large is not None and small is not None and frame.seen is not None
    assert torch.equal((large != 0).any(dim=2), frame.seen)
    whole = frame.seen.view(HEIGHT // 2, 2, WIDTH // 2, 2).all(dim=3).all(dim=1)
    assert torch.equal((small != 0).any(dim=2), whole)


@pytest.mark.parametrize(("width", "factor"), [(64, 4), (50, 4), (51, 2), (49, 1)])
def test_at_size_takes_means_over_what_each_small_pixel_covers(width: int, factor: int) -> None:
    """In an image whose values are the places of its pixels."""
    places, small = torch.arange(width) + 0.5, -(-width // factor)
    image = places[None, :, None].expand(width - 2, -1, 3)
    found = at_size(image, torch.zeros(-(-(width - 2) // factor), small, 3))
    wanted = torch.stack([part.mean() for part in places.split(factor)])
    torch.testing.assert_close(found, wanted[None, :, None].expand(found.shape))


def test_the_factor_is_a_function_of_seed_and_step() -> None:
    zoom = Zoom(LIMITS, seed=3)
    factors = [zoom.factor(step) for step in range(2000)]
    assert factors == [Zoom(LIMITS, seed=3).factor(step) for step in range(2000)] and len(set(factors)) == 2000
    assert factors[7] != Zoom(LIMITS, seed=4).factor(7)
    assert 0.8 <= min(factors) < 0.801 and 1.249 < max(factors) <= 1.25


def test_a_step_zooms_frames_of_a_gpus_cache_as_those_of_files(tracked_folder: Path) -> None:
    """The head's box and the perceptual term's crop are those of the frame before, and are not used."""
    config = small_config("model=gaussianheadavatar")
    _, subject, assets = open_small(tracked_folder, config)
    avatar, zoom = new_avatar(assets, subject, config), Zoom((1.2, 1.25), 0)
    seen_boxes: list[object] = []
    cropping = Weighted(lambda image, *_, box, crop: seen_boxes.append((box, crop)) or image.sum(), 1.0, crops=True)
    objective = TrainingLoss(config.trainer, torch.ones(3), PerceptualTerm("crops", cropping))
    state = TrainState(avatar, make_optimizer(avatar, config.trainer), objective)
    steps = StepRunner(state, zoom=zoom)
    index = subject.split.train[0]
    with FrameLoader(subject, frame_cache=GpuFrameCache(subject, torch.device("cpu"), 2**20)) as loader:
        cached = next(iter(loader.frames([index])))
    found = [steps.inputs(11, frame) for frame in (cached, subject.frame(index))]
    expected = zoomed(subject.frame(index), zoom.factor(11))
    for inputs in found:
        assert torch.equal(inputs.frame.image, expected.image) and inputs.frame.camera.fx == expected.camera.fx
    assert steps.inputs(10, cached).frame.camera.fx != expected.camera.fx
    train_step(state, 11, found[0])
    assert seen_boxes == [(None, None)]


def test_make_zoom_is_for_several_cameras_and_as_many_steps_as_published(tracked_folder: Path) -> None:
    one = open_small(tracked_folder, small_config())[1].recording
    camera = RigCamera("front", one.width, one.height, one.intrinsics)
    several = replace(one, rig=CameraRig((camera,), tuple(range(len(one))), (0,) * len(one)))

    def made_zoom(model: str, config: Config, recording: Recording = several) -> Zoom | None:
        avatar = make_avatar(grid_head(), torch.zeros(3), small_config(f"model={model}").model)
        return make_zoom(avatar, recording, config.trainer)

    published, fewer = (
        load_config(["experiment=gha_paper", "trainer.seed=5"]),
        load_config(["trainer.iterations=599999"]),
    )
    assert made_zoom("gaussianheadavatar_hyper", published) == Zoom(LIMITS, 5)
    assert made_zoom("gaussianheadavatar_hyper", published, one) is None
    assert made_zoom("gaussianheadavatar_hyper", fewer) is None
    assert made_zoom("hypergaussians", published) is None
