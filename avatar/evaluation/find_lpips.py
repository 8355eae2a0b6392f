"""Which LPIPS network measures for each backbone that a protocol asks for."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import torch

from avatar.compute.device import CPU
from avatar.losses.lpips import MissingWeights, load_lpips
from avatar.losses.lpips_network import NETS, Lpips, Net


class ChosenLpips(NamedTuple):
    network: Lpips | None
    note: str  # for people: which network, or why none

    def as_json(self) -> dict[str, Any]:
        return {
            "network": self.network.net if self.network else None,
            "weights_sha256": self.network.fingerprint() if self.network else None,
            "note": self.note,
        }


def find_networks(nets: Iterable[Net], device: torch.device = CPU) -> dict[Net, ChosenLpips]:
    """The network of each backbone, loaded once, on a device."""
    found: dict[Net, ChosenLpips] = {net: find_lpips(net) for net in dict.fromkeys(nets)}
    for chosen in found.values():
        if chosen.network is not None:
            chosen.network.on(device)
    return found


def find_lpips(net: Net) -> ChosenLpips:
    """The protocol's network if its weights are on this machine, else another one, else none, and a note that says so."""
    try:
        return ChosenLpips(load_lpips(net), net)
    except MissingWeights as error:
        missing = error
    for other in NETS:
        try:
            lpips = load_lpips(other)
        except MissingWeights:
            continue
        return ChosenLpips(lpips, f"{other}, not to be compared with figures of {net} ({missing.brief})")
    return ChosenLpips(None, f"not measured: {missing.brief}")
