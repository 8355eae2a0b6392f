"""Animatable 3D Gaussian head avatars from one tracked video."""

__version__ = "0.1.0"
