"""Which pictures the tracking of each time is fitted to, and where their cameras stand."""

from __future__ import annotations

import torch

from avatar.data.recording import Recording
from avatar.pose_refinement.tracking_values import HeadPose

MOST_PICTURES = 6  # of a time, where there are several cameras


def fitted_pictures(recording: Recording) -> list[list[int]]:
    """Of each row of the tracks the pictures that its tracking is fitted to.

    With several cameras, of a time that training sees its training pictures alone; of another one those of the cameras
    that are trained on, if there are any. Of more than MOST_PICTURES those whose cameras stand far from each other.
    """
    of_row: dict[int, list[int]] = {}
    for index in range(len(recording)):
        of_row.setdefault(recording.time(index), []).append(index)
    train = set(recording.split.train)
    cameras = {recording.view(index) for index in train}
    return [
        far_apart(
            recording,
            [index for index in own if index in train]
            or [index for index in own if recording.view(index) in cameras]
            or own,
        )
        for _, own in sorted(of_row.items())
    ]


def far_apart(recording: Recording, pictures: list[int]) -> list[int]:
    """At most MOST_PICTURES: that of the first camera that there is, then again and again the farthest from all chosen."""
    if len(pictures) <= MOST_PICTURES:
        return pictures
    pictures = sorted(pictures, key=recording.view)
    places = [camera_place(recording, index) for index in pictures]
    centres = torch.stack([-place.R.T @ place.t for place in places if place is not None])
    chosen, away = [0], torch.cdist(centres, centres[:1])[:, 0]
    while len(chosen) < MOST_PICTURES:
        chosen.append(int(away.argmax()))
        away = away.minimum(torch.cdist(centres, centres[chosen[-1:]])[:, 0])
    return sorted(pictures[place] for place in chosen)


def camera_place(recording: Recording, index: int) -> HeadPose | None:
    """Of the camera that took a picture: p_cam = R p_ref + t; None with one camera."""
    if recording.rig is None:
        return None
    camera = recording.cameras[recording.view(index)]
    return HeadPose(torch.tensor(camera.R).reshape(3, 3), torch.tensor(camera.t))
