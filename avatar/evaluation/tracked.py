"""What the tracking of the measured frames has seen, and the figures by the tracker's own where it was refined.

A refined frame was fitted to its own picture through an avatar. Published methods differ in exactly this: some fit the
held-out frames' tracking like any other, some take it as it comes. So both are measured: `refined`, the subject's own
tracking, and `tracked`, the same avatar driven by what the tracker left.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from tqdm import tqdm

from avatar.data.loader import FrameLoader
from avatar.data.recording import Recording
from avatar.evaluation.bootstrap import BlockBootstrap, block_length
from avatar.evaluation.draw import draw
from avatar.evaluation.measure import Figures, FrameMeasurer
from avatar.evaluation.protocol import Protocol
from avatar.evaluation.regions import region_masks
from avatar.evaluation.results import means
from avatar.losses.lpips_network import Lpips, Net
from avatar.render import Renderer
from avatar.runs.run import Run

OF_TRACKERS = "trackers fit each frame to its own picture, held out or not"


def describe_tracking(run: Run, measured: Sequence[int]) -> dict[str, Any]:
    """For results files: whose tracking the frames `measured` have, and which pictures it has seen by which method."""
    manifest = run.subject.manifest
    refinement = manifest.refinement
    if refinement is None:
        return {"tracking": "tracked", "tracker": manifest.format, "tracked": OF_TRACKERS, "rounds": []}
    numbers = [manifest.frames[index].tracking for index in measured]
    return {
        "tracking": "refined",
        "tracker": refinement.tracker,
        "tracked": OF_TRACKERS,
        "refined": "each frame was then fitted to its own picture, held out or not, through the avatar of another run",
        "rounds": [
            {
                "run": one.run,
                "step": one.step,
                "fingerprint": one.fingerprint,
                "frames_trained_on": len(one.trained_on),
                "measured_frames_trained_on": len(set(one.trained_on).intersection(numbers)),
            }
            for one in refinement.rounds
        ],
    }


def tracking_notes(tracking: Mapping[str, Any]) -> list[str]:
    """A warning where a measured frame was refined through an avatar that had been trained on it."""
    return [
        f"{one['measured_frames_trained_on']} of the measured frames were refined through the avatar of {one['run']}, "
        "which had been trained on them, as frames were divided otherwise there: their figures flatter"
        for one in tracking["rounds"]
        if one["measured_frames_trained_on"]
    ]


def measure_tracked(
    run: Run,
    given: Recording,
    renderer: Renderer,
    indices: Mapping[str, Sequence[int]],
    protocols: Sequence[Protocol],
    networks: Mapping[Net, Lpips | None],
) -> dict[str, dict[str, Any]]:
    """By protocol: means and intervals of the figures, without jitter, with the avatar driven by the tracking `given`.

    Truths, masks and regions are those of the figures beside them.
    """
    data, subject = run.config.data, run.subject
    found: dict[str, list[Figures]] = {protocol.name: [] for protocol in protocols}
    order = sorted(set().union(*indices.values()))
    with FrameLoader(subject, data.size, data.cache_mb << 20, data.workers) as loader:
        frames = tqdm(loader.frames(order), total=len(order), desc="eval, as tracked", unit="frame", disable=None)
        for frame in frames:
            wanted = [protocol for protocol in protocols if frame.index in indices[protocol.name]]
            camera, params = given.camera(frame.index, data.size), given.params(frame.index)
            pairs = draw(renderer, replace(frame, camera=camera, params=params), [p.look for p in wanted])
            masks = region_masks(frame, run.avatar.head, {"head", *(r for p in wanted for r in p.regions)})
            measurer = FrameMeasurer(pairs, masks, networks)
            for protocol in wanted:
                found[protocol.name].append(measurer.measure(protocol))
    return {name: _summary(figures, subject.fps) for name, figures in found.items()}


def _summary(frames: Sequence[Figures], fps: float) -> dict[str, Any]:
    columns = {name: np.array([figures[name] for figures in frames]) for name in frames[0]}
    bootstrap = BlockBootstrap(len(frames), block_length(len(frames), fps))
    return {
        "means": means(columns),
        "intervals": {name: bootstrap.interval(values) for name, values in columns.items()},
    }
