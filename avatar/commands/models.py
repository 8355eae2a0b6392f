"""avatar models: the files of others that the program can use, where they are, and getting them."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable

from avatar.errors import UserError
from avatar.files.third_party import (
    FETCHED_LPIPS,
    LPIPS_FILES,
    MATTING_FILES,
    PAGE_FILES,
    TRACKING_FILES,
    ThirdPartyFile,
    download,
    find,
    lpips_folder,
    models_folder,
    require,
    search_folders,
)
from avatar.losses.lpips import MissingWeights, download_lpips, load_lpips
from avatar.losses.lpips_network import NETS, Net
from avatar.pipeline import OK

MISSING = 1


def run_models(arguments: Namespace, say: Callable[[str], object] = print) -> int:
    """Exit status 0 where everything that the program uses by default is there and whole."""
    if arguments.download:
        fetch_missing(say)
    folders = ", ".join(map(str, search_folders()))
    say(f"Looked for in {folders}; LPIPS also in {lpips_folder()}")
    states = [describe(file, say) for file in (*TRACKING_FILES, *MATTING_FILES, *PAGE_FILES)] + [
        describe_lpips(net, say) for net in NETS
    ]
    return OK if all(states) else MISSING


def describe(file: ThirdPartyFile, say: Callable[[str], object]) -> bool:
    """Say where a file is, or which one to put where; False where it is needed and missing, or damaged."""
    path = find(file)
    say(
        f"\n{file.name}: {file.purpose}; {file.megabytes:g} MB, {file.licence}"
        + ("; optional" if file.is_optional else "")
    )
    if path is None:
        say(f"  missing: put {file.url} into {models_folder()}")
        say(f"  SHA-256 {file.sha256}")
        return file.is_optional
    try:
        require(file)
    except UserError as error:
        say(f"  {error}")
        return False
    say(f"  {path}, SHA-256 as published")
    return True


def describe_lpips(net: Net, say: Callable[[str], object]) -> bool:
    backbone, heads = LPIPS_FILES[net]
    licences = f"{backbone.licence}; {heads.licence}"
    say(f"\nLPIPS {net}: {backbone.name} and {heads.name}; {backbone.megabytes:g} MB, {licences}")
    try:
        say(f"  weights found, fingerprint {load_lpips(net).fingerprint()[:12]}")
        return True
    except MissingWeights:
        for file in (backbone, heads):
            say(f"  missing: put {file.url} as {lpips_folder() / file.name}")
        return net not in FETCHED_LPIPS
    except UserError as error:
        say(f"  {error}")
        return False


def fetch_missing(say: Callable[[str], object]) -> None:
    """Download what is not there or is damaged. Raises UserError, with where to put the file by other means, when that
    fails.
    """
    for file in (*TRACKING_FILES, *PAGE_FILES):
        try:
            require(file)
        except UserError as error:
            if find(file) is not None:
                say(str(error))
            say(f"fetching {file.name} ({file.megabytes:g} MB, {file.licence}) from {file.url}")
            download(file)
    for net in FETCHED_LPIPS:
        try:
            load_lpips(net)
        except UserError as error:
            if not isinstance(error, MissingWeights):
                say(str(error))
            for file in LPIPS_FILES[net]:
                say(f"fetching {file.name} ({file.megabytes:g} MB, {file.licence}) from {file.url}")
            download_lpips(net, lpips_folder())
