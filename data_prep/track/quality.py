"""What a tracking is worth, in figures with thresholds, and what to do about each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from avatar.head.assets import HeadAssets
from data_prep.track.faces.embedding import LandmarkEmbedding
from data_prep.track.faces.landmark_groups import BROWS, IRISES, LEFT_IRIS, LIDS, LIPS, NOSE, RIGHT_IRIS
from data_prep.track.faces.landmarks import Landmarks
from data_prep.track.fit.focal import Focal
from data_prep.track.fit.result import Fit
from data_prep.track.mattes.steadiness import Outline

GRADES = ("good", "fair", "poor")
GROUPS = {"lips": LIPS, "lids": LIDS, "brows": BROWS, "nose": NOSE}
_OPEN = 0.5  # of an eye whose iris is judged
_WORST = 5  # frames that are named


@dataclass(frozen=True)
class Figure:
    """One measure. `good` and `fair` bound the grades; without them the figure is shown and not graded."""

    name: str
    value: float
    unit: str
    good: float | None = None
    fair: float | None = None
    advice: str = ""  # where it is not good
    more_is_better: bool = False

    @property
    def grade(self) -> str | None:
        if self.good is None or self.fair is None:
            return None
        sign = -1.0 if self.more_is_better else 1.0
        steps = (sign * self.value > sign * self.good, sign * self.value > sign * self.fair)
        return GRADES[sum(steps)] if np.isfinite(self.value) else "poor"

    def line(self) -> str:
        grade = self.grade
        judged = "" if grade is None else f"  {grade}"
        advice = f"  -> {self.advice}" if grade in GRADES[1:] and self.advice else ""
        return f"  {self.name:34} {self.value:9.3f} {self.unit:5}{judged}{advice}"

    def to_json(self) -> dict[str, Any]:
        figure = {"name": self.name, "value": self.value, "unit": self.unit}
        return figure if self.grade is None else figure | {"grade": self.grade, "advice": self.advice}


@dataclass(frozen=True)
class Quality:
    figures: tuple[Figure, ...]
    worst_frames: tuple[int, ...]
    focal: str

    def lines(self) -> list[str]:
        """For the terminal."""
        worst = ", ".join(f"{number:05d}" for number in self.worst_frames)
        return ["quality of the tracking", *(f.line() for f in self.figures), f"  frames that fit worst: {worst}"]

    def to_json(self) -> dict[str, Any]:
        figures = [figure.to_json() for figure in self.figures]
        return {"figures": figures, "worst_frames": list(self.worst_frames), "focal": self.focal}


def grade_tracking(
    landmarks: Landmarks, pictures: int, fit: Fit, overlaps: Sequence[float], outline: Outline | None, focal: Focal
) -> Quality:
    """The figures of a finished tracking of so many pictures: the video need not have one at every time.

    `fit.figures` holds what `landmark_figures` made of it.
    """
    own = fit.figures
    shots = {name: float(value) for name, value in own["errors"].items()}
    seen = float(landmarks.detected.sum() / pictures)
    figures = [
        Figure("frames with a face", 100 * seen, "%", 99, 90, "light the face, and keep it in the picture", True),
        Figure("face inside the picture", 100 * own["inside"], "%", 99, 95, "leave more room around the head", True),
        Figure("landmark error", shots.pop("all"), "% eyes", 1.0, 2.0, "is the head model's landmark embedding right?"),
        *(Figure(f"  of the {name}", value, "% eyes", 1.0, 2.0) for name, value in shots.items()),
        Figure("  the same in all frames, besides", own["constant"], "% eyes"),
        *_irises(own["irises"]),
        Figure("jitter, against the landmarks' own", own["jitter"], "x", 1.0, 1.2, "a steadier camera and more light"),
        Figure(
            "mesh above the neck on the matte", 100 * float(np.mean(overlaps)), "%", 98, 95,
            "look at overlay/: is the matte whole, and the head in its place?", True,
        ),
        *_of_outline(outline),
        *_torso(own.get("torso")),
        *_covered(own.get("covered"), len(fit.tracks)),
        Figure("largest identity coefficient", own["identity"], "", 4.0, 8.0, "give the focal length with --focal"),
    ]  # fmt: skip
    figures += [Figure(name, value, unit) for name, value, unit in own.get("photometric", ())]
    figures += coverage(fit, landmarks)
    return Quality(tuple(figures), tuple(own["worst_frames"]), focal.source)


def _irises(value: float | None) -> list[Figure]:
    advice = "the gaze does not follow: more light on the eyes, and a larger face"
    return [] if value is None else [Figure("irises of open eyes, 90 %", value, "% eyes", 1.0, 2.0, advice)]


def _of_outline(outline: Outline | None) -> list[Figure]:
    if outline is None:
        return []
    advice = "light the background evenly, film the face larger, or give mattes with --matte"
    return [
        Figure("jitter of the outline, at 512", outline.jitter, "px", 0.5, 1.0, advice),
        Figure("width of the matte's edge, at 512", outline.width, "px"),
    ]


def _torso(share: float | None) -> list[Figure]:
    # Never poor: a torso that is not followed stays with the head.
    advice = "keep the shoulders in the picture, and hands away from the collar"
    return [] if share is None else [Figure("frames whose torso was followed", 100 * share, "%", 90, 0, advice, True)]


def _covered(numbers: Sequence[int] | None, frames: int) -> list[Figure]:
    if numbers is None:  # frames that do not fit to each other show nothing of the kind
        return []
    advice = "keep hands off the face; --start and --end choose a part of the video"
    return [Figure("frames whose face is covered", 100 * len(numbers) / frames, "%", 2, 10, advice)]


def coverage(fit: Fit, landmarks: Landmarks) -> list[Figure]:
    """What the clip shows of the face: what it does not show, an avatar cannot learn."""
    rotations = np.stack([track.R for track in fit.tracks.values()])
    forward = rotations[:, :, 2]  # the face looks along its own z
    yaw = np.degrees(np.arctan2(forward[:, 0], -forward[:, 2]))
    rows = list(fit.tracks)
    closed = np.minimum(landmarks.score("eyeBlinkLeft")[rows], landmarks.score("eyeBlinkRight")[rows]) > 0.5
    blinks = int(closed[0]) + int((closed[1:] & ~closed[:-1]).sum())
    mouth = landmarks.score("jawOpen")[rows]
    advice = "turn the head to both sides in the video"
    return [
        Figure(
            "turns of the head, 5 to 95 %", float(np.subtract(*np.percentile(yaw, [95, 5]))), "deg", 20, 8, advice, True
        ),
        Figure("blinks", blinks, "", 3, 1, "let the video show closed eyes", True),
        Figure("widest opening of the mouth", float(mouth.max()), "", 0.3, 0.1, "speak in the video", True),
    ]


def landmark_figures(head: HeadAssets, fit: Fit, landmarks: Landmarks, embedding: LandmarkEmbedding) -> dict[str, Any]:
    """Errors of the landmarks of every group, their share inside the picture, jitter and the worst frames, as JSON.

    Errors are mean distances between the embedded and the detected landmarks, in per cent of the distance between the
    irises in the picture (its 90th percentile over the clip, since turned heads show it shorter). What is the same in all
    frames is subtracted: it is where the embedding lies on this face, and not an error of the tracking. Of the irises it
    is an error: the gaze can follow them.
    """
    rows = list(fit.tracks)
    placed = _placed(head, fit, embedding)
    observed = landmarks.points[rows][:, embedding.landmarks, :2]
    eyes = np.linalg.norm(landmarks.points[rows][:, LEFT_IRIS, :2] - landmarks.points[rows][:, RIGHT_IRIS, :2], axis=1)
    unit = float(np.percentile(eyes, 90)) / 100.0
    residual = (placed - observed) / unit
    constant = residual.mean(0)
    error = np.linalg.norm(residual - constant, axis=2)  # [T, L]
    groups = {name: np.isin(embedding.landmarks, members) for name, members in GROUPS.items()}
    features = np.any(list(groups.values()), axis=0)
    per_frame = error[:, features].mean(1)
    errors = {"all": float(per_frame.mean())}
    errors |= {name: float(error[:, members].mean()) for name, members in groups.items() if members.any()}
    worst = [rows[i] for i in np.argsort(-per_frame)[:_WORST]]
    is_inside = ((placed >= 0) & (placed < landmarks.size)).all(axis=2)
    return {
        "errors": errors,
        "inside": float(is_inside.mean()),
        "irises": _iris_distance(np.linalg.norm(residual, axis=2), embedding.landmarks, landmarks.open_shares()[rows]),
        "constant": float(np.linalg.norm(constant[features], axis=1).mean()),
        "jitter": _jitter(placed[:, features], rows) / max(_jitter(observed[:, features], rows), 1e-9),
        "worst_frames": sorted(worst),
        "identity": float(np.abs(next(iter(fit.tracks.values())).shape).max()),
    }


def _iris_distance(
    distance: Float[np.ndarray, "T L"], of: Int[np.ndarray, " L"], open_shares: Float[np.ndarray, "T 2"]
) -> float | None:
    """The 90th percentile over the irises of open eyes; None without any, or without eyeballs in the head model."""
    seen = [distance[open_shares[:, side] > _OPEN][:, of == iris].ravel() for side, iris in enumerate(IRISES)]
    together = np.concatenate(seen)
    return float(np.percentile(together, 90)) if len(together) else None


def _placed(head: HeadAssets, fit: Fit, embedding: LandmarkEmbedding) -> Float[np.ndarray, "T L 2"]:
    project = fit.projector(head)
    screens = []
    for number in fit.tracks:
        screen = project(number)[:, :2]
        screens.append((screen[embedding.corners] * embedding.barycentric[..., None]).sum(1))
    return np.stack(screens)


def _jitter(points: Float[np.ndarray, "T L 2"], numbers: Sequence[int]) -> float:
    """Mean length of second differences over time, pixels; of frames that follow each other."""
    follows = np.diff(numbers) == 1
    seconds = np.diff(points, n=2, axis=0)[follows[1:] & follows[:-1]]
    return float(np.linalg.norm(seconds, axis=-1).mean()) if len(seconds) else 0.0
