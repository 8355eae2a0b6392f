"""A whole clip: it gets better, to the same bits by any number of threads and after an interruption."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from drawn_clip import BACKGROUND, SIZE, Clip, drawn_clip, patterned_avatar, screen_errors, wrongly_tracked

from avatar.data.subject import Subject
from avatar.errors import UserError
from avatar.gaussians.base_model import Avatar
from avatar.pose_refinement import refine_subject as refine_module
from avatar.pose_refinement.refine_subject import (
    SAMPLES,
    Refined,
    estimated_seconds,
    fingerprint,
    frozen,
    refine_subject,
)
from avatar.pose_refinement.tracking_values import EXPRESSION, values_of
from avatar.pose_refinement.write_results import COLUMNS, frames_csv, movements, sheet, sheet_frames, summary


@pytest.fixture(scope="module")
def avatar(tmp_path_factory: pytest.TempPathFactory) -> Avatar:
    return patterned_avatar(tmp_path_factory.mktemp("head"))


@pytest.fixture(scope="module")
def clip(avatar: Avatar) -> Clip:
    return drawn_clip(avatar, frames=10, train=7)


@pytest.fixture(scope="module")
def wrong(clip: Clip) -> Clip:
    return wrongly_tracked(clip, common=False)


def refined(avatar: Avatar, clip: Clip, progress: Path, said: list[str] | None = None) -> Refined | None:
    say = (said if said is not None else []).append
    return refine_subject(avatar, cast(Subject, clip), SIZE, BACKGROUND, progress, say)


@pytest.fixture(scope="module")
def result(avatar: Avatar, wrong: Clip, tmp_path_factory: pytest.TempPathFactory) -> Refined:
    progress = tmp_path_factory.mktemp("work") / "progress"
    found = refined(avatar, wrong, progress)
    assert found is not None and progress.exists()
    return found


def with_tracks(clip: Clip, tracks: dict[str, torch.Tensor]) -> Clip:
    return replace(clip, recording=replace(clip.recording, tracks=tracks))


def same(a: Refined, b: Refined) -> bool:
    return all(torch.equal(a.tracks[name], b.tracks[name]) for name in a.tracks) and np.array_equal(a.after, b.after)


def test_every_frame_comes_nearer_to_the_truth(avatar: Avatar, clip: Clip, wrong: Clip, result: Refined) -> None:
    assert not result.kept.any()
    assert (result.after > result.before + 3.0).all() and result.after.mean() > 30.0
    better = with_tracks(wrong, result.tracks)
    for frames in (range(7), range(7, 10)):
        before, after = (screen_errors(avatar, one.recording, clip.recording, frames) for one in (wrong, better))
        assert after < 0.3 * before
    assert torch.equal(result.tracks["shape"], wrong.recording.tracks["shape"])
    now, then = (values_of(one.recording.tracks)[:, EXPRESSION] for one in (better, wrong))
    low, high = then[:7].amin(dim=0).minimum(then), then[:7].amax(dim=0).maximum(then)
    assert bool((now >= low).all()) and bool((now <= high).all())


def test_what_all_training_frames_share_stays(
    avatar: Avatar, wrong: Clip, result: Refined, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Turns, shifts and depths that every frame's picture asks for are the avatar's preference."""
    own = refine_module.smoothed

    def shared(moves: torch.Tensor, *rest: Any) -> torch.Tensor:
        return own(moves, *rest) + torch.where(torch.arange(moves.shape[1]) < 6, 0.03, 0.0)

    monkeypatch.setattr(refine_module, "smoothed", shared)
    found = refined(avatar, wrong, tmp_path / "progress")
    assert found is not None and (found.after < result.after).all() and not found.kept.any()
    for name in ("R", "t", "expression", "jaw"):
        torch.testing.assert_close(found.tracks[name], result.tracks[name], rtol=0, atol=2e-6)


def test_what_held_out_frames_share_moves_no_training_frame(
    avatar: Avatar, wrong: Clip, result: Refined, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = refine_module.smoothed

    def shared(moves: torch.Tensor, *rest: Any) -> torch.Tensor:
        """Held-out frames, of which there are 3, ask for a turn and a shift."""
        return own(moves, *rest) + torch.where(torch.arange(moves.shape[1]) < 6, 0.045, 0.0) * (len(moves) == 3)

    monkeypatch.setattr(refine_module, "smoothed", shared)
    found = refined(avatar, wrong, tmp_path / "progress")
    assert found is not None and not found.kept.any()
    for name in ("R", "t"):
        assert torch.equal(found.tracks[name][:7], result.tracks[name][:7])
        assert not torch.equal(found.tracks[name][7:], result.tracks[name][7:])


def test_the_avatar_is_left_as_it_was(avatar: Avatar, wrong: Clip, result: Refined) -> None:
    assert all(parameter.requires_grad for parameter in avatar.parameters())
    assert all(parameter.grad is None for parameter in avatar.parameters())
    one = next(avatar.parameters()).requires_grad_(False)
    with frozen(avatar):
        assert not any(parameter.requires_grad for parameter in avatar.parameters())
    assert not one.requires_grad and sum(not p.requires_grad for p in avatar.parameters()) == 1
    one.requires_grad_(True)


@pytest.mark.slow
@pytest.mark.parametrize("threads", ["1", "3"])
def test_the_number_of_threads_does_not_matter(
    avatar: Avatar, wrong: Clip, result: Refined, threads: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AVATAR_THREADS", threads)
    again = refined(avatar, wrong, tmp_path / "progress")
    assert again is not None and same(again, result)


@contextmanager
def stopping_after(frames: int, seen: list[int]) -> Iterator[Callable[[], bool]]:
    def asked() -> bool:
        seen.append(1)
        return len(seen) >= frames

    yield asked


def interrupted_after(frames: int, avatar: Avatar, clip: Clip, folder: Path) -> Path:
    """The progress of a refinement that was interrupted."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(refine_module, "interruption", lambda: stopping_after(frames, []))
        assert refined(avatar, clip, folder / "progress") is None
    return folder / "progress"


def test_an_interruption_is_gone_on_from_to_the_same_bits(
    avatar: Avatar, wrong: Clip, result: Refined, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    progress = interrupted_after(4, avatar, wrong, tmp_path)
    assert progress.is_file() and list(tmp_path.iterdir()) == [progress]
    worked: list[int] = []
    own = refine_module._Work.refine
    monkeypatch.setattr(
        refine_module._Work, "refine", lambda self, frame, f: worked.append(frame) or own(self, frame, f)
    )
    said: list[str] = []
    again = refined(avatar, wrong, progress, said)
    assert again is not None and same(again, result)
    assert np.array_equal(again.before, result.before)
    assert sorted(worked) == list(range(4, 10)) and "going on after 4 of 10 frames" in said[0]


@pytest.mark.slow
def test_progress_of_something_else_is_not_gone_on_from(
    avatar: Avatar, wrong: Clip, result: Refined, tmp_path: Path
) -> None:
    progress = interrupted_after(3, avatar, replace(wrong, data_hash="1" * 64), tmp_path)
    said: list[str] = []
    again = refined(avatar, wrong, progress, said)
    assert again is not None and same(again, result) and not said
    progress.write_bytes(b"\x08" + bytes(40))
    again = refined(avatar, wrong, progress, said)
    assert again is not None and same(again, result) and not said


def test_the_fingerprint_is_that_of_the_parameters(avatar: Avatar) -> None:
    before = fingerprint(avatar)
    with torch.no_grad():
        avatar.quats[5, 2] += 1e-6
    assert fingerprint(avatar) != before
    with torch.no_grad():
        avatar.quats[5, 2] -= 1e-6
    assert len(before) == 64


@pytest.mark.slow
def test_a_frame_without_a_head_keeps_its_tracking(avatar: Avatar, wrong: Clip, tmp_path: Path) -> None:
    hidden = list(wrong.pictures)
    for index in (0, 4):
        hidden[index] = replace(hidden[index], head_mask=torch.zeros(SIZE, SIZE))
    found = refined(avatar, replace(wrong, pictures=tuple(hidden)), tmp_path / "progress")
    assert found is not None and np.isnan(found.before[4]) and np.isnan(found.after[4])
    assert found.kept.tolist() == [index in (0, 4) for index in range(10)]
    for name in ("R", "t", "expression", "jaw"):
        assert torch.equal(found.tracks[name][4], wrong.recording.tracks[name][4])
        assert not torch.equal(found.tracks[name][3], wrong.recording.tracks[name][3])


@pytest.mark.slow
def test_a_frame_that_smoothing_makes_worse_keeps_its_tracking(
    avatar: Avatar, clip: Clip, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The true tracking cannot be improved: whatever is done to it then is not taken."""

    def worse(moves: torch.Tensor, *_: Any) -> torch.Tensor:
        return moves + torch.where(torch.arange(len(moves)) == 6, 1.0, 0.0)[:, None]

    monkeypatch.setattr(refine_module, "smoothed", worse)
    found = refined(avatar, clip, tmp_path / "progress")
    assert found is not None and found.kept[6] and found.after[6] == found.before[6]
    assert all(torch.equal(found.tracks[n][6], v[6]) for n, v in clip.recording.tracks.items() if n != "shape")


def test_an_unreadable_frame_is_an_error_of_its_own(avatar: Avatar, wrong: Clip, tmp_path: Path) -> None:
    class Broken(Clip):
        def frame(self, index: int, size: int | None) -> Any:
            if index == 5:
                raise UserError("00006.jpg is cut short")
            return super().frame(index, size)

    broken = Broken(wrong.recording, wrong.pictures, wrong.manifest)
    with pytest.raises(UserError, match=r"00006\.jpg is cut short"):
        refined(avatar, broken, tmp_path / "progress")


def test_the_record_tells_what_happened(avatar: Avatar, wrong: Clip, result: Refined) -> None:
    centre = avatar.head.neutral_vertices().mean(dim=0)
    rows = [line.split(",") for line in frames_csv(cast(Subject, wrong), result, centre).splitlines()]
    assert tuple(rows[0]) == COLUMNS and len(rows) == 11
    assert rows[8][:3] == ["7", "00008", "test"] and float(rows[8][3]) == pytest.approx(result.before[7], abs=1e-4)
    assert 0.05 < float(rows[8][5]) < 2.0 and 0.05 < float(rows[8][6]) < 5.0
    odd = Clip(replace(wrong.recording, names=("caf\udce9",) * 10), wrong.pictures, wrong.manifest)
    assert rb"7,caf\udce9,test" in frames_csv(cast(Subject, odd), result, centre).encode()
    lines = "\n".join(summary(cast(Subject, wrong), result, centre))
    assert f"{result.before[:7].mean():.2f} -> {result.after[:7].mean():.2f} dB" in lines
    assert "as they were" not in lines
    kept = replace(result, kept=np.arange(10) < 2)
    assert "2 frames, which would have fitted no better" in summary(cast(Subject, wrong), kept, centre)[-1]
    unseen = replace(kept, before=np.where(np.arange(10) == 1, np.nan, result.before))
    told = [line[18:] for line in summary(cast(Subject, wrong), unseen, centre)[-2:]]
    assert told == ["1 frames, which would have fitted no better", "1 frames, which show no head"]


def test_movements_are_the_turn_and_the_way_of_the_centre(clip: Clip) -> None:
    from avatar.pose_refinement.tracking_values import moved_tracks

    values = values_of(clip.recording.tracks)
    values[:, 1], values[:, 3] = 0.02, 0.003
    centre = torch.tensor([0.0, 0.02, 0.01])
    moved = moved_tracks(clip.recording.tracks, values, torch.ones(values.shape[1], dtype=torch.bool), centre)
    turns, shifts = movements(clip.recording.tracks, moved, centre)
    assert turns == pytest.approx(np.full(10, 0.02), abs=1e-5) and shifts == pytest.approx(np.full(10, 0.003), abs=1e-6)


def test_the_sheet_shows_held_out_frames(avatar: Avatar, wrong: Clip, result: Refined) -> None:
    import cv2

    assert sheet_frames((7, 8, 9), result) == [7, 8, 9]
    gains = replace(result, after=result.before + np.array([0, 0, 5, 0, 0, 0, 1, 2, 3, 0.5]))
    assert sheet_frames(range(2, 10), gains)[:2] == [2, 3]
    after = with_tracks(wrong, result.tracks).recording
    data = sheet(avatar, cast(Subject, wrong), result, after, SIZE, BACKGROUND)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (3 * (SIZE + 16), 5 * SIZE, 3)
    errors = image[16:SIZE].astype(float)
    assert errors[:, 4 * SIZE :].mean() < 0.7 * errors[:, 3 * SIZE : 4 * SIZE].mean()


def test_the_estimate_is_the_time_of_a_frame_for_every_frame(
    avatar: Avatar, wrong: Clip, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a clock that a curvature moves by 100 s, a refined frame by 10 s and a measured one by 1 s."""
    now = [0.0]

    def taking(seconds: float, result: object) -> Callable[..., object]:
        def work(*_: object) -> object:
            now[0] += seconds
            return result

        return work

    monkeypatch.setenv("AVATAR_THREADS", "1")
    monkeypatch.setattr(refine_module.time, "perf_counter", lambda: now[0])
    values = len(refine_module.find_parameterization(wrong.recording.tracks, range(7), torch.zeros(3)).index)
    monkeypatch.setattr(refine_module._Work, "_curvatures", taking(100.0, torch.eye(values)[None]))
    monkeypatch.setattr(refine_module._Work, "refine", taking(10.0, None))
    monkeypatch.setattr(refine_module._Work, "measure", taking(1.0, None))
    assert estimated_seconds(avatar, cast(Subject, wrong), SIZE, BACKGROUND) == SAMPLES * 100.0 + 10 * 11.0


def test_training_frames_without_a_head_are_refused(avatar: Avatar, wrong: Clip, tmp_path: Path) -> None:
    hidden = tuple(replace(picture, head_mask=torch.zeros(SIZE, SIZE)) for picture in wrong.pictures)
    with pytest.raises(UserError, match="no head is to be seen in the training frames of drawn"):
        refined(avatar, replace(wrong, pictures=hidden), tmp_path / "progress")
