"""What can be typed after `avatar`: commands and their options."""

from __future__ import annotations

import argparse
from pathlib import Path

from avatar.bench import PARTS
from avatar.commands.groups import GROUPS, list_commands
from avatar.commands.options import (
    add_avatar,
    add_background,
    add_device,
    add_folder,
    add_head,
    add_reading,
    add_run,
    add_source,
    add_tracking,
)
from avatar.commands.page_options import add_create, add_export, add_view
from avatar.config import Config, declared_keys, flatten
from avatar.config_values import shown
from avatar.version import __version__


def list_keys() -> str:
    """A line for each configuration key: what it does and its default."""
    defaults = flatten(Config().to_dict())
    return "\n".join(
        f"  {key}: {meaning} (default: {shown(defaults[key])})" for key, meaning in declared_keys().items()
    )


def build_parser() -> tuple[argparse.ArgumentParser, dict[str, argparse.ArgumentParser]]:
    """The parser, and those of its commands."""
    parser = argparse.ArgumentParser(
        prog="avatar",
        usage="avatar [-h] [--version] COMMAND ...",
        description="Animatable 3D Gaussian head avatars from a video of one person, on a CPU or a GPU.",
        epilog=list_commands(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"avatar {__version__}")
    # The epilog lists them in groups.
    commands = parser.add_subparsers(dest="command", required=True, help=argparse.SUPPRESS, prog="avatar")

    add_create(commands.add_parser("create"))

    record = commands.add_parser("record")
    record.add_argument("out", type=Path, metavar="OUT.mp4", help="the video to write")
    record.add_argument("--webcam", default="0", metavar="N|VIDEO", help="a camera's number (default: 0), or a video")

    track = commands.add_parser("track")
    track.add_argument(
        "videos",
        type=Path,
        nargs="+",
        metavar="VIDEO",
        help="a video, a folder of numbered PNG or JPEG pictures, or sequences of several calibrated cameras",
    )
    add_head(track)
    track.add_argument("--out", type=Path, required=True, metavar="SUBJECT", help="the tracked folder to write")
    lens = track.add_mutually_exclusive_group()
    lens.add_argument("--focal", type=float, metavar="PX", help="focal length in pixels of the turned video, if known")
    lens.add_argument(
        "--fov", type=float, metavar="DEG", help="field of view across the turned video's width, if known"
    )
    track.add_argument(
        "--rotate",
        type=int,
        choices=(0, 90, 180, 270),
        help="degrees clockwise by which the pictures and mattes are turned before all else (default: as the face lies)",
    )
    track.add_argument(
        "--crop",
        default="auto",
        metavar="auto|none|X,Y,W,H",
        help="what is kept of the turned picture (default: the head)",
    )
    track.add_argument(
        "--size",
        type=int,
        metavar="S",
        help="longer side of the frames in pixels (default: 512; of several cameras 802)",
    )
    track.add_argument("--start", type=float, metavar="S", help="seconds, of the part of the video that is used")
    track.add_argument("--end", type=float, metavar="S", help="seconds")
    track.add_argument(
        "--matte", type=Path, metavar="DIR", help="your own mattes: a folder or a video of all pictures, as filmed"
    )

    train = commands.add_parser("train")
    train.add_argument(
        "words", nargs="*", metavar="SUBJECT | VIDEO", help="what avatar track wrote; with --resume the RUN"
    )
    add_head(train)
    add_reading(train)
    add_tracking(train)
    add_folder(train)
    train.add_argument("--out", type=Path, metavar="RUN", help="where the run goes (default: runs/NAME)")
    train.add_argument("--size", type=int, help="width of the training images in pixels (default: the video's)")
    train.add_argument("--iterations", type=int, help="optimizer steps (default: the recipe's)")
    train.add_argument("--seed", type=int, help="seed of initial weights and frame order (default: 0)")
    train.add_argument("--resume", action="store_true", help="go on with RUN from its newest checkpoint")
    train.add_argument("--view", action="store_true", help="show it in a browser from the first checkpoint on")
    train.add_argument("--dry-run", action="store_true", help="say what it would take, and train nothing")
    train.add_argument("--print-config", action="store_true", help="print the configuration as key=value, and no more")
    train.add_argument(
        "--refine", type=int, metavar="N", help="first improve the tracking N times through a shorter training's avatar"
    )
    train.add_argument(
        "--minutes",
        type=float,
        metavar="M",
        help="with --refine: about what all of it may take, tracking included, by fewer steps",
    )
    add_device(train, "the configuration's, auto")
    train.formatter_class = argparse.RawDescriptionHelpFormatter  # for the lines of the keys
    train.add_argument_group(
        "configuration", f"model=NAME, experiment=NAME, or KEY=VALUE of these keys:\n{list_keys()}"
    )

    evaluate = commands.add_parser("eval")
    add_run(evaluate)
    add_folder(evaluate)
    evaluate.add_argument(
        "--protocol",
        action="append",
        metavar="NAME",
        help="only this protocol, by name or as FILE.yaml; may be repeated",
    )
    evaluate.add_argument("--frames", action="store_true", help="write every render, truth and mask as PNG too")
    evaluate.add_argument(
        "--verify",
        action="store_true",
        help="write them, and compute all but LPIPS again from the files, with scikit-image",
    )
    add_device(evaluate)

    refine = commands.add_parser("refine")
    add_run(refine)
    add_folder(refine)
    refine.add_argument("--out", type=Path, metavar="SUBJECT", help="a new tracked folder (default: RUN/refined/NAME)")
    add_device(refine)

    report = commands.add_parser("report")
    add_run(report)
    add_folder(report)

    compare = commands.add_parser("compare")
    compare.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="runs that avatar eval has measured")
    compare.add_argument(
        "--protocol",
        action="append",
        metavar="NAME",
        help="only this protocol, by name or as FILE.yaml; may be repeated",
    )
    compare.add_argument(
        "--format", choices=("text", "markdown", "latex", "csv"), default="text", help="what is printed"
    )
    compare.add_argument("--out", type=Path, metavar="DIR", help="write compare.txt, .md, .tex and .csv there too")

    reenact = commands.add_parser("reenact")
    add_avatar(reenact)
    reenact.add_argument(
        "words", nargs="*", metavar="DRIVER", help="tracked folder, video, or a drive file (.npz, .csv, .json)"
    )
    reenact.add_argument("--driver", type=Path, metavar="DRIVER", help="the same")
    add_reading(reenact)
    reenact.add_argument("--driver-tracking", type=Path, metavar="DIR", help="its checkpoint/ folder, if elsewhere")
    reenact.add_argument("--frame-offset", type=int, metavar="N", help="the driver's image number minus .frame number")
    reenact.add_argument("--transfer", choices=("raw", "relative", "mean", "pca"), default="relative")
    reenact.add_argument(
        "--neutral",
        metavar="N",
        help="training frame with the avatar's neutral face, by its name or number (12 is 00012; default: found)",
    )
    reenact.add_argument(
        "--driver-neutral", metavar="N", help="frame of DRIVER with the driver's neutral face, likewise"
    )
    reenact.add_argument("--strength", type=float, default=1.0, metavar="S", help="scales the departure from neutral")
    reenact.add_argument(
        "--smoothing", type=float, default=0.0, metavar="FRAMES", help="Gaussian over time (default: off)"
    )
    reenact.add_argument("--camera", choices=("driver", "target"), default="driver", help="whose head pose is shown")
    reenact.add_argument("--intrinsics", choices=("driver", "target"), default="driver", help="through whose lens")
    add_background(reenact, "the avatar alone over it; transparent: .webm, .mov or .png (default: beside the driver)")
    reenact.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="video, or .png for pictures (default: RUN/reenact/DRIVER-TRANSFER.mp4)",
    )
    add_device(reenact)

    add_export(commands.add_parser("export"))

    add_view(commands.add_parser("view"))

    drive_file = commands.add_parser("drive-file")
    add_source(drive_file)
    drive_file.add_argument("--out", type=Path, required=True, metavar="FILE.npz")

    prepare = commands.add_parser("prepare")
    add_source(prepare)
    prepare.add_argument("--out", type=Path, metavar="DIR", help="where the prepared subject goes (default: the cache)")

    check = commands.add_parser("check")
    add_source(check)
    check.add_argument(
        "--out", type=Path, metavar="DIR", help="write a page with pictures and plots, and a table of frames"
    )
    check.add_argument("--json", action="store_true", help="print the findings as JSON, and nothing else, to stdout")

    demo_data = commands.add_parser("demo-data")
    demo_data.add_argument("out", type=Path, metavar="OUT")
    demo_data.add_argument("--frames", type=int, help="default: 600; with --cameras 100 in a sequence")
    demo_data.add_argument("--cameras", type=int, metavar="N", help="2 to 64: three sequences in VHAP's layout")
    demo_data.add_argument("--video", action="store_true", help="film it: OUT is an .mp4, head_model/ beside it")
    demo_data.add_argument("--outdoors", action="store_true", help="of a video: loose hair, a background that moves")
    demo_data.add_argument("--size", type=int, help="width and height in pixels (default: 256, of a video 512)")
    demo_data.add_argument("--seed", type=int, default=0, help="another seed is another person")
    demo_data.add_argument("--motion", choices=("speech", "turn", "gaze"), help="default: speech")

    demo = commands.add_parser("demo")
    demo.add_argument("out", type=Path, metavar="OUT")

    bench = commands.add_parser("bench")
    bench.add_argument("part", choices=tuple(PARTS))
    wanted = "; ".join(f"{name}: {part.inputs}" for name, part in PARTS.items() if part.inputs)
    bench.add_argument("words", nargs="*", metavar="SUBJECT | RUN", help=f"what is measured ({wanted}) and key=value")
    add_tracking(bench)
    add_head(bench)
    bench.add_argument("--out", type=Path, metavar="DIR", default=Path("runs/bench"), help="default: runs/bench")
    add_device(bench)
    extent = bench.add_mutually_exclusive_group()
    extent.add_argument("--quick", action="store_true", help="tiny inputs, to see that the measurement works")
    extent.add_argument("--full", action="store_true", help="the long sweep over sizes, counts and threads")

    models = commands.add_parser("models")
    models.add_argument("--download", action="store_true", help="get what is missing from its publishers")

    sweep = commands.add_parser("sweep")
    sweep.add_argument(
        "spec", type=Path, nargs="?", metavar="SPEC.yaml", help="what to train; without it, go on with --out"
    )
    sweep.add_argument("--out", type=Path, metavar="DIR", help="where jobs and tables go (default: runs/NAME-OF-SPEC)")
    sweep.add_argument("--engine", choices=("local", "ray", "slurm"), default="local", help="where the jobs run")
    sweep.add_argument("--workers", type=int, metavar="N", help="jobs at a time (default: as many as fit)")
    sweep.add_argument("--address", metavar="ADDRESS", help="of the Ray cluster, or submitit's kind of cluster")
    sweep.add_argument("--partition", metavar="NAME", help="of the SLURM cluster")
    sweep.add_argument("--status", action="store_true", help="say what has become of each job, and start nothing")
    sweep.add_argument("--retry-failed", action="store_true", help="try jobs again that have failed with a sentence")

    completion = commands.add_parser("completion")
    completion.add_argument("shell", choices=("bash", "zsh", "fish"))

    # Not in a group, so that no list names it: the engines call it.
    commands.add_parser("sweep-job").add_argument("folder", type=Path)

    commands.add_parser("doctor")
    for group in GROUPS.values():
        for name, (meaning, example) in group.items():
            commands.choices[name].description = f"{meaning[0].upper()}{meaning[1:]}."
            commands.choices[name].epilog = f"example: avatar {name} {example}".rstrip()
    return parser, commands.choices
