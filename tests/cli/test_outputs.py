"""What a command reads, and the files of a run, survive whatever --out is given."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import pytest
from command_line import avatar
from small_runs import SMALL
from tracked_folder import write_tracked_folder

from avatar.commands.parser import build_parser

pytestmark = pytest.mark.slow

IS_INPUT, IN_INPUT = "is an input of this command and would be overwritten", "which is an input; choose another --out"
OF_RUN, IS_FILE, IS_FOLDER = "belongs to the run {run}; choose another --out", "is a file; name a folder", "is a folder"
TRAIN = ("--frame-offset", "1", *SMALL, "trainer.iterations=2")
TRACKED = ("--frame-offset", "1")

# By the words of the command: its first output that must not be, and what is said.
REFUSED: dict[str, list[tuple[str, str]]] = {
    "train {data} " + " ".join(TRAIN): [
        ("{data}", IS_INPUT),
        ("{data}/imgs", IN_INPUT),
        ("{data}/head_model/run", IN_INPUT),
        ("{run}/eval", OF_RUN),
        ("{run}/run.json", IS_FILE),
        ("{motion}", IS_FILE),
    ],
    "train {home}/checkpoints/data --head {head} " + " ".join(TRAIN): [
        ("{home}", "lies where the run {home} would write")
    ],
    "prepare {data}": [
        ("{data}", IS_INPUT),
        ("{data}/prepared", IN_INPUT),
        ("{run}/previews", OF_RUN),
        ("{motion}", IS_FILE),
    ],
    "prepare {data} --head {head}": [("{head}", IS_INPUT), ("{head}/prepared", IN_INPUT)],
    "prepare {data} --tracking {tracking}": [("{tracking}", IS_INPUT)],
    "check {data}": [("{data}", IS_INPUT), ("{data}/imgs", IN_INPUT), ("{run}/eval", OF_RUN), ("{motion}", IS_FILE)],
    "check {data} --tracking {tracking}": [("{tracking}", IS_INPUT)],
    "drive-file {data} --frame-offset 1": [
        ("{data}/motion.npz", IN_INPUT),
        ("{run}/eval/motion.npz", OF_RUN),
        ("{motion}", "a drive file is written as .npz, not as"),
        ("{tmp}/folder.npz", IS_FOLDER),
    ],
    "drive-file {data} --tracking {tracking}": [("{tracking}/motion.npz", IN_INPUT)],
    "reenact {run} --driver {motion}": [
        ("{motion}", "a video is written as .mp4 or .mov or .mkv or .webm or .png, not as {motion}"),
        ("{tmp}/smile.mp4", "{tmp}/smile.distances.csv " + IS_INPUT),
        ("{tmp}/linked.mp4", "{tmp}/linked.distances.csv " + IS_INPUT),
        ("{run}/avatar.safetensors", "a video is written as"),
        ("{run}/run.json", "a video is written as"),
        ("{run}/eval/truth_render_error.mp4", OF_RUN),
        ("{run}/checkpoints/a.mp4", OF_RUN),
        ("{tmp}/folder.mp4", IS_FOLDER),
    ],
    "reenact {run} --driver {video}": [("{video}", IS_INPUT), ("{tmp}/same.mp4", IS_INPUT)],
    "reenact {run}/avatar.safetensors --head {head} --driver {motion}": [
        ("{head}/a.mp4", IN_INPUT),
        ("{run}/previews/a.mp4", OF_RUN),
    ],
    "reenact {run} --frame-offset 1 --driver {data}": [("{data}/a.mp4", IN_INPUT), ("{data}/imgs/a.mp4", IN_INPUT)],
    "export {run}": [
        ("{run}/avatar.safetensors", IS_INPUT),
        ("{run}/eval/a.safetensors", OF_RUN),
        ("{motion}", "smile.distances.csv does not say what to write"),
        ("{tmp}/folder.safetensors", IS_FOLDER),
        ("{run}/eval/a.html", OF_RUN),
        ("{run}/previews/a.ply", OF_RUN),
    ],
    "export {run} --format web": [("{motion}", "--format web is written as .html, not as {motion}")],
    "export {run} --format video --motion {motion}": [("{run}/checkpoints/a.mp4", OF_RUN)],
    "export {file} --head {head}": [
        ("{file}", IS_INPUT),
        ("{run}/avatar.safetensors", OF_RUN),
        ("{head}/a.safetensors", IN_INPUT),
    ],
    "refine {run}": [
        ("{data}", IS_INPUT),
        ("{data}/imgs/refined", IN_INPUT),
        ("{run}/eval", OF_RUN),
        ("{motion}", IS_FILE),
    ],
    "track {clip} --head {head}": [
        ("{clip}", IS_INPUT),
        ("{clip}/tracked", IN_INPUT),
        ("{head}/tracked", IN_INPUT),
        ("{run}/eval", OF_RUN),
        ("{motion}", IS_FILE),
    ],
    "create {clip} --head {head}": [
        ("{clip}", IS_INPUT),
        ("{clip}/me", IN_INPUT),
        ("{head}/me", IN_INPUT),
        ("{run}/eval", OF_RUN),
        ("{motion}", IS_FILE),
    ],
    "track {clip} --head {head} --matte {data}": [("{data}/tracked", IN_INPUT)],
    "compare {run} {run}": [("{run}/eval", OF_RUN), ("{run}/run.json", IS_FILE), ("{motion}", IS_FILE)],
    "bench splat --quick": [("{run}/checkpoints", OF_RUN), ("{motion}", IS_FILE)],
    "bench train {data} --quick": [("{data}", IS_INPUT), ("{data}/bench", IN_INPUT)],
    "bench render {run} --quick": [("{run}", IS_INPUT)],
    "sweep {spec}": [
        ("{tmp}", "{spec} " + IS_INPUT),
        ("{spec}", IS_FILE),
        ("{data}", IS_INPUT),
        ("{data}/imgs/sweep", IN_INPUT),
        ("{run}/eval", OF_RUN),
    ],
}
# The place is the last word of these.
REFUSED_PLACES = {
    "record": [
        ("{video}", "{video} exists already; give another name, or remove it"),
        ("{tmp}/folder.mp4", "exists already"),
        ("{run}/eval/a.mp4", OF_RUN),
        ("{run}/run.json", OF_RUN),
    ],
    "record --webcam {clip}": [("{clip}", IS_INPUT), ("{clip}/me.mp4", IN_INPUT)],
    "demo-data": [("{run}/eval/new", OF_RUN), ("{run}", "is not empty"), ("{motion}", "is not a folder")],
    "demo": [
        ("{run}/eval", OF_RUN),
        ("{home}", "{home}/run is a run of another video; choose another folder for the demo"),
        ("{motion}", IS_FILE),
    ],
}
# These write only under names of their own in the run that they are given, or nothing.
WITHOUT_A_CHOICE = {"eval", "report", "doctor", "models", "view", "completion"}
CASES = [
    *((f"{words} --out {out}", sentence) for words, outputs in REFUSED.items() for out, sentence in outputs),
    *((f"{words} {out}", sentence) for words, outputs in REFUSED_PLACES.items() for out, sentence in outputs),
]


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A user's files: a run that was measured, its avatar file elsewhere, a video with its tracking, motion, a sweep."""
    tmp = tmp_path_factory.mktemp("files")
    data = write_tracked_folder(tmp / "someone", frames=30, size=48)
    home = tmp / "home"
    run = home / "run"
    avatar("train", data, "--out", run, *TRAIN)
    avatar("eval", run, "--protocol", "strict")
    shutil.copytree(data, home / "checkpoints" / "data")
    file = Path(shutil.copy(run / "avatar.safetensors", tmp / "me.safetensors"))
    motion = tmp / "smile.distances.csv"
    motion.write_text("time,expression_0\n0,0.5\n0.04,0.7\n")
    (tmp / "linked.distances.csv").symlink_to(motion)
    video = tmp / "me.mp4"
    video.write_bytes(b"never opened")
    (tmp / "same.mp4").hardlink_to(video)
    for suffix in ("mp4", "npz", "safetensors"):
        (tmp / f"folder.{suffix}").mkdir()
    spec = tmp / "sweep.json"
    spec.write_text(json.dumps({"subjects": [{"folder": str(data), "frame_offset": 1}], "overrides": list(SMALL)}))
    tracking = Path(shutil.copytree(data / "checkpoint", tmp / "tracking"))
    head = Path(shutil.copytree(data / "head_model", tmp / "head"))
    return {
        "tmp": tmp,
        "data": data,
        "run": run,
        "home": home,
        "file": file,
        "motion": motion,
        "video": video,
        "spec": spec,
        "tracking": tracking,
        "clip": data / "imgs",
        "head": head,
    }


def contents(folder: Path) -> dict[Path, str]:
    return {
        path: hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "folder"
        for path in folder.rglob("*")
    }


@pytest.mark.parametrize(("words", "sentence"), CASES, ids=[words for words, _ in CASES])
def test_an_output_that_is_an_input_or_a_file_of_a_run_is_refused_and_nothing_is_touched(
    words: str, sentence: str, places: dict[str, Path]
) -> None:
    before = contents(places["tmp"])
    status = 2 if words.startswith("check") else 1  # whose 1 is for warnings
    output = avatar(*(word.format(**places) for word in words.split(" ")), status=status)
    assert sentence.format(**places) in output
    assert output.strip().splitlines()[-1].startswith("avatar: ")
    assert contents(places["tmp"]) == before


def test_every_command_that_writes_where_it_is_told_is_tested_here() -> None:
    tested = {words.split()[0] for words, _ in CASES}
    assert tested | WITHOUT_A_CHOICE == {*build_parser()[1]} - {"sweep-job"} and not tested & WITHOUT_A_CHOICE


def test_a_video_called_like_a_file_of_the_run_leaves_that_file_alone(places: dict[str, Path], tmp_path: Path) -> None:
    """`--out RUN/run.mp4` writes no RUN/run.json, and the run is measured as before."""
    run = Path(shutil.copytree(places["run"], tmp_path / "run"))
    before = contents(run)
    avatar("reenact", run, "--driver", places["motion"], "--out", run / "run.mp4")
    after = contents(run)
    assert {path: after[path] for path in before} == before
    assert {path.name for path in after.keys() - before.keys()} == {
        "run.mp4",
        "run.distances.csv",
        "run.choices.json",
    }
    assert "strict" in avatar("eval", run, "--protocol", "strict")


def test_a_place_beside_what_is_read_is_fine(places: dict[str, Path], tmp_path: Path) -> None:
    """Not everything is refused: a page in a folder that has one, tables in a run's folder of one's own."""
    for _ in range(2):
        assert "Page " in avatar("check", places["data"], *TRACKED, "--out", tmp_path / "page")
    run = Path(shutil.copytree(places["run"], tmp_path / "run"))
    assert "Written to" in avatar("compare", run, run, "--out", run / "tables")
    assert "Prepared in" in avatar("prepare", places["data"], *TRACKED, "--out", tmp_path / "prepared")
