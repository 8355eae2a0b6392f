"""avatar demo-data: a person of the program's own making, as a tracked folder or a video."""

from __future__ import annotations

from argparse import Namespace

from avatar.commands.demo import head_beside
from avatar.commands.outputs import check_outputs
from avatar.demo import make_head_model, make_subject, make_video
from avatar.files.video import VIDEO_SUFFIXES
from avatar.pipeline import OK

NAMES_OF_VIDEOS = (*VIDEO_SUFFIXES, ".avi", ".m4v", ".webm")  # what a person calls so is no folder


def run_demo_data(arguments: Namespace) -> int:
    check_outputs([arguments.out], [])
    if arguments.video or arguments.out.suffix.lower() in NAMES_OF_VIDEOS:
        size = 512 if arguments.size is None else arguments.size
        make_video(arguments.out, arguments.frames, size, arguments.seed, arguments.motion)
        if not (head := head_beside(arguments.out)).exists():
            make_head_model(head)
            print(f"Head   {head}")
        print(f"Next   avatar train {arguments.out} --head {head}")
        return OK
    arguments.size = 256 if arguments.size is None else arguments.size
    make_subject(arguments.out, arguments.frames, arguments.size, arguments.seed, arguments.motion)
    print(f"Next   avatar train {arguments.out}")
    return OK
