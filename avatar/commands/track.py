"""avatar track: a video in, or a recording by several cameras, and a tracked folder out."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from avatar.commands.outputs import check_folder_output
from avatar.errors import UserError
from avatar.files.names import typed
from avatar.head.assets import load_head_assets
from avatar.pipeline import OK
from avatar.pipeline.cached_tracking import head_for_video, progress_bar
from data_prep.track.camera_rig import track_rig
from data_prep.track.crop import parse_crop
from data_prep.track.footage.source import Span
from data_prep.track.track import Choices, track


def run_track(arguments: Namespace) -> int:
    check_folder_output(arguments.out, [*arguments.videos, arguments.matte, arguments.head])
    video: Path = arguments.videos[0]
    head = head_for_video(video, arguments.head)
    span = Span(arguments.start or 0.0, arguments.end)
    if track_rig.recognise(video) or len(arguments.videos) > 1:
        return _track_rig(arguments, head, span)
    choices = Choices(
        crop=parse_crop(arguments.crop),
        size=arguments.size,
        span=span,
        focal=arguments.focal,
        field_of_view=arguments.fov,
        matte=arguments.matte,
        rotate=arguments.rotate,
    )
    track(video, arguments.out, head, load_head_assets(head), choices, progress=progress_bar)
    print(f"Look at  {arguments.out / 'overlay'}")
    print(f"Next     avatar train {typed(arguments.out)}")
    return OK


def _track_rig(arguments: Namespace, head: Path, span: Span) -> int:
    given = arguments.focal, arguments.fov, arguments.rotate, arguments.matte
    if any(value is not None for value in given) or arguments.crop != "auto":
        raise UserError(
            f"{arguments.videos[0]} is a recording by several calibrated cameras, whose whole pictures are taken as they "
            "are: leave out --focal, --fov, --rotate, --crop and --matte"
        )
    track_rig.track_rig(
        arguments.videos, arguments.out, head, load_head_assets(head), arguments.size, span, progress=progress_bar
    )
    print(f"Look at  {arguments.out / 'front' / 'overlay'}")
    print(f"Next     avatar train {typed(arguments.out)} --head {typed(head)}")
    return OK
