"""Which file of a folder is the head model: as people unpack their downloads."""

from __future__ import annotations

import zipfile
from pathlib import Path

from avatar.errors import UserError
from avatar.files.read import is_there

NAMED = ("generic_model.pkl", "generic_model.npz")  # FLAME's own name for the model of no gender
MODEL_SUFFIXES = (".npz", ".pkl")
ARCHIVES = (".zip", ".7z", ".rar", ".tar", ".gz", ".tgz", ".xz")
_OTHERS = ("mask", "embedding", "texture")  # in names of files that lie beside models
_DEPTH = 2  # folders down that are looked into


def find_model_file(path: Path) -> Path:
    """The model file itself, or the one file of a folder that is a head model; archives have folders in folders.

    Raises UserError where there is none, where several could be it, and for an archive.
    """
    if not is_there(path):
        raise UserError(
            f"the head model {path} does not exist; give --head the model file or its folder "
            "(FLAME 2023 Open can be had from https://flame.is.tue.mpg.de)"
        )
    if not path.is_dir():
        if path.is_file() and (
            path.suffix.lower() in ARCHIVES or (path.suffix.lower() != ".npz" and zipfile.is_zipfile(path))
        ):
            raise UserError(f"{path} is an archive; unpack it, and give --head the folder")
        if path.suffix.lower() not in MODEL_SUFFIXES:
            raise UserError(f"the head model {path} is neither .pkl nor .npz; give --head the model file or its folder")
        return path  # its reader refuses what is no regular file
    for depth in range(_DEPTH + 1):
        found = candidates(path, depth)
        named = [file for file in found if file.name in NAMED]
        if len({file.parent for file in named}) == 1:
            return min(named, key=lambda file: NAMED.index(file.name))
        if len(found) == 1:
            return found[0]
        if found:
            names = ", ".join(file.relative_to(path).as_posix() for file in found)
            raise UserError(
                f"the folder {path} holds several files that could be the head model ({names}); give --head one of them"
            )
    archives = sorted(file.name for file in path.iterdir() if file.suffix.lower() in ARCHIVES)
    if archives:
        raise UserError(f"the folder {path} holds no head model, only the archive {archives[0]}; unpack it there")
    raise UserError(f"the folder {path} holds no head model (generic_model.pkl, or another .pkl or .npz)")


def candidates(folder: Path, depth: int = 0) -> list[Path]:
    """The files in the folder, or so many folders down, that could be a head model."""
    found = (file for file in folder.glob(f"{'*/' * depth}*") if file.suffix.lower() in MODEL_SUFFIXES)
    return sorted(
        file
        for file in found
        if not file.is_dir()
        and not file.name.startswith(".")
        and not any(word in file.name.lower() for word in _OTHERS)
    )


def notes_on_choice(path: Path, chosen: Path) -> list[str]:
    """What a person should know of the choice of `find_model_file`."""
    if chosen == path:
        return []
    notes = [] if chosen.parent == path else [f"the head model is {chosen}"]
    others = [file.name for file in candidates(chosen.parent) if file != chosen]
    if others:
        notes.append(
            f"{chosen.parent} holds several head models, {chosen.name} and {', '.join(others)}: {chosen.name} is used "
            "(--head names another)"
        )
    return notes
