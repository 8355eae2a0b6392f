"""Tracking made sharper by the avatar itself: each frame's head parameters are moved until the avatar's picture fits.

`motion` says what may move, `likeness` how well a picture fits, `descent` and `smoothing` find the best motion,
`refine` does a whole subject, and `subject` writes it as a tracked folder.
"""
