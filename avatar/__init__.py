"""Animatable 3D Gaussian head avatars from one tracked video."""

import os

__version__ = "0.1.0"

# After every operation torch's OpenMP threads wait for the next one in a busy loop, for milliseconds, on the cores that the
# splatter's own threads want; where anything else runs, that loop is what makes a step ten times slower. Torch's GNU
# OpenMP reads this once, when torch is loaded, so it has no effect on a program that has imported torch before.
os.environ.setdefault("GOMP_SPINCOUNT", "1000")
