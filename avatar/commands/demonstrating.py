"""avatar demo-data and demo: subjects of the program's own making, and everything run on them."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from avatar.commands import OK
from avatar.commands.opening import open_driver, open_run, open_trained
from avatar.commands.outputs import check_folder_output, check_outputs
from avatar.commands.training import resume_run, train_new
from avatar.data.source import Source
from avatar.demo import make_subject, make_video
from avatar.errors import UserError
from avatar.evaluation.evaluate import evaluate
from avatar.export.web_page import write_page
from avatar.motion.reenact import reenact
from avatar.runs.checkpoint import list_checkpoints
from avatar.runs.run import RUN_FILE, read_run_info

RECIPE = ["experiment=demo"]


def run_demo_data(arguments: Namespace) -> int:
    check_outputs([arguments.out], [])
    if arguments.video:
        size = 512 if arguments.size is None else arguments.size
        make_video(arguments.out, arguments.frames, size, arguments.seed, arguments.motion)
        print(f"Next   avatar track {arguments.out} --out SUBJECT --head head_model/ of what avatar demo-data makes")
        return OK
    arguments.size = 256 if arguments.size is None else arguments.size
    make_subject(arguments.out, arguments.frames, arguments.size, arguments.seed, arguments.motion)
    print(f"Next   avatar train {arguments.out}")
    return OK


def run_demo(arguments: Namespace) -> int:
    """The whole program; what an interrupted one has done is not done again."""
    out: Path = arguments.out
    actor, driver, run = out / "actor", out / "driver", out / "run"
    check_folder_output(out)
    check_outputs([out, run], [])
    begun = (run / RUN_FILE).is_file() and list_checkpoints(run / "checkpoints")
    if begun and read_run_info(run).source.folder.resolve() != actor.resolve():
        raise UserError(f"{run} is a run of another video; choose another folder for the demo")
    if not actor.is_dir():
        make_subject(actor, 500, 192, 1, "speech")
    if not driver.is_dir():
        make_subject(driver, 100, 192, 2, "speech")
    status = resume_run(run) if begun else train_new(Source(actor, actor / "head_model"), RECIPE, run)
    if status != OK:
        return status
    trained = open_trained(run)
    video = reenact(trained, open_driver(driver, trained), run / "reenact" / "driver-relative.mp4")
    results = evaluate(open_run(run), None, write_frames=False)
    page = write_page(trained, out / "avatar.html")
    print("\nThe demo is done. Look at")
    print(f"  {results.parent / 'truth_render_error.mp4'}   held-out frames: truth, render, error")
    print(f"  {video}   another person's motion on the avatar")
    print(f"  {run / 'previews'}   how it got better during training")
    print(f"  {page.path}   the avatar itself, alive in any browser: open this first")
    return OK
