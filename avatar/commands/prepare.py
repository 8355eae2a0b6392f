"""avatar prepare: a tracked folder's contents, as training reads them."""

from __future__ import annotations

from argparse import Namespace

from avatar.commands.outputs import check_folder_output
from avatar.data.subject import Subject
from avatar.head.assets import load_head_assets
from avatar.pipeline import OK
from avatar.pipeline.open_inputs import source_of
from data_prep.prepare.prepare import prepare


def run_prepare(arguments: Namespace) -> int:
    source = source_of(arguments)
    if arguments.out is not None:
        check_folder_output(arguments.out, [source.folder, source.head, source.tracking])
    prepared = prepare(source, load_head_assets(source.head), out=arguments.out)
    subject = Subject.open(prepared)
    print(
        f"{subject.name}: {len(subject)} frames of {subject.recording.width}x{subject.recording.height}, "
        f"{len(subject.split.train)} to train, {len(subject.split.test)} to test"
    )
    print(f"Prepared in {prepared}")
    return OK
