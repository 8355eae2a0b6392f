"""LPIPS with its weights: found in a folder, or fetched from where they are published, and never run.

Weights are looked for in a file or folder that the caller names, else in the folder AVATAR_LPIPS, else in the folder
`lpips` of the cache (AVATAR_CACHE, else ~/.cache/avatar). A folder holds either `lpips_NET.safetensors` (made by
`download_lpips` or scripts/lpips_from_onnx.py) or the two published files of `LPIPS_FILES[NET]`.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor

from avatar.data.tensor_file import read_tensors
from avatar.errors import UserError
from avatar.files.third_party import (
    LPIPS_FILES,
    ThirdPartyFile,
    check_sha256,
    converted_lpips,
    fetch,
    lpips_folder,
    lpips_place,
    sha256_of,
)
from avatar.losses.lpips_network import NETS, Lpips, Net

_MAX_BYTES = 2**30  # of a converted file; VGG16's has 59 MB


class MissingWeights(UserError):
    """No weights are where they are looked for, as opposed to weights that are there and wrong."""

    def __init__(self, net: Net, message: str) -> None:
        super().__init__(message)
        self.brief = f"no weights of {net} on this machine; avatar models says how to get them"


def load_lpips(net: Net, weights: Path | None = None, *, download: bool = False) -> Lpips:
    """LPIPS with the weights of `weights` (a .safetensors file or a folder), else of the folders named above.

    With `download`, weights that are in neither are fetched from their publishers. Raises MissingWeights, with what to
    do, when there are none, and UserError for a file that is damaged, of another network, or more than plain tensors.
    """
    if net not in NETS:
        raise UserError(f"LPIPS network must be one of {', '.join(NETS)}, not {net!r}")
    place = lpips_place(net) if weights is None else Path(weights)
    if place.is_file():
        return from_state(net, _read_safetensors(place), place)
    converted = place / converted_lpips(net)
    if converted.is_file():
        return from_state(net, _read_safetensors(converted), converted)
    backbone, heads = LPIPS_FILES[net]
    if all((place / file.name).is_file() for file in (backbone, heads)):
        return from_published(net, place)
    if download and weights is None:
        return download_lpips(net, lpips_folder())
    raise MissingWeights(
        net,
        f"no LPIPS weights for {net!r} in {place}: put {backbone.name} ({backbone.url}) and {heads.name} ({heads.url}) "
        f"there, or name their folder with AVATAR_LPIPS",
    )


def from_published(net: Net, folder: Path, files: tuple[ThirdPartyFile, ThirdPartyFile] | None = None) -> Lpips:
    """LPIPS from torchvision's file and the linear heads' file in `folder`, both checked by SHA-256."""
    backbone, heads = files or LPIPS_FILES[net]
    state: dict[str, Tensor] = {}
    for file in (backbone, heads):
        path = folder / file.name
        check_sha256(file, sha256_of(path, file.max_bytes), str(path))
        state |= _renamed(_read_torch(path))
    return from_state(net, state, folder / backbone.name)


def from_state(net: Net, state: dict[str, Tensor], source: Path) -> Lpips:
    """LPIPS with `state` as its weights; names and shapes must fit. `source` is for the messages."""
    lpips = Lpips(net)
    expected = lpips.state_dict()
    wrong = [name for name in expected if name not in state or state[name].shape != expected[name].shape]
    if wrong:
        name = wrong[0]
        given = list(state[name].shape) if name in state else "nothing"
        raise UserError(
            f"{source} does not hold LPIPS weights for {net!r}: {name} should have shape {list(expected[name].shape)}, "
            f"the file has {given} there"
        )
    for name in expected:
        if not state[name].isfinite().all():
            raise UserError(f"{source} holds non-finite values in {name}; fetch the file again")
    lpips.load_state_dict({name: state[name].float() for name in expected})
    return lpips


def download_lpips(net: Net, folder: Path, files: tuple[ThirdPartyFile, ThirdPartyFile] | None = None) -> Lpips:
    """Fetch, check and convert the published weights to `folder`/lpips_NET.safetensors; of VGG16's 528 MB 59 remain.

    Nothing is left in `folder` when a transfer or a check fails. Raises UserError.
    """
    files = files or LPIPS_FILES[net]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix="download-") as name:
            temporary = Path(name)
            for file in files:
                fetch(file, temporary / file.name, folder / file.name)
            lpips = from_published(net, temporary, files)
            converted = temporary / converted_lpips(net)
            save_lpips(lpips, converted)
            converted.replace(folder / converted.name)
    except OSError as error:
        raise UserError(f"cannot keep LPIPS weights in {folder}: {error}") from error
    return lpips


def save_lpips(lpips: Lpips, path: Path) -> None:
    """Write all weights as one safetensors file that `load_lpips` reads."""
    save_file({name: tensor.contiguous() for name, tensor in lpips.state_dict().items()}, path)


def _renamed(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Published names to ours: `features.*` stays, `lin3.model.1.weight` [1, C, 1, 1] is `heads.3` [C]."""
    renamed = {name: tensor for name, tensor in state.items() if name.startswith("features.")}
    for name, tensor in state.items():
        if name.startswith("lin"):
            renamed[f"heads.{name[3:].split('.')[0]}"] = tensor.flatten()
    return renamed


def _read_torch(path: Path) -> dict[str, Tensor]:
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many kinds for damaged and for hostile files
        raise UserError(f"{path} is damaged or holds more than plain tensors; nothing in it was run") from error
    if not isinstance(state, dict) or not all(isinstance(tensor, Tensor) for tensor in state.values()):
        raise UserError(f"{path} does not hold a dictionary of tensors")
    return state


def _read_safetensors(path: Path) -> dict[str, Tensor]:
    try:
        return read_tensors(path, _MAX_BYTES)
    except UserError as error:
        raise UserError(f"{error}; fetch or convert it again") from None
