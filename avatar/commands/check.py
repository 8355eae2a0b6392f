"""avatar check: what a tracked folder holds, and whether it can be trained on."""

from __future__ import annotations

import json
import sys
from argparse import Namespace
from dataclasses import replace

from tqdm import tqdm

from avatar.commands.outputs import check_folder_output, check_outputs
from avatar.config import load_config
from avatar.errors import UserError, check_installed
from avatar.head.assets import load_head_assets
from avatar.pipeline.open_inputs import source_options
from avatar.train.cost_estimate import measure_cost
from avatar.train.frame_order import within_epochs
from data_prep.check.folder import Check, as_text, check_tracked_folder
from data_prep.check.frame import first_training_frame
from data_prep.prepare.open_subject import find_head


def run_check(arguments: Namespace) -> int:
    """Exit status 0: fine, 1: warnings, 2: errors."""
    if arguments.out is not None:
        check_folder_output(arguments.out)
        check_outputs([arguments.out], [arguments.folder, arguments.head, arguments.tracking])
        check_installed("the page of --out", "plots", "matplotlib")
    outcome = check_tracked_folder(
        arguments.folder,
        lambda: load_head_assets(find_head(arguments.folder, arguments.head)),
        progress=lambda items, total, title, unit="": tqdm(
            items, total=total, desc=title, leave=False, disable=total == 0
        ),
        **source_options(arguments, arguments.tracking),
    )
    print(json.dumps(outcome.to_dict(), indent=1, allow_nan=False) if arguments.json else as_text(outcome))
    if arguments.out is not None:
        from data_prep.check.page import write_page

        page = write_page(outcome, training_facts(outcome), arguments.out)
        print(f"Page   {page}", file=sys.stderr if arguments.json else sys.stdout)
    return outcome.status


def training_facts(outcome: Check) -> dict[str, str] | None:
    """What training will take, where the folder can be trained on."""
    if outcome.clip is None or outcome.clip.head is None or outcome.coverage is None:
        return None
    frame, identity = first_training_frame(outcome.clip, outcome.coverage)
    try:
        frames, config = len(outcome.coverage.images), load_config()
        config = replace(config, trainer=within_epochs(config.trainer, len(outcome.coverage.split.train)))
        return measure_cost(frame, outcome.clip.head.assets, identity, frames, config).facts()
    except UserError as error:  # frames that are too small
        return {"training": f"not possible: {error}"}
