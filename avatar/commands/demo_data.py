"""avatar demo-data: a person of the program's own making, as a tracked folder, a video or a folder of many cameras."""

from __future__ import annotations

from argparse import Namespace

from avatar.commands.demo import find_subject_head
from avatar.commands.outputs import check_outputs
from avatar.demo import make_camera_folder, make_head_model, make_subject, make_video
from avatar.errors import UserError
from avatar.files.names import typed
from avatar.files.video import VIDEO_SUFFIXES
from avatar.pipeline import OK

NAMES_OF_VIDEOS = (*VIDEO_SUFFIXES, ".avi", ".m4v", ".webm")  # what a person calls so is no folder


def run_demo_data(arguments: Namespace) -> int:
    check_outputs([arguments.out], [])
    is_video = arguments.video or arguments.out.suffix.lower() in NAMES_OF_VIDEOS
    if arguments.outdoors and not is_video:
        raise UserError("--outdoors is of a video: add --video")
    if arguments.cameras is not None:
        if is_video:
            raise UserError("--cameras writes a folder, no video: leave out --video and name a folder")
        if arguments.motion is not None:
            raise UserError("--cameras films a sequence of each motion: leave out --motion")
        frames, size = _or(arguments.frames, 100), _or(arguments.size, 256)
        union = make_camera_folder(arguments.out, arguments.cameras, frames, size, arguments.seed)
        print(f"Next   avatar train {typed(union)}")
        return OK
    frames, motion = _or(arguments.frames, 600), arguments.motion or "speech"
    if is_video:
        make_video(arguments.out, frames, _or(arguments.size, 512), arguments.seed, motion, arguments.outdoors)
        if not (head := find_subject_head(arguments.out)).exists():
            make_head_model(head)
            print(f"Head   {head}")
        print(f"Next   avatar create {typed(arguments.out)} --head {typed(head)}")
        return OK
    make_subject(arguments.out, frames, _or(arguments.size, 256), arguments.seed, motion)
    print(f"Next   avatar train {typed(arguments.out)}")
    return OK


def _or(given: int | None, default: int) -> int:
    return default if given is None else given
