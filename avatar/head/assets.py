"""FLAME-format head models on disk: the model file, its UV layout, eyelids and region masks.

A model file (`generic_model.pkl`, `flame2023.pkl`, ... or the same keys in an .npz) holds v_template (V, 3), f (F, 3),
shapedirs (V, 3, 300 identity + E expression), posedirs (V, 3, 36), J_regressor (5, V), weights (V, 5) and
kintree_table (2, 5). Beside it may lie an OBJ of the same topology with UVs (one is made else), `l_eyelid.npy` /
`r_eyelid.npy` (V, 3) and region masks (`FLAME_masks.pkl` or `masks.npz`). Nothing that these files hold can execute code.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from avatar.errors import UserError
from avatar.files.pickles import load_npy, load_npz, load_pickle
from avatar.files.read import is_there
from avatar.head.expression_names import ExpressionNames, load_expression_names
from avatar.head.find_head_model import find_model_file, notes_on_choice
from avatar.head.unwrap import LAYOUT_METHOD, NoLayout, unwrap
from avatar.head.uv_obj import read_uv_obj

IDENTITY_COEFFICIENTS = 300  # FLAME's shapedirs: 300 identity directions, then the expression directions
JOINT_NAMES = ("root", "neck", "jaw", "left eye", "right eye")
LAYOUT_TENSOR = "layout_method"
LAYOUT_IS_MADE = "no UV layout (head_template.obj) lies beside the head model: the program makes one"
EYES = ("left eye", "right eye")
REQUIRED_KEYS = ("v_template", "f", "shapedirs", "J_regressor", "weights", "kintree_table")


@dataclass(frozen=True, repr=False)
class HeadAssets:
    """Everything that a head model consists of, as float32 tensors in metres; V vertices, F faces, J joints."""

    template: Float[Tensor, "V 3"]
    faces: Int[Tensor, "F 3"]
    shape_dirs: Float[Tensor, "V 3 S"]
    expression_dirs: Float[Tensor, "V 3 E"]
    pose_dirs: Float[Tensor, "V 3 P"]
    joint_regressor: Float[Tensor, "J V"]
    weights: Float[Tensor, "V J"]
    parents: tuple[int, ...]  # -1 for the root; joints in the order of JOINT_NAMES
    eyelid_dirs: Float[Tensor, "2 V 3"]  # left, right; zeros where the model has none
    uvs: Float[Tensor, "T 2"]  # OBJ convention: origin at the lower left
    uv_faces: Int[Tensor, "F 3"]  # rows of `uvs` for the corners of `faces`
    regions: Mapping[str, Int[Tensor, " R"]]  # name -> vertex indices
    fingerprint: str  # SHA-256 over all of the above
    names: ExpressionNames = field(default_factory=ExpressionNames)  # of the expression coefficients
    layout_method: int = 0  # LAYOUT_METHOD of `uvs` that the program made because no OBJ lay beside the model file
    notes: tuple[str, ...] = ()  # what was chosen or made when it was read

    def __repr__(self) -> str:
        return (
            f"<head model: {self.num_vertices} vertices, {self.num_expressions} expressions, {self.fingerprint[:12]}>"
        )

    @property
    def layout_is_made(self) -> bool:
        return self.layout_method != 0

    @property
    def fixed_joints(self) -> tuple[str, ...]:
        """Those of jaw and eyes whose rotation moves no vertex; such head models open the mouth by expressions."""
        turns = self.pose_dirs.unflatten(2, (-1, 9)).abs().amax(dim=(0, 1, 3))  # of the joints without the root
        moves = (self.weights != 0).any(dim=0)[1:] | (turns > 0)
        return tuple(
            name for name, one in zip(JOINT_NAMES[1:], moves.tolist(), strict=True) if not one and name != "neck"
        )

    @property
    def num_vertices(self) -> int:
        return self.template.shape[0]

    @property
    def num_expressions(self) -> int:
        return self.expression_dirs.shape[2]


def load_head_assets(path: Path) -> HeadAssets:
    """Read a head model from its file, or from the folder that holds it.

    Raises UserError with the file and the reason when something is missing, unreadable or does not fit together.
    """
    path = Path(path)
    model_file = find_model_file(path)
    folder = model_file.parent
    raw = _read_arrays(model_file)
    missing = [key for key in REQUIRED_KEYS if key not in raw]
    if missing:
        raise UserError(
            f"{model_file} is not a FLAME-format head model: it lacks {', '.join(missing)} "
            f"(it holds {', '.join(sorted(raw)[:12]) or 'nothing'})"
        )

    template = _array(raw, "v_template", model_file, (None, 3))
    V = len(template)
    faces = _array(raw, "f", model_file, (None, 3), integer=True)
    if faces.size == 0 or faces.min() < 0 or faces.max() >= V:
        raise UserError(f"{model_file}: the faces f name vertices outside the {V} of v_template")
    directions = _array(raw, "shapedirs", model_file, (V, 3, None))
    if directions.shape[2] <= IDENTITY_COEFFICIENTS:
        raise UserError(
            f"{model_file}: shapedirs has {directions.shape[2]} directions; {IDENTITY_COEFFICIENTS} identity "
            "directions followed by expression directions are needed (FLAME has 300 + 100)"
        )
    J = len(JOINT_NAMES)
    kintree = _array(raw, "kintree_table", model_file, (2, J), integer=True)
    parents = tuple(int(p) if 0 <= p < J else -1 for p in kintree[0])
    if parents[0] != -1 or any(not 0 <= p < child for child, p in enumerate(parents[1:], start=1)):
        raise UserError(
            f"{model_file}: kintree_table must list every joint after its parent, root first; its parents are "
            f"{list(parents)}"
        )
    weights = _array(raw, "weights", model_file, (V, J))
    if np.abs(weights.sum(1) - 1).max() > 1e-3:
        row = int(np.abs(weights.sum(1) - 1).argmax())
        raise UserError(f"{model_file}: the skinning weights of vertex {row} sum to {weights[row].sum():.4f}, not 1")
    pose_dirs = (
        _array(raw, "posedirs", model_file, (V, 3, 9 * (J - 1)))
        if "posedirs" in raw
        else np.zeros((V, 3, 9 * (J - 1)), np.float32)
    )
    regressor = _array(raw, "J_regressor", model_file, (J, V))
    obj = find_uv_obj(folder)
    uvs, uv_faces = made_layout(folder, template, faces, regressor) if obj is None else read_uv_obj(obj, faces, V)
    tensors: dict[str, Tensor] = {
        "template": torch.from_numpy(template),
        "faces": torch.from_numpy(faces),
        "shape_dirs": torch.from_numpy(directions[:, :, :IDENTITY_COEFFICIENTS].copy()),
        "expression_dirs": torch.from_numpy(directions[:, :, IDENTITY_COEFFICIENTS:].copy()),
        "pose_dirs": torch.from_numpy(pose_dirs),
        "joint_regressor": torch.from_numpy(regressor),
        "weights": torch.from_numpy(weights),
        "eyelid_dirs": torch.from_numpy(_read_eyelids(folder, V)),
        "uvs": torch.from_numpy(uvs),
        "uv_faces": torch.from_numpy(uv_faces),
    }
    regions = _read_regions(folder, V)
    method = LAYOUT_METHOD if obj is None else 0
    return HeadAssets(
        **tensors,
        parents=parents,
        regions=regions,
        fingerprint=fingerprint_of(tensors, parents, regions, method),
        names=load_expression_names(folder, directions.shape[2] - IDENTITY_COEFFICIENTS),
        layout_method=method,
        notes=(
            *notes_on_choice(path, model_file),
            *([LAYOUT_IS_MADE] if obj is None else _faces_beside_map(uvs, uv_faces, obj)),
        ),
    )


def find_uv_obj(folder: Path) -> Path | None:
    """The OBJ with the UV layout that lies beside the model file, if there is one."""
    named = folder / "head_template.obj"
    if is_there(named):
        return named
    candidates = sorted(folder.glob("*.obj"))
    if len(candidates) == 1:
        return candidates[0]
    if not candidates:
        return None
    raise UserError(
        f"{folder} holds several OBJ files and none is called head_template.obj; rename the right one to it"
    )


def made_layout(
    folder: Path, template: np.ndarray, faces: np.ndarray, regressor: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A UV layout for a model without one. Raises UserError for a mesh that cannot be laid out."""
    eyes = (regressor.astype(np.float64) @ template)[[JOINT_NAMES.index(name) for name in EYES]]
    try:
        return unwrap(template, faces, eyes)
    except NoLayout as error:
        raise UserError(
            f"no OBJ with a UV layout lies in {folder}, and none can be made of this mesh ({error}): put head_template.obj "
            "(same topology as the model, with vt lines) beside the model file"
        ) from None


def _faces_beside_map(uvs: np.ndarray, uv_faces: np.ndarray, obj: Path) -> list[str]:
    """A sentence where faces lie beside the map, such as in another tile of it; their texture is not drawn."""
    corners = uvs[uv_faces]
    count = int(((corners.max(axis=1) <= 0) | (corners.min(axis=1) >= 1)).any(axis=1).sum())
    there = f"{count} of {len(uv_faces)} faces lie beside the UV map of {obj.name}, whose u and v go from 0 to 1"
    return [f"{there}: no Gaussian lies on them"] if count else []


def _read_arrays(file: Path) -> Mapping[str, object]:
    loaded = load_npz(file) if file.suffix.lower() == ".npz" else load_pickle(file)
    if not isinstance(loaded, dict):
        raise UserError(f"{file} holds a {type(loaded).__name__}, not a dictionary of arrays")
    return loaded


def _array(
    raw: Mapping[str, object], key: str, file: Path, shape: tuple[int | None, ...], *, integer: bool = False
) -> np.ndarray:
    try:
        array = np.asarray(raw[key])
        converted = np.ascontiguousarray(array, dtype=np.int64 if integer else np.float32)
    except (TypeError, ValueError) as error:
        raise UserError(f"{file}: {key} is not an array of numbers ({error})") from None
    expected = ", ".join("any" if n is None else str(n) for n in shape)
    if converted.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, converted.shape, strict=True)):
        raise UserError(f"{file}: {key} has shape {list(converted.shape)}, expected [{expected}]")
    if integer and array.dtype.kind == "f" and (array != converted).any():
        raise UserError(f"{file}: {key} holds values that are no whole numbers")
    if not integer and not np.isfinite(converted).all():
        raise UserError(f"{file}: {key} holds values that are not finite")
    return converted


def _read_eyelids(folder: Path, V: int) -> np.ndarray:
    eyelids = np.zeros((2, V, 3), np.float32)
    files = [folder / name for name in ("l_eyelid.npy", "r_eyelid.npy")]
    missing = [file for file in files if not is_there(file)]
    if len(missing) == 1:
        raise UserError(f"{missing[0]} is missing beside the other eyelid: one eye would never close; put it there")
    for side, file in enumerate(files if not missing else ()):
        eyelids[side] = _array({file.name: load_npy(file).squeeze()}, file.name, file, (V, 3))
    return eyelids


def _read_regions(folder: Path, V: int) -> dict[str, Tensor]:
    for name in ("FLAME_masks.pkl", "FLAME_masks/FLAME_masks.pkl", "masks.npz"):  # or as its archive unpacks
        file = folder / name
        if not is_there(file):
            continue
        regions = {}
        for region, indices in _read_arrays(file).items():
            index = _array({region: indices}, region, file, (None,), integer=True)
            if len(index) == V and np.isin(index, (0, 1)).all():  # 0 or 1 for every vertex, no indices
                index = np.flatnonzero(index)
            index = np.unique(index)
            if len(outside := index[(index < 0) | (index >= V)]):
                raise UserError(
                    f"{file}: the region {region} names vertex {outside[0]}, but the model has {V} vertices"
                )
            regions[str(region)] = torch.from_numpy(index)
        return regions
    return {}


def fingerprint_of(
    tensors: Mapping[str, Tensor],
    parents: tuple[int, ...],
    regions: Mapping[str, Tensor],
    layout_method: int = 0,
) -> str:
    """SHA-256 over everything that a head model consists of.

    Of a layout that was made, the method counts: machines round the last digit of its coordinates differently.
    """
    if layout_method:
        tensors = {name: tensor for name, tensor in tensors.items() if name not in ("uvs", "uv_faces")}
        tensors |= {LAYOUT_TENSOR: torch.tensor([layout_method])}
    digest = hashlib.sha256(repr(parents).encode())
    update: Callable[[bytes], None] = digest.update
    for name, tensor in sorted({**tensors, **{f"region {k}": v for k, v in regions.items()}}.items()):
        update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        update(tensor.numpy().tobytes())
    return digest.hexdigest()
