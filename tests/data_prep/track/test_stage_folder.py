"""Stages are made once, whole or not at all, and the folder appears when it is complete."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from heads import grid_head

from avatar.errors import UserError
from avatar.files.atomic import check_target
from avatar.head.assets import HeadAssets
from data_prep.formats.frame_track import FrameTrack
from data_prep.prepare.checksums import CONTENTS_FILE, write_contents
from data_prep.progress import silent
from data_prep.track import tracking_stages
from data_prep.track.faces.landmarks import BLENDSHAPES, NUM_POINTS, Landmarks
from data_prep.track.fit.result import Clip, Fit
from data_prep.track.stage_folder import growing
from data_prep.track.tracking_stages import Choices, TrackingStages


def test_a_stage_is_made_once_for_its_inputs(tmp_path: Path) -> None:
    made: list[int] = []

    def make(value: int):
        def write(folder: Path) -> dict[str, int]:
            made.append(value)
            (folder / "file").write_text(str(value))
            return {"value": value}

        return write

    with growing(tmp_path / "out") as stages:
        first = stages.run("one", {"in": 1}, make(1))
        assert first[0] == {"value": 1} and stages.run("one", {"in": 1}, make(2)) == first
    with growing(tmp_path / "out") as stages:  # another process
        assert stages.run("one", {"in": 1}, make(3)) == first
        other = stages.run("one", {"in": 2}, make(4))
        assert other[0] == {"value": 4} and other[1] != first[1]
        assert (stages.path / "one" / "file").read_text() == "4"
        stages.run("helper", {}, make(5))
        stages.finish(tmp_path / "out", ("helper",))
    assert made == [1, 4, 5]
    assert [p.name for p in tmp_path.iterdir()] == ["out"]
    assert sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*")) == ["out", "out/one", "out/one/file"]


def test_a_better_stage_takes_anothers_place(tmp_path: Path) -> None:
    def writes(text: str):
        def write(folder: Path) -> dict[str, int]:
            (folder / "file").write_text(text)
            return {}

        return write

    with growing(tmp_path / "out") as stages:
        stages.run("frames", {}, writes("as filmed"))
        stages.run("cleaned", {}, writes("better"))
        stages.finish(tmp_path / "out", (), better={"cleaned": "frames"})
    assert (tmp_path / "out/frames/file").read_text() == "better"
    assert sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*")) == ["out", "out/frames", "out/frames/file"]


@pytest.mark.parametrize("interruption", [KeyboardInterrupt, UserError("no")])
def test_an_interruption_keeps_whole_stages_only(tmp_path: Path, interruption: BaseException) -> None:
    def interrupted(folder: Path) -> dict[str, int]:
        (folder / "half").write_text("half")
        raise interruption

    kind = UserError if isinstance(interruption, UserError) else KeyboardInterrupt
    with pytest.raises(kind), growing(tmp_path / "out") as stages:
        stages.run("one", {}, lambda folder: {})
        stages.run("two", {}, interrupted)
    assert [p.name for p in tmp_path.iterdir()] == [".out.partial"]
    assert [p.name for p in (tmp_path / ".out.partial").iterdir()] == ["one"]
    with growing(tmp_path / "out") as stages:
        assert stages.run("one", {}, interrupted)[0] == {}  # it is not made again


def test_an_interruption_keeps_the_stages_of_a_folder_that_a_stage_makes(tmp_path: Path) -> None:
    made: list[str] = []

    def outer(stop: bool):
        def write(folder: Path) -> dict[str, int]:
            folder.rmdir()
            with growing(folder) as stages:
                stages.run("one", {}, lambda _: made.append("one") or {})
                if stop:
                    raise KeyboardInterrupt
                stages.finish(folder, ())
            return {}

        return write

    with pytest.raises(KeyboardInterrupt), growing(tmp_path / "out") as stages:
        stages.run("front", {}, outer(stop=True))
    with growing(tmp_path / "out") as stages:
        stages.run("front", {}, outer(stop=False))
        stages.finish(tmp_path / "out", ())
    assert made == ["one"]
    assert sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*")) == ["out", "out/front", "out/front/one"]


def test_nothing_is_left_where_nothing_was_done(tmp_path: Path) -> None:
    def fails(folder: Path) -> dict[str, int]:
        (folder / "half").write_text("half")
        raise UserError("no face")

    with pytest.raises(UserError, match="no face"), growing(tmp_path / "out") as stages:
        stages.run("one", {}, fails)
    assert list(tmp_path.iterdir()) == []


def test_a_fit_is_made_again_for_another_lens_head_or_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lenses: list[float] = []

    def fitted(clip: Clip, *_: object) -> Fit:
        lenses.append(clip.intrinsics[0])
        values = {"expression": 2, "jaw": 6, "eyes": 12, "eyelids": 2, "neck": 6, "t": 3, "shape": 2}
        track = FrameTrack(
            **{name: np.zeros(count) for name, count in values.items()},
            R=np.eye(3), intrinsics=np.array(clip.intrinsics), size=(64, 64),
        )  # fmt: skip
        return Fit({0: track}, {})

    monkeypatch.setattr(tracking_stages, "fit_tracks", fitted)
    points, scores = np.zeros((1, NUM_POINTS, 3), np.float32), np.zeros((1, len(BLENDSHAPES)), np.float32)
    landmarks = Landmarks(points, scores, np.ones(1, bool), (64, 64), 25.0)
    footage, head = SimpleNamespace(), grid_head()
    (tmp_path / "head.npz").touch()  # what lies beside it is in the key too
    with growing(tmp_path / "out") as stages:

        def fit(lens: float = 500.0, which: HeadAssets = head, pictures: str = "key of the frames") -> None:
            own = TrackingStages(stages, footage, Choices(), which, silent)  # type: ignore[arg-type]
            assert (
                own.fit(landmarks, (lens, lens, 32.0, 32.0), tmp_path / "head.npz", [pictures]).tracks[0].intrinsics[0]
                == lens
            )

        fit()
        fit()
        assert lenses == [500.0]
        fit(lens=600.0)
        assert lenses == [500.0, 600.0]
        fit(lens=600.0, pictures="of others")
        assert len(lenses) == 3
        fit(lens=600.0, pictures="of others", which=replace(head, fingerprint="another"))
        assert len(lenses) == 4


def test_a_damaged_record_is_made_again(tmp_path: Path) -> None:
    with growing(tmp_path / "out") as stages:
        stages.run("one", {}, lambda folder: {"n": 1})
        for content in (b"", b"[1]", b'{"key": 1}', b"\xff"):
            (stages.path / "one" / ".stage.json").write_bytes(content)
            assert stages.run("one", {}, lambda folder: {"n": 2})[0] == {"n": 2}


def test_one_process_at_a_time(tmp_path: Path) -> None:
    refused = pytest.raises(UserError, match="is being written by process")
    with growing(tmp_path / "out"), refused, growing(tmp_path / "out"):
        pass


def test_nobody_else_begins_while_a_folder_is_sealed(tmp_path: Path) -> None:
    sealed: list[Path] = []

    def seal(folder: Path) -> None:
        with pytest.raises(UserError, match="is being written by process"), growing(tmp_path / "out"):
            pass
        write_contents(folder)
        sealed.append(folder)

    with growing(tmp_path / "out") as stages:
        stages.run("one", {}, lambda folder: {})
        stages.finish(tmp_path / "out", (), seal=seal)
    assert sealed and {path.name for path in (tmp_path / "out").iterdir()} == {"one", CONTENTS_FILE}
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_the_folder_that_a_command_runs_in_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for begin in (lambda: growing(Path()).__enter__(), lambda: check_target(Path())):
        with pytest.raises(UserError, match="is the folder that this runs in"):
            begin()


def test_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written"), growing(tmp_path / "file" / "out"):
        pass
