"""Tracking made sharper by the avatar itself: each frame's head parameters are moved until the avatar's picture fits.

`refine` does a whole subject, by `avatar.tracking`, `smoothing` ties neighbouring frames, and `record` says what changed.
"""
