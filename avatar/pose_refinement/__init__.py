"""Each frame's tracking moved until the avatar's picture of the frame fits.

`motion` says what may move, `parameterization` how far, `frame_fitter` how well a picture fits and how that changes with
each value, and `descent` finds a frame's best values. `refine` does a whole subject, `smoothing` ties neighbouring frames,
and `record` says what changed. Training moves its own frames' tracking by the same means, step by step.
"""
