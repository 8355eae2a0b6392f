"""How a tracking came about after the tracker: which avatars' pictures it was fitted with, and what those had seen."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict, dataclass
from typing import Any

from avatar.data.json_values import parse_object


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

    def __post_init__(self) -> None:
        if not self.rounds:
            raise ValueError("refinement has no rounds")

    def trained_on(self, numbers: Collection[int]) -> list[int]:
        """Those of these frames that were refined through an avatar which had been trained on them."""
        seen = {number for one in self.rounds for number in one.trained_on}
        return sorted(seen.intersection(numbers))

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Any) -> Refinement:
        """What `to_dict` gave, or JSON of it. Raises ValueError saying what is wrong."""
        return parse_object(values, cls, "refinement")
