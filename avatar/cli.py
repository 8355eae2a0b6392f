"""The command line: `avatar COMMAND ...`, one subcommand for each thing that the program does."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import avatar
from avatar.bench import PARTS
from avatar.errors import UserError

EXIT_ERROR = 1
EXIT_INTERRUPTED = 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status. A UserError is printed as its sentence, without a stack trace."""
    arguments = parse(argv)
    try:
        # The commands import torch and the compiled core; --help must answer without them.
        from avatar import commands

        return getattr(commands, arguments.command.replace("-", "_"))(arguments)
    except UserError as error:
        print(f"avatar: {error}", file=sys.stderr)
        return EXIT_ERROR
    except KeyboardInterrupt:
        print("avatar: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """The arguments of one command. `key=value` overrides may stand anywhere among train's options.

    Exits with status 2 and the usage, as argparse does, on anything that it does not know.
    """
    parser = build_parser()
    arguments, rest = parser.parse_known_args(argv)
    unknown = [word for word in rest if word.startswith("-") or "=" not in word]
    if arguments.command not in ("train", "bench"):
        unknown = rest
    if unknown:
        parser.error(f"unrecognized arguments: {' '.join(unknown)}")
    if arguments.command == "train":
        arguments.overrides += rest
    if arguments.command == "bench":
        words = [*arguments.inputs, *rest]
        arguments.overrides = [word for word in words if "=" in word]
        arguments.inputs = [Path(word) for word in words if "=" not in word]
        check_bench(parser, arguments.part, len(arguments.inputs))
    return arguments


def check_bench(parser: argparse.ArgumentParser, part: str, given: int) -> None:
    """Each part of the benchmark takes a number of folders of its own."""
    inputs = PARTS[part].inputs
    fits = given >= 1 if inputs.endswith("...") else given == len(inputs.split())
    if not fits:
        parser.error(f"bench {part} takes {inputs or 'no folder'}, {given} given")


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="avatar", description="Animatable 3D Gaussian head avatars from one tracked video, on a CPU."
    )
    parser.add_argument("--version", action="version", version=f"avatar {avatar.__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)

    train = commands.add_parser("train", help="train an avatar on a tracked video folder")
    add_source(train)
    train.add_argument("--out", type=Path, metavar="RUN", help="where the run goes (default: runs/NAME)")
    train.add_argument("--size", type=int, help="width of the training images in pixels (default: the video's)")
    train.add_argument("--iterations", type=int, help="optimizer steps (default: the preset's)")
    train.add_argument("--seed", type=int, help="seed of initial weights and frame order (default: 0)")
    train.add_argument("--resume", action="store_true", help="go on from RUN's newest checkpoint")
    train.add_argument("overrides", nargs="*", metavar="key=value", help="configuration, such as model=flashavatar")

    evaluate = commands.add_parser("eval", help="measure a trained avatar on the held-out frames")
    add_run(evaluate)
    evaluate.add_argument(
        "--protocol",
        action="append",
        metavar="NAME",
        help="only this protocol, by name or as FILE.yaml; may be repeated",
    )
    evaluate.add_argument("--frames", action="store_true", help="write every render, truth and mask as PNG too")

    report = commands.add_parser("report", help="write a run as one HTML page: figures, frames, curves, configuration")
    add_run(report)

    compare = commands.add_parser("compare", help="set evaluated runs side by side, with differences to the first")
    compare.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="runs that avatar eval has measured")
    compare.add_argument("--protocol", action="append", metavar="NAME", help="only this protocol; may be repeated")
    compare.add_argument(
        "--format", choices=("text", "markdown", "latex", "csv"), default="text", help="what is printed"
    )
    compare.add_argument("--out", type=Path, metavar="DIR", help="write compare.txt, .md, .tex and .csv there too")

    reenact = commands.add_parser("reenact", help="drive an avatar with another person's motion")
    add_run(reenact)
    reenact.add_argument(
        "--driver", type=Path, required=True, metavar="DRIVER", help="tracked folder, or a drive file (.npz, .csv)"
    )
    add_format(reenact)
    reenact.add_argument("--driver-tracking", type=Path, metavar="DIR", help="its checkpoint/ folder, if elsewhere")
    reenact.add_argument("--frame-offset", type=int, metavar="N", help="the driver's image number minus .frame number")
    reenact.add_argument("--transfer", choices=("raw", "relative", "mean", "pca"), default="relative")
    reenact.add_argument("--strength", type=float, default=1.0, metavar="S", help="scales the departure from neutral")
    reenact.add_argument(
        "--smoothing", type=float, default=0.0, metavar="FRAMES", help="Gaussian over time (default: off)"
    )
    reenact.add_argument("--camera", choices=("driver", "target"), default="driver", help="whose head pose is shown")
    reenact.add_argument("--intrinsics", choices=("driver", "target"), default="driver", help="through whose lens")
    reenact.add_argument(
        "--out", type=Path, metavar="FILE", help="video file (default: RUN/reenact/DRIVER-TRANSFER.mp4)"
    )

    drive_file = commands.add_parser("drive-file", help="write a tracked folder's motion as a drive file")
    add_source(drive_file)
    drive_file.add_argument("--out", type=Path, required=True, metavar="FILE.npz")

    prepare = commands.add_parser("prepare", help="check and import a tracked folder; train does it by itself")
    add_source(prepare)
    prepare.add_argument("--out", type=Path, metavar="DIR", help="where the prepared subject goes (default: the cache)")

    check = commands.add_parser("check", help="say everything that is wrong with a tracked folder, before training")
    add_source(check)
    check.add_argument(
        "--out", type=Path, metavar="DIR", help="write a page with pictures and plots, and a table of frames"
    )
    check.add_argument("--json", action="store_true", help="print the findings as JSON, and nothing else, to stdout")

    demo_data = commands.add_parser("demo-data", help="make a talking-head subject, tracking and head model included")
    demo_data.add_argument("out", type=Path, metavar="OUT")
    demo_data.add_argument("--frames", type=int, default=600)
    demo_data.add_argument("--size", type=int, default=256, help="width and height in pixels")
    demo_data.add_argument("--seed", type=int, default=0, help="another seed is another person")
    demo_data.add_argument("--motion", choices=("speech", "turn"), default="speech")

    demo = commands.add_parser("demo", help="make two subjects, train on one, evaluate, reenact with the other")
    demo.add_argument("out", type=Path, metavar="OUT")

    bench = commands.add_parser("bench", help="measure time and error of a part on this machine")
    bench.add_argument("part", choices=tuple(PARTS))
    wanted = "; ".join(f"{name}: {part.inputs}" for name, part in PARTS.items() if part.inputs)
    bench.add_argument("inputs", nargs="*", metavar="FOLDER | RUN", help=f"what is measured ({wanted}) and key=value")
    add_tracking(bench)
    add_head(bench)
    bench.add_argument("--out", type=Path, metavar="DIR", default=Path("runs/bench"), help="default: runs/bench")
    extent = bench.add_mutually_exclusive_group()
    extent.add_argument("--quick", action="store_true", help="tiny inputs, to see that the measurement works")
    extent.add_argument("--full", action="store_true", help="the long sweep over sizes, counts and threads")

    commands.add_parser("doctor", help="say what this installation can do and what is missing")
    return parser


def add_source(parser: argparse.ArgumentParser) -> None:
    """The options that name a tracked folder and what belongs to it."""
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="tracked video folder")
    add_head(parser)
    add_format(parser)
    add_tracking(parser)


def add_format(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--format", metavar="NAME", help="metrical-tracker, VHAP, INSTA or IMavatar (default: told from the files)"
    )


def add_tracking(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--tracking", type=Path, metavar="DIR", help="folder of the .frame files, if not in FOLDER")
    parser.add_argument("--frame-offset", type=int, metavar="N", help="image number minus .frame number, if known")


def add_run(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", type=Path, metavar="RUN", help="folder that avatar train wrote")
    add_head(parser)


def add_head(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--head",
        type=Path,
        metavar="PATH",
        help="FLAME-format head model, file or folder (default: head_model/ in the subject, then $AVATAR_HEAD)",
    )


if __name__ == "__main__":
    sys.exit(main())
