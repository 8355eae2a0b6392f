"""Options that several commands share."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_source(parser: argparse.ArgumentParser) -> None:
    """The options that name a tracked folder and what belongs to it."""
    parser.add_argument("folder", type=Path, metavar="SUBJECT", help="tracked video folder")
    add_head(parser)
    add_reading(parser)
    add_tracking(parser)


def add_reading(parser: argparse.ArgumentParser) -> None:
    """How a tracked folder is read."""
    parser.add_argument(
        "--data-format",
        metavar="NAME",
        help="metrical-tracker, VHAP, INSTA, IMavatar, GaussianBlendshapes, NeRSemble or NHA (default: by the files)",
    )
    parser.add_argument(
        "--cameras",
        metavar="all|front|NAME,...",
        help="of a folder with several cameras: which are used (default: all)",
    )
    parser.add_argument("--fps", type=float, metavar="N", help="frames a second (default: the folder's, else 25)")
    parser.add_argument(
        "--max-left-out", type=float, metavar="SHARE", help="of the frames that may be unusable (default: 0.05)"
    )
    parser.add_argument(
        "--ignore-misfit", action="store_true", help="go on where the tracked head does not lie on the masks"
    )


def add_tracking(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--tracking", type=Path, metavar="DIR", help="folder of the .frame files, if not in SUBJECT")
    parser.add_argument("--frame-offset", type=int, metavar="N", help="image number minus .frame number, if known")


def add_run(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", type=Path, metavar="RUN", help="folder that avatar train wrote")
    add_head(parser)


def add_folder(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--folder", type=Path, metavar="DIR", help="where the tracked folder is, if it has moved")


def add_avatar(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", type=Path, metavar="AVATAR", help="folder that avatar train wrote, or its avatar file")
    add_head(parser)


def add_head(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--head",
        type=Path,
        metavar="PATH",
        help="FLAME-format head model, file or folder (default: head_model/ in the subject, then $AVATAR_HEAD)",
    )


def add_background(parser: argparse.ArgumentParser, help: str) -> None:
    parser.add_argument("--background", metavar="COLOUR|IMAGE|transparent", help=help)


def add_device(parser: argparse.ArgumentParser, default: str = "auto") -> None:
    parser.add_argument(
        "--device",
        metavar="auto|cpu|cuda[:N]",
        help=f"what computes; auto takes a GPU that passes its test (default: {default})",
    )
