"""Which values of the tracking may move, how far is plausible, and how smoothly they move over time.

Everything is taken from the given tracking of the training frames: a coefficient that never moves there has no meaning
to the avatar and stays; one that moves may go where training has been and no farther, so that it keeps its meaning.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from avatar.pose_refinement.tracking_values import NECK, POSE, SHIFT, TURN, Tracks, accelerations, values_of

DEGREE = math.pi / 180
# Standard deviations of a tracker's error that are assumed at least. Depth hardly shows in the picture, so that a blurred
# avatar's preference for a size would move it without bound: it is trusted more.
TURN_UNIT, SHIFT_UNIT, DEPTH_UNIT, NECK_UNIT = 0.5 * DEGREE, 1e-3, 0.5e-3, 0.5 * DEGREE
HEAD_REACH = 20.0  # of these: a head that is farther off was not tracked
SPREAD_SHARE = 0.5  # of a coefficient's standard deviation over the training frames
# Trackers err smoothly: on real people a fifth of the error comes and goes from frame to frame, and that fifth can be seen.
JITTER_SHARE = 0.2
STILL = 1e-6  # a coefficient that spreads less than this does not move
# Weight of the given motion's own accelerations as the scale of smoothness. Speech and blinks are abrupt, the head is not.
HEAD_CALM, FACE_CALM = 1.0, 0.01
EXTREMES = 0.1  # share of the lowest and of the highest that a mean leaves out: frames in which the tracker was lost
LEAST_ACCELERATION = 0.02  # units; a clip in which something stands still does not prove that it cannot move


@dataclass(frozen=True)
class PoseParameterization:
    """F of the P values of a frame may move; moves are measured in `unit`, from where the tracking is."""

    given: Float[Tensor, "T P"]
    lowest: Float[Tensor, "T P"]  # that a value may become
    highest: Float[Tensor, "T P"]
    index: Int[Tensor, " F"]
    unit: Float[Tensor, " F"]  # one standard deviation of the error that is expected
    acceleration: Float[Tensor, "T F"]  # second differences of the given motion, float64, units
    calm: Float[Tensor, " F"]  # weight of a squared acceleration of one unit

    def on(self, device: torch.device) -> PoseParameterization:
        return PoseParameterization(*(getattr(self, field.name).to(device) for field in fields(self)))

    def values(self, frame: int, moves: Float[Tensor, " F"]) -> Float[Tensor, " P"]:
        """Differentiable in `moves`."""
        return self.given[frame].index_add(0, self.index, moves * self.unit)

    def bounds(self, frame: int) -> tuple[Float[Tensor, " F"], Float[Tensor, " F"]]:
        """The lowest and the highest moves of a frame."""
        low, high = (
            (bound[frame] - self.given[frame])[self.index] / self.unit for bound in (self.lowest, self.highest)
        )
        return low, high

    def all_values(self, moves: Float[Tensor, "T F"]) -> Float[Tensor, "T P"]:
        """The values of every frame, brought within their bounds."""
        moved = self.given.index_add(1, self.index, moves * self.unit)
        return torch.minimum(torch.maximum(moved, self.lowest), self.highest)

    def centred(self, moves: Float[Tensor, "T F"], frames: Bool[Tensor, " T"]) -> Float[Tensor, "T F"]:
        """The moves less what those of the head pose have in common in `frames`, of which there may be none.

        No picture shows a shift that all training frames share: the avatar has learned it with them. Where moves agree on
        one all the same, a blurred avatar prefers a size or a place, and the tracker's mean is the better guess.
        """
        if not frames.any():
            return moves
        from scipy.stats import trim_mean  # takes half a second to import

        common = torch.from_numpy(trim_mean(moves[frames].numpy(), EXTREMES, axis=0))
        return moves - torch.where(self.index < POSE.stop, common, 0.0)

    def changed(self) -> Bool[Tensor, " P"]:
        return torch.zeros(self.given.shape[1], dtype=torch.bool).index_fill(0, self.index, True)


def find_parameterization(
    tracks: Tracks, train: Sequence[int], centre: Float[Tensor, " 3"], numbers: Sequence[int] | None = None
) -> PoseParameterization:
    """What may move in a tracking whose frames `train` the avatar was trained on; `centre` of the head, metres.

    numbers   of the frames in the video, in which neighbours follow each other; None: all frames do
    """
    given = values_of(tracks)
    training = given[list(train)]
    spread = training.std(dim=0, unbiased=False)
    motion = accelerations(tracks, given, centre)
    numbers = range(len(given)) if numbers is None else numbers
    own = {numbers[i] for i in train}  # a difference over neighbours that are held out would tell of them
    inner = [i for i in train if {numbers[i] - 1, numbers[i] + 1} <= own]
    typical = motion[inner].square().mean(dim=0).sqrt() if inner else motion.new_zeros(motion.shape[1])
    # The torso turns against the head, so that one's accelerations are plausible for the other.
    typical[NECK] = typical[NECK].maximum(typical[TURN])

    unit = torch.where(spread > STILL, SPREAD_SHARE * spread, 0.0)
    least = given.new_zeros(given.shape[1])
    least[TURN], least[SHIFT], least[NECK] = TURN_UNIT, SHIFT_UNIT, NECK_UNIT
    least[SHIFT.stop - 1] = DEPTH_UNIT
    seen = _white_noise(motion[inner]) / JITTER_SHARE
    head = slice(POSE.start, NECK.stop)
    unit[head] = least[head].maximum(seen[head].to(unit))

    lowest, highest = training.amin(dim=0).minimum(given), training.amax(dim=0).maximum(given)
    lowest[:, head] = given[:, head] - HEAD_REACH * unit[head]
    highest[:, head] = given[:, head] + HEAD_REACH * unit[head]
    index = (unit > 0).nonzero()[:, 0]
    unit = unit[index]

    weight = torch.full_like(typical, FACE_CALM)
    weight[head] = HEAD_CALM
    scale = (typical[index] / unit).clamp(min=LEAST_ACCELERATION)
    calm = weight[index] / scale.square()
    return PoseParameterization(given, lowest, highest, index, unit, motion[:, index] / unit, calm)


def _white_noise(accelerations: Float[Tensor, "T P"]) -> Float[Tensor, " P"]:
    """Standard deviation of what comes and goes from frame to frame in a motion with these second differences.

    From the fourth differences, in which smooth motion hardly shows and whose variance is 1 + 16 + 36 + 16 + 1 times that
    of white noise; by the median of their absolute values, so that quick movements do not count as noise.
    """
    if len(accelerations) < 3:
        return accelerations.new_zeros(accelerations.shape[1])
    fourth = accelerations[2:] - 2.0 * accelerations[1:-1] + accelerations[:-2]
    return 1.4826 * fourth.abs().median(dim=0).values / math.sqrt(70.0)
