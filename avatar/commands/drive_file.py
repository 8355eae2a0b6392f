"""avatar drive-file: a tracked folder's motion as a file."""

from __future__ import annotations

from argparse import Namespace

from avatar.commands.outputs import check_file, check_outputs
from avatar.motion.drive import subject_drive
from avatar.motion.drive_file import write_drive
from avatar.pipeline import OK
from avatar.pipeline.open_inputs import source_of
from data_prep.prepare.open_subject import open_subject


def run_drive_file(arguments: Namespace) -> int:
    check_file(arguments.out, [".npz"], "a drive file")
    source = source_of(arguments)
    check_outputs([arguments.out], [source.folder, source.head, source.tracking])
    subject, assets = open_subject(source)
    drive = subject_drive(subject, None)
    write_drive(arguments.out, drive, assets.fingerprint)
    print(f"{len(drive)} frames written to {arguments.out}")
    return OK
