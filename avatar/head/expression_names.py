"""What a head model's expression coefficients are called, and how ARKit's blendshapes map to them.

`expression_names.json` beside the model file holds

    {"names": ["smile_left", null, ...],                      one for each coefficient, null where it has none
     "arkit": {"MouthSmileLeft": {"smile_left": 1.0, "17": 0.2},   optional: weights of coefficients, by name or number
               "JawOpen": {"jaw_x": 0.3}}}                     or of the jaw's rotation vector, radians

or the list of names alone. Without an entry of "arkit", a blendshape moves the coefficient of the same name
(`MouthSmileLeft`, `mouthSmile_L` and `mouth_smile_left` are the same), or the pair of left and right ones.
"""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from avatar.errors import UserError
from avatar.files.read import is_there, read_json

NAMES_FILE = "expression_names.json"
JAW_TARGETS = ("jaw_x", "jaw_y", "jaw_z")
MAX_WEIGHT = 1e6
_MAX_BYTES = 2**24
_NUMBER = re.compile("0|[1-9][0-9]{0,5}")


@dataclass(frozen=True)
class ExpressionNames:
    names: tuple[str | None, ...] = ()  # of the coefficients
    arkit: dict[str, dict[str, float]] = field(default_factory=dict)  # plain blendshape name -> coefficient -> weight

    def to_dict(self) -> dict[str, Any]:
        """What `parse_expression_names` reads."""
        return {"names": list(self.names), "arkit": self.arkit}

    @cached_property
    def _places(self) -> dict[str, int]:
        """The first coefficient of each plain name; a stream asks for a hundred names for every frame."""
        return {plain(name): i for i, name in reversed(list(enumerate(self.names))) if name is not None}

    def index(self, name: str) -> int | None:
        """The coefficient of a name, whatever its style of writing."""
        return self._places.get(plain(name))

    def targets(self, blendshape: str) -> dict[int | str, float]:
        """Coefficients (by number) and jaw axes that one of ARKit's blendshapes moves; nothing where none does."""
        if (given := self.arkit.get(plain(blendshape))) is not None:
            return {self._target(name): weight for name, weight in given.items()}
        found = [self.index(name) for name in (blendshape, f"{blendshape}Left", f"{blendshape}Right")]
        if found[0] is not None:
            return {found[0]: 1.0}
        return {index: 1.0 for index in found[1:] if index is not None}

    def _target(self, name: str) -> int | str:
        if name in JAW_TARGETS:
            return name
        index = self.index(name)
        return int(name) if index is None else index


def plain(name: str) -> str:
    """A name without its style of writing: mouthSmile_L, MouthSmileLeft and mouth_smile_left are mouthsmileleft.

    Letters of any script count. A name without a letter or a digit stays as it is: two of these are not the same.
    """
    sided = re.sub(r"_L$", "left", re.sub(r"_R$", "right", name))
    return re.sub(r"[\W_]", "", unicodedata.normalize("NFKC", sided).lower()) or name


def load_expression_names(folder: Path, num_expressions: int) -> ExpressionNames:
    """The names that lie in a head model's folder; none where there is no such file.

    Raises UserError for a file that is not of the form above, or that names coefficients that do not exist.
    """
    path = folder / NAMES_FILE
    if not is_there(path):
        return ExpressionNames()
    return parse_expression_names(read_json(path, _MAX_BYTES), num_expressions, path)


def parse_expression_names(raw: Any, num_expressions: int, path: Path | str) -> ExpressionNames:
    """The names of a parsed file; `path` is for messages. Raises UserError as `load_expression_names` does."""
    raw = {"names": raw} if isinstance(raw, list) else raw
    names = raw.get("names") if isinstance(raw, dict) else None
    if not isinstance(names, list) or not all(name is None or isinstance(name, str) for name in names):
        raise UserError(f'{path} must hold "names", a list of texts and nulls')
    if len(names) > num_expressions:
        raise UserError(f"{path} names {len(names)} coefficients, but the head model has {num_expressions}")
    known = ExpressionNames(tuple(names))
    return ExpressionNames(known.names, _read_arkit(path, raw.get("arkit", {}), known, num_expressions))


def _read_arkit(
    path: Path | str, raw: Any, known: ExpressionNames, num_expressions: int
) -> dict[str, dict[str, float]]:
    if not isinstance(raw, dict) or not all(isinstance(weights, dict) for weights in raw.values()):
        raise UserError(f'{path}: "arkit" must hold, for each blendshape, an object of weights')
    for blendshape, weights in raw.items():
        for name, weight in weights.items():
            exists = name in JAW_TARGETS or known.index(name) is not None
            if not exists and not (_NUMBER.fullmatch(name) and int(name) < num_expressions):
                raise UserError(f"{path}: {blendshape} moves {name!r}, which is no coefficient of the head model")
            if isinstance(weight, bool) or not isinstance(weight, (int, float)) or not abs(weight) < MAX_WEIGHT:
                raise UserError(f"{path}: the weight of {name!r} in {blendshape} is {weight!r}, not a number")
    return {plain(blendshape): dict(weights) for blendshape, weights in raw.items()}
