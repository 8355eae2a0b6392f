"""avatar check: what a tracked folder holds, and whether it can be trained on."""

from __future__ import annotations

import json
import sys
from argparse import Namespace

from tqdm import tqdm

from avatar.commands.main import failed
from avatar.commands.outputs import check_folder_output
from avatar.errors import UserError, check_installed
from avatar.head.assets import load_head_assets
from avatar.pipeline.open_inputs import source_options
from data_prep.check.folder import as_text, check_tracked_folder
from data_prep.prepare.open_subject import find_head


def run_check(arguments: Namespace) -> int:
    """Exit status 0: fine, 1: warnings, 2: errors, or the folder could not be checked."""
    try:
        return check(arguments)
    except UserError as error:
        failed(str(error))
        return 2


def check(arguments: Namespace) -> int:
    if arguments.out is not None:
        check_folder_output(arguments.out, [arguments.folder, arguments.head, arguments.tracking])
        check_installed("the page of --out", "plots", "matplotlib")
        from data_prep.check.page import check_page_output, write_page

        check_page_output(arguments.out)
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
        page = write_page(outcome, arguments.out)
        print(f"Page   {page}", file=sys.stderr if arguments.json else sys.stdout)
    return outcome.status
