"""Where commands may write: never over what they read, nor over the files of a run."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from avatar.errors import UserError
from avatar.files.lock import LOCK_FILE
from avatar.files.names import ROUNDS_FOLDER
from avatar.runs.avatar_file import AVATAR_FILE
from avatar.runs.run import RUN_FILE
from avatar.runs.training_curves import CURVES_FILE

RUN_FILES = (RUN_FILE, AVATAR_FILE, CURVES_FILE, LOCK_FILE)
RUN_FOLDERS = ("checkpoints", "previews", "eval", ROUNDS_FOLDER)


def check_file(output: Path, suffixes: Sequence[str], what: str) -> None:
    """Raise UserError where a file of this kind cannot be called so, or is a folder."""
    if output.suffix.lower() not in suffixes:
        raise UserError(f"{what} is written as {' or '.join(suffixes)}, not as {output}")
    if output.is_dir():
        raise UserError(f"{output} is a folder; name a file with --out")


def check_folder_output(output: Path, inputs: Iterable[Path | None]) -> None:
    """Raise UserError where a folder is to be written and a file has its name, and as `check_outputs`."""
    if output.exists() and not output.is_dir():
        raise UserError(f"{output} is a file; name a folder with --out")
    check_outputs([output], inputs)


def check_run_folder(run: Path, inputs: Iterable[Path | None]) -> None:
    """Raise UserError when a new run would be, or would write over, what it is trained on."""
    read = [path for path in inputs if path is not None]
    check_folder_output(run, read)
    for path in read:
        inside = path.resolve().relative_to(run.resolve()).parts if _lies_in(path, run) else ("",)
        if inside[0] in (*RUN_FOLDERS, *RUN_FILES):
            raise UserError(f"{path}, which is an input, lies where the run {run} would write; choose another --out")


def check_outputs(outputs: Iterable[Path], inputs: Iterable[Path | None]) -> None:
    """Raise UserError when an output is an input, lies in a folder that is one, or is a file of a run."""
    read = [path for path in inputs if path is not None]
    for output in outputs:
        for path in read:
            if _is_same(output, path):
                raise UserError(f"{output} is an input of this command and would be overwritten; choose another --out")
            if path.is_dir() and not _is_run(path) and _lies_in(output, path):
                raise UserError(f"{output} lies in the folder {path}, which is an input; choose another --out")
        run = next((folder for folder in output.resolve().parents if _is_run(folder)), None)
        if run is not None:
            inside = output.resolve().relative_to(run).parts
            if inside[0] in RUN_FOLDERS or inside in [(name,) for name in RUN_FILES]:
                raise UserError(f"{output} belongs to the run {run}; choose another --out")


def _is_run(folder: Path) -> bool:
    return (folder / RUN_FILE).is_file()


def _is_same(a: Path, b: Path) -> bool:
    return a.resolve() == b.resolve() or (a.exists() and b.exists() and a.samefile(b))


def _lies_in(path: Path, folder: Path) -> bool:
    return folder.resolve() in path.resolve().parents
