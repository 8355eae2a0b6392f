"""One person's face through a clip in which there may be several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from data_prep.track.faces.detect import Face, overlap

_FOLLOWS = 0.2  # overlap (IoU) with the last place of a face that makes it the same one
_PATIENCE = 15  # pictures that a face may be away and still be the same at the same place
_RETURNS = 1.5  # factor of size, and faces of distance, within which a face that was away is the same person


@dataclass
class _Chain:
    """Findings that follow each other in place."""

    pictures: list[int] = field(default_factory=list)
    faces: list[Face] = field(default_factory=list)

    def weight(self) -> float:
        return sum(face.height**2 for face in self.faces)

    def takes(self, n: int, face: Face) -> float:
        if n == self.pictures[-1] or n - self.pictures[-1] > _PATIENCE:
            return 0.0
        return overlap(self.faces[-1].box, face.box)


def follow_one(found: Sequence[Sequence[Face]]) -> tuple[list[Face | None], list[str]]:
    """The face of one person in every picture (None where it is not seen), and what the user should know.

    The person is the one with the most picture area over the clip. A face that comes back after it was away is taken as
    the same when size and place fit; other people's faces never stand in.
    """
    chains = _chains(found)
    if not chains:
        return [None] * len(found), []
    main = max(chains, key=_Chain.weight)
    chosen: list[Face | None] = [None] * len(found)
    for n, face in zip(main.pictures, main.faces, strict=True):
        chosen[n] = face
    others: list[_Chain] = []
    returns = 0
    for chain in sorted((c for c in chains if c is not main), key=lambda c: -len(c.pictures)):
        if any(chosen[n] is not None for n in chain.pictures) or not _fits(chain, chosen):
            others.append(chain)
            continue
        returns += 1
        for n, face in zip(chain.pictures, chain.faces, strict=True):
            chosen[n] = face
    return chosen, _notes(chosen, others, returns)


def _chains(found: Sequence[Sequence[Face]]) -> list[_Chain]:
    chains: list[_Chain] = []
    for n, faces in enumerate(found):
        active = [chain for chain in chains if n - chain.pictures[-1] <= _PATIENCE]
        for face in faces:
            scores = [chain.takes(n, face) for chain in active]
            if scores and max(scores) > _FOLLOWS:
                chain = active[int(np.argmax(scores))]
            else:
                chain = _Chain()
                chains.append(chain)
            chain.pictures.append(n)
            chain.faces.append(face)
    return chains


def _fits(chain: _Chain, chosen: Sequence[Face | None]) -> bool:
    """Whether the chain's first or last face is like the person's nearest one in time."""
    known = [n for n, face in enumerate(chosen) if face is not None]
    for n, face in ((chain.pictures[0], chain.faces[0]), (chain.pictures[-1], chain.faces[-1])):
        nearest = chosen[min(known, key=lambda m: abs(m - n))]
        assert nearest is not None
        larger, smaller = max(face.height, nearest.height), min(face.height, nearest.height)
        apart = np.linalg.norm(face.points[:, :2].mean(0) - nearest.points[:, :2].mean(0))
        if larger < _RETURNS * smaller and apart < _RETURNS * larger:
            return True
    return False


def _notes(chosen: Sequence[Face | None], others: Sequence[_Chain], returns: int) -> list[str]:
    notes = []
    pictures = {n for chain in others for n in chain.pictures}
    beside = sum(chosen[n] is not None for n in pictures)
    if beside:
        notes.append(f"another face is beside it in {beside} of {len(chosen)} pictures: the largest one is followed")
    alone = sorted(n for n in pictures if chosen[n] is None)
    if alone:
        notes.append(
            f"the face changes: {len(alone)} of {len(chosen)} pictures, from number {alone[0]} on, show another person's "
            "only; left out"
        )
    if returns:
        notes.append(
            f"the face comes back after a while, or moves far between two pictures ({returns}x), and is taken as the same "
            "person's"
        )
    return notes
