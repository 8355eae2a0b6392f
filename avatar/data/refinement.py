"""How a tracking came about after the tracker: which avatars' pictures it was fitted with, and what those had seen."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict, dataclass
from typing import Any

from avatar.errors import UserError


@dataclass(frozen=True)
class Round:
    """One refinement of every frame through an avatar. Each frame's own picture was looked at."""

    run: str  # where the avatar was
    step: int  # optimizer steps that it was trained for
    fingerprint: str  # of its parameters
    trained_on: tuple[int, ...]  # numbers of the frames that it was trained on, increasing


@dataclass(frozen=True)
class Refinement:
    """What a tracker left, and the rounds that improved it; at least one."""

    tracker: str  # the format of the folder that the tracker wrote
    rounds: tuple[Round, ...]

    def trained_on(self, numbers: Collection[int]) -> list[int]:
        """Those of these frames that were refined through an avatar which had been trained on them."""
        seen = {number for one in self.rounds for number in one.trained_on}
        return sorted(seen.intersection(numbers))

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Any) -> Refinement:
        """What `to_dict` gave, or JSON of it. Raises UserError saying what is wrong."""
        if not isinstance(values, dict) or not isinstance(values.get("tracker"), str):
            raise UserError("it names no tracker")
        rounds = values.get("rounds")
        if not isinstance(rounds, list | tuple) or not rounds:
            raise UserError("it has no rounds")
        return cls(values["tracker"], tuple(_round(one) for one in rounds))


def _round(values: Any) -> Round:
    kinds = {"run": str, "step": int, "fingerprint": str, "trained_on": (list, tuple)}
    if not isinstance(values, dict) or any(not isinstance(values.get(key), kind) for key, kind in kinds.items()):
        raise UserError(f"a round lacks one of {', '.join(kinds)}, or it is of the wrong type")
    if not all(isinstance(number, int) and not isinstance(number, bool) for number in values["trained_on"]):
        raise UserError("trained_on of a round is not a list of frame numbers")
    return Round(values["run"], values["step"], values["fingerprint"], tuple(sorted(values["trained_on"])))
