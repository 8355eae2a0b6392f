"""What the check measures: angles, jumps, lenses, and how far held-out frames lie outside of the training."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from some_tracks import track

from avatar.data.source import Source
from avatar.data.split import Split
from avatar.errors import UserError
from data_prep.check import clip as clip_module
from data_prep.check import plots
from data_prep.check.check_images import _exposure
from data_prep.check.check_tracking import _camera
from data_prep.check.clip import Clip
from data_prep.check.coverage import Coverage, measure_coverage
from data_prep.check.examine_image import look_at, measure_matte
from data_prep.check.head_angles import head_angles, measure_jumps
from data_prep.formats.frame_files import ALPHA, HEAD, IMAGE
from data_prep.formats.frame_track import FrameTrack, Tracking
from data_prep.prepare.frame_offset import OffsetEstimate

TRAIN, TEST = 20, 5


def clip(yaws: list[float], expressions: np.ndarray) -> dict[int, FrameTrack]:
    return {
        7 + n: track((0.0, yaw, 0.0), expression=row)
        for n, (yaw, row) in enumerate(zip(yaws, expressions, strict=True))
    }


def covered(tracks: dict[int, FrameTrack]) -> Coverage:
    read: Any = SimpleNamespace(source=SimpleNamespace(division={}, shots={}), tracked=lambda: iter(tracks.items()))
    found = measure_coverage(read, list(tracks))
    assert isinstance(found, Coverage) and len(found.split.train) == TRAIN
    return found


def test_held_out_frames_are_far_where_no_training_frame_is_near() -> None:
    """In numbers of images; held-out frames that are like each other are as far."""
    rng = np.random.default_rng(0)
    expressions = 0.5 * rng.standard_normal((TRAIN + TEST, 4)) * (1.0, 0.5, 0.2, 0.1)
    yaws = [*np.linspace(-20, 0, TRAIN), -10.0, 12.0, 12.0, -20.0, 4.0]
    expressions[[20, 22]] = 0.0
    expressions[[21, 23, 24]] = (9.0, 0.0, 0.0, 0.0)
    found = covered(clip(yaws, expressions))
    assert found.far_pose == (7 + 21, 7 + 22)
    assert found.far_expression == (7 + 21, 7 + 23, 7 + 24)


def test_held_out_frames_do_not_measure_themselves() -> None:
    rng = np.random.default_rng(0)
    expressions = rng.standard_normal((TRAIN + TEST, 4))
    plain = covered(clip([0.0] * (TRAIN + TEST), expressions))
    expressions[TRAIN:] += (50.0, -30.0, 0.0, 9.0)
    other = covered(clip([0.0] * (TRAIN + TEST), expressions))
    assert np.array_equal(plain.expressions[:TRAIN], other.expressions[:TRAIN])
    assert other.far_expression == tuple(range(7 + TRAIN, 7 + TRAIN + TEST))


@pytest.mark.parametrize(
    ("turn", "angles"),
    [((0, 0, 0), (0, 0, 0)), ((0, 20, 0), (20, 0, 0)), ((-10, 0, 0), (0, 10, 0)), ((0, 0, -15), (0, 0, 15))],
)
def test_angles_of_heads(turn: tuple[float, float, float], angles: tuple[float, float, float]) -> None:
    """Degrees: turned to the image's right, looking up, tilted to the image's right."""
    found = head_angles(track(turn).R[None])
    assert (found.yaw[0], found.pitch[0], found.roll[0]) == pytest.approx(angles, abs=1e-6)


def test_a_frame_is_compared_with_its_neighbours_in_time() -> None:
    """A head that turns evenly is never sudden; nothing is said beside a frame that is missing."""
    tracks = [track((0.0, 2.0 * n, 0.0), t=np.array([0.001 * n, 0.0, 0.8])) for n in range(6)]
    tracks[3] = track((0.0, 11.0, 0.0), t=np.array([0.013, 0.0, 0.8]))
    found = measure_jumps([0, 1, 2, 3, 4, 5], tracks)
    np.testing.assert_allclose(found.rotation, [np.nan, 0.0, 2.5, 5.0, 2.5, np.nan], atol=1e-4)
    np.testing.assert_allclose(found.translation, [np.nan, 0.0, 5.0, 10.0, 5.0, np.nan], atol=1e-4)
    gap = measure_jumps([0, 1, 2, 4, 5, 6], tracks)
    assert np.isnan(gap.rotation).tolist() == [True, False, True, True, False, True]


def test_a_matte_that_cannot_be_read_is_not_measured(tmp_path: Path) -> None:
    (tmp_path / "any").write_bytes(b"")

    def decode(kind: str, _: bytes, path: Path) -> np.ndarray:
        if kind == ALPHA:
            raise UserError(f"{path} is damaged")
        return np.full((64, 64, 3) if kind == IMAGE else (64, 64), 200, np.uint8)

    whole = {IMAGE: tmp_path / "any", HEAD: tmp_path / "any"}
    matte = look_at(whole, decode).matte
    assert matte is not None and (matte.covered, matte.haze, matte.holes, matte.specks) == (1.0, 0.0, 0.0, 0.0)
    assert look_at(whole | {ALPHA: tmp_path / "any"}, decode).matte is None
    thin, head = np.full((64, 64), 51, np.uint8), np.full((64, 64), 255, np.uint8)
    thin[:16, :16] = 255
    found = measure_matte(thin, head, thin > 127)
    assert (found.covered, found.haze) == pytest.approx((1 / 16, 0.2))
    assert measure_matte(thin // 4, head, thin > 255).haze == pytest.approx((15 * 12 + 63) / 16 / 255), "nobody at all"


@pytest.mark.parametrize(
    ("level", "behind", "changes"),
    [(100.0, None, 1), (1.0, None, 0), (100.0, 2.0, 1), (100.0, 1.0, 0), (100.0, 0.5, 0)],
)
def test_light_that_changes_is_told_where_there_is_light(level: float, behind: float | None, changes: int) -> None:
    """Pictures that are black have no light that could change; a lamp on the head alone is not the camera's exposure."""
    views = {}
    for n in range(60):
        background = None if behind is None else np.full(3, 60.0 * (1 if n < 30 else behind))
        views[n] = SimpleNamespace(head_colour=np.full(3, level * (1 + (n >= 30))), background_colour=background)
    read: Any = SimpleNamespace(views=views, name=str, names=tuple, files=SimpleNamespace(images={}, alphas={}))
    assert len(list(_exposure(read))) == changes


def test_a_lens_is_judged_by_the_width() -> None:
    def problems(size: tuple[int, int], fx: float) -> list[str]:
        one = track(size=size, intrinsics=np.array([fx, fx, size[0] / 2, size[1] / 2]))
        read: Any = SimpleNamespace(tracking=SimpleNamespace(frames={0: one}))
        return [finding.check for finding in _camera(read)]

    assert problems((1920, 400), 1000.0) == [] and problems((400, 1920), 1000.0) == []
    assert problems((1920, 400), 900.0) == ["focal-length"]  # 94 degrees


def test_what_is_shaded_is_held_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """And nothing else, where a folder holds out frames from all over the clip."""
    monkeypatch.setattr(plots, "plot", lambda figure, *_: figure)
    images, test = tuple(range(7, 47)), (4, 10, 11, 12, 38)
    split = Split(tuple(n for n in range(40) if n not in test), test)
    angles = head_angles(np.stack([track((0.0, 0.0, 0.0)).R] * 40))
    figure: Any = plots.coverage_plots(Coverage(images, split, angles, np.zeros((40, 2)), (), ()))[2]
    spans = [patch.get_extents().transformed(figure.axes[0].transData.inverted()) for patch in figure.axes[0].patches]
    shaded = [number for number in images if any(span.x0 < number < span.x1 for span in spans)]
    assert shaded == [images[place] for place in test]


def test_the_ends_of_a_clip_are_compared_where_both_are_clear(monkeypatch: pytest.MonkeyPatch) -> None:
    def parts(*found: int | str) -> tuple[int, int] | None:
        each = iter(one if isinstance(one, str) else OffsetEstimate(one, 9.0, 0, 60, False) for one in found)
        monkeypatch.setattr(clip_module, "_estimate", lambda *_: next(each))
        numbers: Any = dict.fromkeys(range(3 * clip_module.MIN_PART))
        nothing: Any = None
        read = Clip(Source(Path(), Path()), nothing, Tracking(numbers, {}, [], {}), (), (), None, None, "", None)
        done = clip_module._with_offset(read, nothing)
        assert done.offset == (None if found[2] == "unclear" else found[2])
        return done.part_offsets

    assert parts(1, 2, 1) == (1, 2)
    assert parts(1, "unclear", 1) is None and parts("unclear", 1, "unclear") is None
