"""Options of the commands that make or show an avatar's page."""

from __future__ import annotations

import argparse
from pathlib import Path

from avatar.commands.options import add_avatar, add_background, add_device, add_folder, add_head


def add_create(create: argparse.ArgumentParser) -> None:
    create.add_argument("video", type=Path, metavar="VIDEO", help="a video, or a folder of numbered pictures")
    add_head(create)
    create.add_argument(
        "--out", type=Path, metavar="OUT", help="where everything goes (default: the video's name, or FOLDER-avatar)"
    )
    create.add_argument(
        "--refine", type=int, metavar="N", help="improve the tracking N times through an avatar (default: 1; 0: do not)"
    )
    create.add_argument("--size", type=int, help="width of the training images in pixels (default: the video's)")
    create.add_argument("--iterations", type=int, help="optimizer steps (default: the recipe's)")
    add_device(create)
    create.add_argument("--open", action="store_true", help="show the page when it is done")
    create.add_argument("--anyway", action="store_true", help="go on where a figure of the tracking is poor")


def add_export(export: argparse.ArgumentParser) -> None:
    add_avatar(export)
    export.add_argument(
        "--format",
        choices=("web", "web-avatar", "avatar", "ply", "glb", "video"),
        help="web: a page that any browser opens; web-avatar: the file that <avatar-view> shows in pages of your own; "
        "avatar: what the other commands take; ply: Gaussians; glb: a mesh (default: by --out's ending, else web)",
    )
    export.add_argument("--out", type=Path, metavar="FILE", help="default: NAME.html, .avatar, .ply ...")
    export.add_argument(
        "--precision", choices=("small", "float"), help="web, web-avatar: of the parameters (default: small)"
    )
    export.add_argument(
        "--webcam",
        action="store_true",
        help="web, web-avatar: write the face landmarker beside it, for the reader's camera",
    )
    export.add_argument("--with-head", action="store_true", help="avatar: pack the head model in; mind its licence")
    export.add_argument("--frame", type=int, metavar="N", help="ply, glb: of its video (default: the neutral face)")
    export.add_argument(
        "--motion", metavar="MOTION", help="ply, video: test, train or all frames of its video, or a drive file"
    )
    export.add_argument(
        "--up", choices=("y", "z", "-y"), help="ply: the axis that points up (default: -y, also written --up=-y)"
    )
    export.add_argument("--texture", type=int, metavar="N", help="glb: width of the texture (default: 1024)")
    export.add_argument(
        "--camera",
        choices=("recorded", "still", "swing", "orbit"),
        help="video: its path; swing: from side to side, orbit: on an ellipse, as far as in training (default: recorded)",
    )
    export.add_argument("--size", type=int, metavar="N", help="video: its width in pixels (default: as in training)")
    add_background(export, "video: what is behind; transparent: .webm or .mov (default: as in training)")


def add_view(view: argparse.ArgumentParser) -> None:
    add_avatar(view)
    add_folder(view)
    add_device(view)
    view.add_argument("--drive", type=Path, action="append", default=[], metavar="FILE", help="a motion to play, too")
    view.add_argument("--size", type=int, metavar="N", help="width of the picture in pixels (default: as in training)")
    view.add_argument(
        "--host", default="127.0.0.1", help="address to listen on; 0.0.0.0: other machines can open the page, too"
    )
    view.add_argument("--port", type=int, default=8080, help="default: 8080; 0 takes a free one")
    view.add_argument(
        "--token",
        metavar="TEXT",
        help="what a browser and a stream must know (default: $AVATAR_TOKEN, else made up); other users of this machine "
        "can read the command line",
    )
    view.add_argument(
        "--url", metavar="ADDRESS", help="where a proxy shows the page, such as https://hub.example.org/proxy/8080/"
    )
    live = view.add_mutually_exclusive_group()
    live.add_argument(
        "--stream", type=int, metavar="PORT", help="take frames there: lines of JSON after the token; 0: a free port"
    )
    live.add_argument(
        "--webcam",
        nargs="?",
        const="0",
        metavar="N|VIDEO",
        help="follow your face: a camera's number (default: 0), or a video",
    )
    view.add_argument(
        "--open-stream",
        action="store_true",
        help="--stream: without the token, from everybody on this machine; OSC and Live Link Face, too",
    )
    view.add_argument("--fov", type=float, metavar="DEG", help="--webcam: field of view across its width, if known")
