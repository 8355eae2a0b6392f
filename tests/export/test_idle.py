"""The idle motion of the page."""

from __future__ import annotations

from pathlib import Path

import torch
from browsers import node

from avatar.head.model import matrix_from_6d
from avatar.motion.orbit import orbited
from avatar.types import IDENTITY_6D, Camera

REST = Camera(torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.tensor([0.0, 0.0, 0.8]), 80, 80, 32, 32, 64, 64)


def test_the_torso_stays_when_the_head_sways_and_training_has_seen_that() -> None:
    frames = node(Path(__file__).parent / "idle.mjs")
    for frame in frames["torso"]:
        assert max(map(abs, frame["turn"])) > 0.5
        head = orbited(REST, *frame["turn"]).R_cam_world
        torso = head @ matrix_from_6d(torch.tensor(frame["neck"])).T
        torch.testing.assert_close(torso, REST.R_cam_world, rtol=0, atol=1e-5)
    assert all(frame["neck"] == list(IDENTITY_6D) for frame in frames["none"])
