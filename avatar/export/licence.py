"""What of the head model goes into each exported format: printed with it, and written into its metadata."""

from __future__ import annotations

CONSENT = "It shows one person, and is for people who have that person's consent."
HEAD_LICENCE = (
    "The head model keeps its own licence: FLAME 2023 Open (CC-BY-4.0) may be passed on with attribution to the Max Planck "
    "Institute for Intelligent Systems; FLAME 2020 and 2023 may not be passed on; the demo's is free."
)
NOTHING = "Nothing of the head model is in it but the shape of this one face."
SKINNING = (
    "In it: this face's vertices under the Gaussians, with their skinning weights, pose correctives and the expressions "
    "that the training video used."
)
MESH = "In it: this face's mesh with the head model's triangles and UV layout, and its expressions as morph targets."
WHOLE = "In it: the whole head model."


def licence_of(content: str) -> str:
    """The sentences that go along with a file; `content` is one of the above."""
    return f"{content} {HEAD_LICENCE} {CONSENT}"
