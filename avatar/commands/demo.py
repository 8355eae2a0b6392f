"""avatar demo: everything that the program does, on two people of its own making."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path
from typing import NamedTuple

from avatar.commands.held_out_figures import evaluate_or_read, figures_line
from avatar.commands.outputs import check_folder_output
from avatar.data.source import Source
from avatar.demo import make_head_model, make_subject, make_video
from avatar.errors import UserError
from avatar.export.web_page import write_page
from avatar.files.names import RUN_FOLDER, typed
from avatar.head.assets import load_head_assets
from avatar.pipeline import OK
from avatar.pipeline.cached_tracking import progress_bar, tracking_lacks
from avatar.pipeline.open_inputs import open_driver
from avatar.pipeline.reenact import reenact
from avatar.pipeline.train_refined import continue_or_begin, is_begun
from avatar.runs.run import open_trained, read_run_info
from data_prep.track.track import track

RECIPE = ["experiment=demo"]
SUBJECT_SIZE, VIDEO_SIZE = 192, 384  # pixels of the pictures, a side


class Person(NamedTuple):
    name: str
    frames: int
    seed: int


ACTOR, DRIVER = Person("actor", 500, 1), Person("driver", 100, 2)


def run_demo(arguments: Namespace) -> int:
    """The whole program; what an interrupted one has done is not done again."""
    out: Path = arguments.out
    actor, driver, run = out / ACTOR.name, out / DRIVER.name, out / RUN_FOLDER
    check_folder_output(out, [])
    if is_begun(run) and read_run_info(run).source.folder.resolve() != actor.resolve():
        raise UserError(f"{run} is a run of another video; choose another folder for the demo")
    missing = [person for person in (ACTOR, DRIVER) if not (out / person.name).is_dir()]
    lacking = tracking_lacks() if missing else []
    if lacking:
        print(f"The two people are made with their tracking, not filmed and tracked: {'; '.join(lacking)}")
    make = make_tracked if lacking else film_and_track
    for person in missing:
        make(person, out)
    status = continue_or_begin(Source(actor, find_subject_head(actor)), RECIPE, run)
    if status != OK:
        return status
    trained = open_trained(run)
    video = reenact(trained, open_driver(driver, trained), run / "reenact" / "driver-relative.mp4")
    results = evaluate_or_read(run)
    page = write_page(trained, out / "avatar.html")
    print("\nThe demo is done.")
    if (film := out / f"{ACTOR.name}.mp4").is_file():
        print(f"  {film}   the video that the avatar was made from")
    print(
        f"  {results.parent / 'truth_render_error.mp4'}   held-out frames: truth, render, error; {figures_line(results)}"
    )
    print(f"  {video}   another person's motion on the avatar")
    print(f"  {run / 'previews'}   how it got better during training")
    print(f"  avatar eval {typed(run)}   prints all its figures, avatar view {typed(run)} moves it by hand")
    print(f"\nOpen this first: {page.path}, the avatar in a browser")
    return OK


def film_and_track(person: Person, out: Path) -> None:
    """As with anybody's own video: only its pictures are known."""
    head, video = find_subject_head(out / person.name), out / f"{person.name}.mp4"
    if not head.is_dir():
        make_head_model(head)
    if not video.is_file():
        make_video(video, person.frames, VIDEO_SIZE, person.seed, "speech")
    track(video, out / person.name, head, load_head_assets(head), progress=progress_bar)


def make_tracked(person: Person, out: Path) -> None:
    make_subject(out / person.name, person.frames, SUBJECT_SIZE, person.seed, "speech")


def find_subject_head(folder: Path) -> Path:
    """The head model in a subject's folder, where it has one, or the one of all that were filmed."""
    own = folder / "head_model"
    return own if own.is_dir() else folder.with_name("head_model")
