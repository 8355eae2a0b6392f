"""What a refinement leaves beside the tracking: figures of every frame, a sheet of pictures, a summary in words."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from avatar.data.recording import Recording
from avatar.data.split import evenly_spread
from avatar.data.subject import Subject
from avatar.files.names import as_text
from avatar.files.video import ERROR_SCALE, error_map, padded, side_by_side
from avatar.files.write_image import encode_image
from avatar.gaussians.base_model import Avatar
from avatar.pose_refinement.fitted_pictures import fitted_pictures
from avatar.pose_refinement.refine_subject import Refined
from avatar.render import Renderer
from avatar.splat import checked_drawings

COLUMNS = ("frame", "name", "part", "psnr_before", "psnr_after", "turn_degrees", "shift_mm")
SHEET_FRAMES = 4  # evenly spread over the held-out ones, besides those that gained most and least


def frames_csv(subject: Subject, refined: Refined, centre: Float[Tensor, " 3"]) -> str:
    """A line for each frame: how well the head fitted before and after (dB), and how far it was turned and shifted. With
    several cameras a line for each time, with the name of the first picture that it was fitted to."""
    turns, shifts = movements(subject.recording.tracks, refined.tracks, centre)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    recording = subject.recording
    parts = {row: part for part, rows in _rows_of_parts(recording).items() for row in rows}
    for row, (index, *_) in enumerate(fitted_pictures(recording)):
        figures = (refined.before[row], refined.after[row], math.degrees(turns[row]), 1e3 * shifts[row])
        name, shown = as_text(recording.names[index]), (f"{figure:.4f}" for figure in figures)
        writer.writerow((row, name, parts.get(row, ""), *shown))
    return text.getvalue()


def movements(
    before: Mapping[str, Tensor], after: Mapping[str, Tensor], centre: Float[Tensor, " 3"]
) -> tuple[Float[np.ndarray, " T"], Float[np.ndarray, " T"]]:
    """How far the head was turned, radians, and its centre was shifted, metres."""
    R = after["R"].double() @ before["R"].double().mT
    # By the chord of the turn: the trace near 3 would hide small ones.
    turns = 2.0 * torch.asin(((R - torch.eye(3)).square().sum(dim=(1, 2)) / 8.0).sqrt().clamp(max=1.0))
    places = [tracks["R"].double() @ centre.double() + tracks["t"].double() for tracks in (before, after)]
    return turns.numpy(), (places[1] - places[0]).norm(dim=1).numpy()


def summary(subject: Subject, refined: Refined, centre: Float[Tensor, " 3"]) -> list[str]:
    """For people."""
    lines = []
    rows_of, titles = _rows_of_parts(subject.recording), {"train": "training frames", "test": "held-out frames"}
    fitted = "each frame fitted to its own picture" if subject.recording.rig is None else "each time to its pictures"
    for part, title in titles.items():
        if rows := rows_of[part]:
            before, after = (_mean(values[rows]) for values in (refined.before, refined.after))
            lines.append(
                f"{title + ':':17} head-only PSNR {before:.2f} -> {after:.2f} dB with the avatar as it is, {fitted}"
            )
    turns, shifts = movements(subject.recording.tracks, refined.tracks, centre)
    turn, shift = math.degrees(float(np.median(turns))), 1e3 * float(np.median(shifts))
    lines.append(f"{'moved:':17} {turn:.2f} degrees and {shift:.2f} mm, medians")
    unseen = np.isnan(refined.before)
    for kept, why in ((refined.kept & ~unseen, "which would have fitted no better"), (unseen, "which show no head")):
        if kept.any():
            lines.append(f"{'as they were:':17} {int(kept.sum())} frames, {why}")
    return lines


@torch.no_grad()
def sheet(
    avatar: Avatar, subject: Subject, refined: Refined, after: Recording, size: int | None, background: Tensor
) -> bytes:
    """A PNG file: a row for each of some frames, truth, avatar before and after, and the errors of both."""
    renderer = Renderer(avatar, background)
    rows: list[UInt8[np.ndarray, "H W 3"]] = []
    recording = subject.recording
    of = "" if recording.rig is None else " where fitted"
    pictures = {recording.time(index): index for index in recording.moments(subject.split.test)}
    for row in sheet_frames(list(pictures), refined):
        index = pictures[row]
        frame = subject.frame(index, size)
        truth = frame.composite(background)
        weight = frame.head_mask[..., None]
        with checked_drawings():
            renders = [
                renderer.render(recording.params(index), recording.camera(index, size)).image.cpu()
                for recording in (subject.recording, after)
            ]
        errors = [error_map(render * weight, truth * weight) for render in renders]
        captions = (
            f"truth of {frame.name}",
            f"before, {refined.before[row]:.2f} dB{of}",
            f"after, {refined.after[row]:.2f} dB{of}",
            f"error before, 0 to {ERROR_SCALE:g}",
            "error after",
        )
        rows.append(side_by_side((truth, *renders, *errors), captions))
    width = max(row.shape[1] for row in rows)
    filled = np.concatenate([padded(row, len(row), width) for row in rows])
    return encode_image(filled)


def sheet_frames(test: Sequence[int], refined: Refined) -> list[int]:
    """Held-out frames for the sheet, in order."""
    gain = np.where(np.isfinite(refined.after - refined.before), refined.after - refined.before, 0.0)[list(test)]
    return sorted({*evenly_spread(test, SHEET_FRAMES), test[int(gain.argmax())], test[int(gain.argmin())]})


def _rows_of_parts(recording: Recording) -> dict[str, list[int]]:
    """Rows of the tracks that training has seen, and the others that are measured."""
    train, test = (recording.times(indices) for indices in recording.split)
    seen = set(train)
    return {"train": train, "test": [row for row in test if row not in seen]}


def _mean(values: Float[np.ndarray, " T"]) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else math.nan
