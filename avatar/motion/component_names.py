"""Plain words for what a direction of the expression space does: where it moves the face most, and how."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.head.model import LEFT_EYE, RIGHT_EYE, HeadModel

# Parts of a face as boxes around the middle between the eyes, in distances between the eyes: sideways (of either side),
# down to up. Rough means of adults; a vertex belongs to the first box that holds it.
BOXES: dict[str, tuple[tuple[float, float], tuple[float, float]]] = {
    "Eyes": ((0.0, 0.9), (-0.25, 0.25)),
    "Brows": ((0.0, 1.0), (0.25, 0.95)),
    "Nose": ((0.0, 0.35), (-0.8, -0.25)),
    "Mouth": ((0.0, 0.6), (-1.6, -0.8)),
    "Cheeks": ((0.35, 1.2), (-1.2, -0.25)),
    "Jaw": ((0.0, 1.2), (-2.2, -1.2)),
}
SECOND = 0.3  # a second word, where its measure is at least so large a part of the first one's
LEAST = 1e-5  # metres: what moves less does not move


def name_components(directions: Float[Tensor, "K E"], head: HeadModel) -> list[tuple[str, str, float]]:
    """For each direction the part of the face that it moves most, in what way, and the sign with which it does.

    No two have the same part and way; a number tells them apart where words do not.
    """
    parts = _parts(head)
    taken: set[tuple[str, str]] = set()
    found = []
    for number, direction in enumerate(directions, start=1):
        moved = torch.einsum("vce,e->vc", head.assets.expression_dirs.double(), direction.double())
        energy = {part: float(moved[where].square().sum()) for part, (where, _) in parts.items() if len(where)}
        part = max(energy, key=energy.__getitem__, default="Face")
        if part not in parts or float(moved.abs().max()) < LEAST:
            part, words, sign = "Face", [f"component {number}"], 1.0
        else:
            where, places = parts[part]
            words, sign = _ways(_measures(part, moved[where], places))
        numbered = (f"{words[0]} ({n})" for n in itertools.count(2))
        name = next(n for n in itertools.chain(words, numbered) if (part, n) not in taken)
        taken.add((part, name))
        found.append((part, name, sign))
    return found


def _parts(head: HeadModel) -> dict[str, tuple[Tensor, Float[Tensor, "v 3"]]]:
    """Vertices of each part, and where they lie from its middle; nothing where the head has no eyes to go by."""
    vertices = head.neutral_vertices().double()
    joints = head.assets.joint_regressor.double() @ vertices
    middle, apart = (joints[LEFT_EYE] + joints[RIGHT_EYE]) / 2, float((joints[LEFT_EYE] - joints[RIGHT_EYE]).norm())
    if apart < 1e-3:
        return {}
    place = (vertices - middle) / apart
    free = place[:, 2] > -0.5  # the face, not the back of the head
    parts = {}
    for part, ((inner, outer), (low, high)) in BOXES.items():
        sideways = place[:, 0].abs()
        inside = free & (sideways >= inner) & (sideways <= outer) & (place[:, 1] >= low) & (place[:, 1] <= high)
        free &= ~inside
        where = inside.nonzero().flatten()
        if len(where):
            parts[part] = where, place[where] - place[where].mean(dim=0)
    return parts


def _measures(part: str, moved: Float[Tensor, "v 3"], place: Float[Tensor, "v 3"]) -> Mapping[str, float]:
    """How much of each plain movement there is, metres; positive in the direction that the word says."""

    def slope(values: Float[Tensor, " v"], along: Float[Tensor, " v"]) -> float:
        """Movement of one side against the other, each a standard deviation from the part's middle: a change of shape."""
        spread = float(along.square().mean().sqrt())
        return 2 * float((values * along).mean()) / max(spread, 1e-9)

    x, y, z = moved.unbind(dim=1)
    side = place[:, 0].abs() - place[:, 0].abs().mean()
    measures = {
        "up": float(y.mean()),
        "sideways": float(x.mean()),
        "forward": float(z.mean()),
        "wide": slope(x, place[:, 0]),
        "tilted": slope(y, place[:, 0]),
    }
    if part == "Mouth":
        measures |= {"open": slope(y, place[:, 1]), "corners up": slope(y, side)}
        if measures["wide"] * measures["corners up"] > 0:
            measures["smile"] = measures["wide"] + measures["corners up"]
    elif part == "Brows":
        measures |= {"outer ends up": slope(y, side)}
    elif part == "Eyes":
        measures |= {"open": slope(y, place[:, 1])}
    return measures


def _ways(measures: Mapping[str, float]) -> tuple[Sequence[str], float]:
    """Names from the plainest on, and the sign that makes the first word true."""
    ranked = sorted(measures, key=lambda word: -abs(measures[word]))
    first, sign = ranked[0], 1.0 if measures[ranked[0]] >= 0 else -1.0
    opposite = {
        "up": "down",
        "forward": "back",
        "wide": "narrow",
        "open": "closed",
        "corners up": "corners down",
        "smile": "frown",
    }
    names = [first]
    for word in ranked[1:]:
        if abs(measures[word]) >= SECOND * abs(measures[first]):
            names.append(f"{first}, {word if measures[word] * sign > 0 else opposite.get(word, word)}")
    return names, sign
