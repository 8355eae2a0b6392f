"""What one drawing of the "cpu" backend did and what it skipped."""

from __future__ import annotations

from typing import NamedTuple


class Counters(NamedTuple):
    """Numbers of one drawing, in the order in which the kernel gives them.

    A pair is one splat in one tile. A block holds as many neighbouring pixels as a vector register has lanes; it is stopped
    when no splat can change its pixels any more, a tile when all its blocks are.
    """

    hidden_transparent: int  # splats whose opacity is below alpha_min
    hidden_near: int
    hidden_flat: int  # seen edge-on, without blur
    hidden_outside: int  # of the image, or of the region
    visible: int  # all other splats
    # Of them: those that reach alpha_min in no pixel before it is stopped; not looked at in the backward pass.
    visible_without_effect: int
    tiles: int
    tiles_stopped: int
    blocks: int
    blocks_stopped: int
    pairs: int  # by the ellipse where alpha reaches alpha_min
    pairs_in_boxes: int  # by the box around that ellipse, for comparison
    pairs_in_squares: int  # by a square of three standard deviations of the longer axis, for comparison
    pairs_processed: int  # before their tile was stopped
    pixels_evaluated: int  # pairs of a splat and a pixel whose alpha was computed
    pixels_composited: int  # those that the image shows

    @property
    def splats(self) -> int:
        return self.hidden_transparent + self.hidden_near + self.hidden_flat + self.hidden_outside + self.visible
