"""What shows how far a long piece of work is."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol, TypeVar

Item = TypeVar("Item")


class Progress(Protocol):
    """Passes items through, of which there will be `total` where that is known, and shows how far it is."""

    def __call__(
        self, items: Iterable[Item], total: int | None, title: str, unit: str = "frames"
    ) -> Iterable[Item]: ...


def silent(items: Iterable[Item], total: int | None, title: str, unit: str = "frames") -> Iterable[Item]:
    return items
