"""avatar send: a drive file sent to a viewer's stream."""

from __future__ import annotations

from argparse import Namespace

from avatar.commands.view import checked_token
from avatar.head.assets import load_head_assets
from avatar.motion.drive_file import read_drive
from avatar.pipeline import OK
from avatar.view.sender import send


def run_send(arguments: Namespace) -> int:
    drive = read_drive(arguments.drive, load_head_assets(arguments.head), width=512)
    count = send(drive, "127.0.0.1", arguments.port, token=checked_token(arguments.token))
    print(f"{count} frames of {arguments.drive} sent to port {arguments.port}")
    return OK
