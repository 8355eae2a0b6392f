"""A person's rest: the expression and jaw that their motion is measured from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from avatar.errors import UserError
from avatar.head.lips import lip_gap, lip_pairs
from avatar.head.model import HeadModel, matrix_from_6d, nearest_rotation
from avatar.types import HeadParams

CALM_SHARE = 0.2  # of the frames with closed lips, those whose face is nearest to the generic neutral
CALM_MOST = 2000  # frames; every one is compared with every other
NEUTRAL_SHARE = 0.02  # of all frames, so many are averaged into the neutral expression
CLOSEST_SHARE = 0.02  # of all frames close the lips: a person who speaks all the time does so in m, b and p
LIPS_CLOSED = 0.0015  # metres farther apart than the closest ones: still closed, a tracker is no more exact than that
LIPS_OPEN = 0.003  # metres: one sees the teeth
EVERY = 4  # of so many vertices one is looked at, which moves the displacement of a face by less than 5%
CHUNK = 128  # frames that are posed at once


@dataclass(frozen=True)
class RestPose:
    """The expression and jaw that a person's motion is measured from."""

    expression: Float[Tensor, " E"]
    jaw: Float[Tensor, "3 3"]  # rotation matrix
    frame: int | None  # the frame that is most like it; None for a mean


def find_neutral(motion: Sequence[HeadParams], head: HeadModel) -> RestPose:
    """A person's own rest: the pose that they keep coming back to while the lips are closed and the face is calm.

    Frames with open lips are left out where the head model can show them. Calm are those 20% of the others whose face is
    displaced least from the head model's zero expression; a talking face may come back more often to another pose, which is
    why density alone is not enough. Among them, the frame whose nearest neighbours (2% of all frames) are closest is found,
    and those neighbours are averaged.
    """
    expression, jaw = stacked(motion)
    displacement, gap = _departures(expression, jaw, head)
    candidates = torch.arange(len(motion)) if gap is None else closed_frames(gap)
    calm = candidates[displacement[candidates].argsort()][: max(1, round(CALM_SHARE * len(candidates)))]
    calm = calm[:: -(-len(calm) // CALM_MOST)]
    features = torch.cat((expression, jaw.reshape(len(motion), 9)), dim=1)[calm]
    k = min(len(calm), max(1, round(NEUTRAL_SHARE * len(motion))))
    distances, neighbours = torch.cdist(features, features).topk(k, dim=1, largest=False)
    densest = int(distances.mean(dim=1).argmin())
    chosen = calm[neighbours[densest]]
    return RestPose(expression[chosen].mean(dim=0), nearest_rotation(jaw[chosen].mean(dim=0)), int(calm[densest]))


def closed_frames(gap: Float[Tensor, " N"]) -> Int[Tensor, " M"]:
    """The frames whose lips are as near to each other as this person's come, by how far apart they are (metres).

    A tracker leaves a gap between lips that touch, which is the same in all frames of a person.
    """
    closest = torch.quantile(gap.clamp(min=0), CLOSEST_SHARE, interpolation="higher")
    return (gap <= closest + LIPS_CLOSED).nonzero()[:, 0]


def frame_rest(motion: Sequence[HeadParams], frame: int) -> RestPose:
    """The pose of one frame as it is, where the user names the frame."""
    expression, jaw = stacked(motion[frame : frame + 1])
    return RestPose(expression[0], jaw[0], frame)


def chosen_frame(wanted: str, names: Sequence[str], whose: str) -> int:
    """The position of the frame called `wanted`, by its name or by the number in it: 12 is 00012.

    Raises UserError, with the names that there are, when there is none.
    """
    if wanted in names:
        return names.index(wanted)
    numbers = [int(name) if name.isascii() and name.isdigit() else None for name in names]
    if wanted.isascii() and wanted.isdigit() and int(wanted) in numbers:
        return numbers.index(int(wanted))
    raise UserError(
        f"{whose} has no frame {wanted!r} to choose; there are {names[0]} to {names[-1]} ({len(names)} frames)"
    )


def lips_apart(rest: RestPose, head: HeadModel) -> float | None:
    """How much farther apart the lips are in a pose than in the head model's own rest, metres; None: not known."""
    _, gap = _departures(rest.expression[None], rest.jaw[None], head)
    return None if gap is None else float(gap)


def _departures(
    expression: Float[Tensor, "N E"], jaw: Float[Tensor, "N 3 3"], head: HeadModel
) -> tuple[Float[Tensor, " N"], Float[Tensor, " N"] | None]:
    """RMS distance in metres of the vertices from the identity at rest, gaze and blinks left out, and `lip_gap` beyond
    that of the identity at rest; None for the latter where the head model does not show it."""
    pairs = lip_pairs(head.assets)
    sampled = torch.arange(0, head.assets.num_vertices, EVERY)
    rows = torch.cat((sampled, pairs.flatten()))
    rest = head.neutral_vertices()[rows]
    own_pairs = len(sampled) + torch.arange(pairs.numel()).reshape(-1, 2)
    displacements, gaps = [], []
    for E, R in zip(expression.split(CHUNK), jaw.split(CHUNK), strict=True):
        vertices = head.still_vertices(E, R, rows)
        displacements.append((vertices - rest)[:, : len(sampled)].square().mean(dim=(1, 2)).sqrt())
        if len(pairs):
            gaps.append(lip_gap(vertices, own_pairs) - lip_gap(rest[None], own_pairs))
    return torch.cat(displacements), torch.cat(gaps) if gaps else None


def find_mean(motion: Sequence[HeadParams]) -> RestPose:
    """The mean over all frames."""
    expression, jaw = stacked(motion)
    return RestPose(expression.mean(dim=0), nearest_rotation(jaw.mean(dim=0)), None)


def stacked(motion: Sequence[HeadParams]) -> tuple[Float[Tensor, "N E"], Float[Tensor, "N 3 3"]]:
    """Expressions and jaw rotations of N frames."""
    return (
        torch.stack([params.expression for params in motion]),
        matrix_from_6d(torch.stack([params.jaw for params in motion])),
    )
