"""avatar export: an avatar to take away."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from avatar.commands import OK
from avatar.commands.opening import open_trained
from avatar.commands.outputs import check_outputs
from avatar.errors import UserError
from avatar.export.licence import SKINNING, WHOLE, licence_of
from avatar.export.web_page import write_page, write_web_avatar
from avatar.runs.avatar_file import read_portrait, write_portrait
from avatar.runs.trained import TrainedAvatar

MIB = 2**20


def run_export(arguments: Namespace) -> int:
    format = chosen_format(arguments.format, arguments.out)
    check_options(arguments, format)
    trained = open_trained(arguments.run, arguments.head)
    out: Path = arguments.out or Path(f"{trained.name}{SUFFIXES[format]}")
    if out.suffix.lower() != SUFFIXES[format]:
        raise UserError(f"--format {format} writes {SUFFIXES[format]} files, not {out.name}")
    check_outputs([out], [arguments.run, trained.source, arguments.head])
    WRITERS[format](trained, out, arguments)
    return OK


def chosen_format(format: str | None, out: Path | None) -> str:
    """What --format says, else what the suffix of --out does, else the page that any browser opens."""
    if format is not None:
        return format
    if out is None:
        return "web"
    found = next((name for name, suffix in SUFFIXES.items() if out.suffix.lower() == suffix), None)
    if found is None:
        raise UserError(
            f"{out.name} does not say what to write: end it in {', '.join(SUFFIXES.values())}, or give --format"
        )
    return found


def check_options(arguments: Namespace, format: str) -> None:
    """Raise UserError for an option that another format has."""
    for option, formats in OPTIONS.items():
        value = getattr(arguments, option)
        if value not in (None, False) and format not in formats:
            name = option.replace("_", "-")
            raise UserError(f"--{name} belongs to --format {' and '.join(formats)}; this writes {format}")


def write_web(trained: TrainedAvatar, out: Path, arguments: Namespace) -> None:
    page = write_page(trained, out, arguments.precision or "small")
    print(f"Page     {out} ({page.bytes / MIB:.1f} MiB): opens in any browser, without a network")
    if page.note:
        print(f"Note     {page.note}")
    print(f"Licence  {licence_of(SKINNING)}")


def write_web_file(trained: TrainedAvatar, out: Path, arguments: Namespace) -> None:
    size = write_web_avatar(trained, out, arguments.precision or "small")
    print(f'Avatar   {out} ({size / MIB:.1f} MiB), for <avatar-view src="{out.name}">')
    print(f"Licence  {licence_of(SKINNING)}")


def write_avatar_file(trained: TrainedAvatar, out: Path, arguments: Namespace) -> None:
    portrait = read_portrait(trained.source)
    head = trained.assets if arguments.with_head else None
    licence = licence_of(WHOLE) if arguments.with_head else None
    write_portrait(out, replace(portrait, head=head), licence)
    print(f"Avatar   {out} ({out.stat().st_size / MIB:.1f} MiB)")
    if licence:
        print(f"Licence  {licence}")
    else:
        print(f"Next     avatar reenact {out} --head HEAD --driver DRIVER; it needs the head model it was trained with")


SUFFIXES = {"web": ".html", "web-avatar": ".avatar", "avatar": ".safetensors"}
WRITERS: dict[str, Callable[[TrainedAvatar, Path, Namespace], None]] = {
    "web": write_web,
    "web-avatar": write_web_file,
    "avatar": write_avatar_file,
}
OPTIONS = {"precision": ("web", "web-avatar"), "with_head": ("avatar",)}
