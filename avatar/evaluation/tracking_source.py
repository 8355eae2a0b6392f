"""Which tracking drives the avatar in an evaluation, and which pictures that tracking was fitted to.

A refined frame was fitted to its own picture through an avatar. Published methods differ in exactly this: some fit the
held-out frames' tracking like any other, some take it as it comes. So both are measured: `tracked`, the avatar driven by
what the tracker left, and `refined`, the same avatar driven by the refined tracking. `tracked` comes first everywhere.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

from avatar.data.recording import Recording
from avatar.data.subject import Subject
from avatar.evaluation.pictures import RENDERS, TRACKED_RENDERS
from avatar.runs.run import Run

Drive = Literal["tracked", "refined"]
FRAMES_FILE, TRACKED_FILE = "frames.csv", "tracked.csv"
OF_TRACKERS = "trackers fit each frame to its own picture, held out or not"
FITTED = "each frame, measured ones too, was then fitted to its own picture"
FITTED_BY_RIG = (
    "each time, measured ones too, was then fitted to pictures of cameras that are trained on, if it has any,"
)
OF_REFINEMENT = "through the avatar of another run"
LABELS: dict[Drive, str] = {"tracked": "tracked", "refined": "refined, fitted"}  # of the figures in tables
MARK = "(!)"  # beside the figures of a run whose measured frames were refined through an avatar that had seen them
OF_MARK = (
    f"{MARK}: frames that are measured were refined through an avatar that had been trained on them; figures flatter"
)


class Part(NamedTuple):
    """A protocol's figures as one tracking drives the avatar."""

    figures: dict[str, Any]  # means, intervals, ... of results.json
    table: str  # file of the frames' figures
    renders: str  # folder of the pictures


def drives(subject: Subject) -> dict[Drive, Recording]:
    """What the avatar is driven by: the tracker's tracking, then the subject's own where that was refined."""
    if subject.given is None:
        return {"tracked": subject.recording}
    return {"tracked": subject.given, "refined": subject.recording}


def parts(entry: dict[str, Any]) -> dict[Drive, Part]:
    """The figures in a protocol's entry of results.json, `tracked` first."""
    own: Drive = entry["driven_by"]
    found: dict[Drive, Part] = {}
    if "tracked" in entry:
        found["tracked"] = Part(entry["tracked"], TRACKED_FILE, TRACKED_RENDERS)
    found[own] = Part(entry, FRAMES_FILE, RENDERS)
    return found


def renders_of(drive: Drive, subject: Subject) -> str:
    """The folder of the pictures that a tracking drives."""
    return TRACKED_RENDERS if drive == "tracked" and subject.given is not None else RENDERS


def describe_tracking(run: Run, measured: Sequence[int]) -> dict[str, Any]:
    """For results files: whose tracking the frames `measured` have, and which pictures it has seen by which method."""
    manifest = run.subject.manifest
    refinement = manifest.refinement
    if refinement is None:
        return {"tracking": "tracked", "tracker": manifest.format, "tracked": OF_TRACKERS, "rounds": []}
    numbers = [manifest.number(index) for index in measured]
    return {
        "tracking": "refined",
        "tracker": refinement.tracker,
        "tracked": OF_TRACKERS,
        "refined": f"{FITTED if manifest.rig is None else FITTED_BY_RIG} {OF_REFINEMENT}",
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


def is_marked(tracking: Mapping[str, Any]) -> bool:
    """Whether a measured frame was refined through an avatar that had been trained on it."""
    return any(one["measured_frames_trained_on"] for one in tracking["rounds"])


def tracking_lines(tracking: Mapping[str, Any]) -> list[str]:
    """What the figures mean, for people: a line for each tracking, and a warning where the run is marked."""
    lines = [f"tracked: as {tracking['tracker']} left it; {tracking['tracked']}"]
    return [*lines, *tracking_notes(tracking)]


def legend(trackings: Sequence[Mapping[str, Any]]) -> list[str]:
    """The same for the figures of several runs, which name the avatars themselves."""
    trackers = " and ".join(dict.fromkeys(str(one["tracker"]) for one in trackings))
    refined = [
        f"{LABELS['refined']}: {one['refined']}; no figures of unseen frames" for one in trackings if one["rounds"]
    ]
    marked = [OF_MARK] if any(map(is_marked, trackings)) else []
    return [f"tracked: as {trackers} left it; {OF_TRACKERS}", *dict.fromkeys(refined), *marked]


def tracking_notes(tracking: Mapping[str, Any]) -> list[str]:
    """Those lines that a refined subject adds."""
    fitted = str(tracking.get("refined", "")).removesuffix(OF_REFINEMENT)
    lines = [
        f"refined: {fitted}through the avatar of {one['run']} (step {one['step']}), which was trained on "
        f"{one['frames_trained_on']} frames, {one['measured_frames_trained_on'] or 'none'} of them measured"
        for one in tracking["rounds"]
    ]
    return [*lines, *([OF_MARK] if is_marked(tracking) else [])]
