"""Good, fair or poor: words for the figures of held-out frames, of the head alone (docs/evaluation.md)."""

from __future__ import annotations

from typing import Literal, NamedTuple

Word = Literal["good", "fair", "poor"]


class Bounds(NamedTuple):
    """The larger the better where `good` is the larger one."""

    good: float
    fair: float
    decimals: int


# Named as in docs/bench: tables of recipe_results.md, real clips of track_results.md. LPIPS by other networks was measured
# on too few people to be called anything.
BOUNDS = {
    # Default recipe on anna, carla and franck: 27.6 to 29.2 dB. cap13_edit2, whose held-out frames step back as no training
    # frame does: 23.0 to 23.4. Clips that fail: cap12_edit 19.1, the last of track_results.md 17.3.
    "psnr": Bounds(27.0, 23.0, 0),
    # Default recipe: 0.915 to 0.930; base and the published recipe: 0.884 to 0.913 and 0.797 to 0.870.
    "ssim": Bounds(0.90, 0.79, 2),
    # Default recipe: 0.024 to 0.027; base: 0.031 to 0.046 on them.
    "lpips squeeze": Bounds(0.03, 0.05, 2),
}


def word_of(figure: str, value: float) -> Word | None:
    """None where no bounds are known."""
    if (bounds := BOUNDS.get(figure)) is None:
        return None
    sign = 1 if bounds.good > bounds.fair else -1
    good, fair = (sign * value >= sign * bound for bound in bounds[:2])
    return "good" if good else "fair" if fair else "poor"


def describe(figure: str) -> str:
    good, fair, decimals = BOUNDS[figure]
    name, _, network = figure.partition(" ")
    side = "least" if good > fair else "most"
    shown = f"{name.upper()} ({network})" if network else name.upper()
    return f"{shown} at {side} {good:.{decimals}f} good, {fair:.{decimals}f} fair"
