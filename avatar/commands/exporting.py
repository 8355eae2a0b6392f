"""avatar export: an avatar to take away."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import replace
from pathlib import Path

from avatar.commands import OK
from avatar.commands.opening import open_trained
from avatar.commands.outputs import check_file, check_outputs
from avatar.runs.avatar_file import read_portrait, write_portrait

LICENCE = (
    "The head model in this file keeps its own licence: FLAME 2023 Open (CC-BY-4.0) may be passed on with attribution to "
    "the Max Planck Institute for Intelligent Systems; FLAME 2020 and 2023 may not be passed on; the demo's is free."
)


def run_export(arguments: Namespace) -> int:
    trained = open_trained(arguments.run, arguments.head)
    out: Path = arguments.out or Path(f"{trained.name}.safetensors")
    check_file(out, [".safetensors"], "an avatar file")
    check_outputs([out], [arguments.run, trained.source, arguments.head])
    portrait = read_portrait(trained.source)
    head = trained.assets if arguments.with_head else None
    write_portrait(out, replace(portrait, head=head), LICENCE if arguments.with_head else None)
    print(f"Avatar   {out} ({out.stat().st_size / 2**20:.1f} MiB)")
    if arguments.with_head:
        print(f"Licence  {LICENCE}")
    else:
        print(f"Next     avatar reenact {out} --head HEAD --driver DRIVER; it needs the head model it was trained with")
    return OK
