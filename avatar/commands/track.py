"""avatar track: a video in, a tracked folder out."""

from __future__ import annotations

from argparse import Namespace

from avatar.commands.outputs import check_folder_output, check_outputs
from avatar.head.assets import load_head_assets
from avatar.pipeline import OK
from avatar.pipeline.track import bar, head_for_video
from data_prep.track.crop import parse_crop
from data_prep.track.footage.source import Span
from data_prep.track.track import Choices, track


def run_track(arguments: Namespace) -> int:
    check_folder_output(arguments.out)
    check_outputs([arguments.out], [arguments.video, arguments.matte, arguments.head])
    head = head_for_video(arguments.video, arguments.head)
    choices = Choices(
        crop=parse_crop(arguments.crop),
        size=arguments.size,
        span=Span(arguments.start or 0.0, arguments.end),
        focal=arguments.focal,
        field_of_view=arguments.fov,
        matte=arguments.matte,
        rotate=arguments.rotate,
    )
    track(arguments.video, arguments.out, head, load_head_assets(head), choices, progress=bar)
    print(f"Look at  {arguments.out / 'overlay'}")
    print(f"Next     avatar train {arguments.out}")
    return OK
