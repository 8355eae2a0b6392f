"""Who the demo subject is: face shape, skin, hair, eyes, glasses, clothes and light, all drawn from one seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avatar.demo.blendshape_fields import IDENTITY_NAMES

# Skin, hair and eye colours in linear RGB: skin from pale to dark, each with the lips that go with it.
_SKIN = np.array([[0.70, 0.46, 0.37], [0.62, 0.38, 0.28], [0.52, 0.30, 0.20], [0.38, 0.20, 0.12], [0.22, 0.11, 0.065]])
_LIPS = np.array(
    [[0.46, 0.135, 0.13], [0.40, 0.12, 0.105], [0.33, 0.10, 0.085], [0.26, 0.085, 0.075], [0.16, 0.06, 0.055]]
)
_HAIR = np.array(
    [
        [0.012, 0.009, 0.008],
        [0.035, 0.018, 0.010],
        [0.085, 0.042, 0.020],
        [0.20, 0.10, 0.040],
        [0.33, 0.20, 0.09],
        [0.20, 0.055, 0.020],
        [0.24, 0.23, 0.22],
    ]
)
_IRIS = np.array(
    [[0.055, 0.024, 0.010], [0.10, 0.045, 0.017], [0.07, 0.075, 0.03], [0.045, 0.095, 0.15], [0.085, 0.125, 0.14]]
)
_SHIRT = np.array([[0.035, 0.11, 0.18], [0.34, 0.05, 0.045], [0.05, 0.11, 0.07], [0.22, 0.22, 0.21], [0.09, 0.05, 0.13],
                   [0.36, 0.22, 0.07], [0.06, 0.065, 0.08]])  # fmt: skip


@dataclass(frozen=True)
class Identity:
    """One person in one place; colours are linear RGB [3]."""

    seed: int
    shape: np.ndarray  # float32 [300], FLAME's identity slots
    skin_colour: np.ndarray
    lip_colour: np.ndarray
    hair_colour: np.ndarray
    iris_colour: np.ndarray
    shirt_colour: np.ndarray
    background: np.ndarray
    frame_colour: np.ndarray
    glasses: bool
    glasses_roundness: float  # exponent of the superellipse: 2 an ellipse, 5 nearly a rectangle
    hair_length: float  # metres that the hair stands off the scalp on top
    hair_parting: float  # metres along x of the parting
    hairline: float  # metres that the hairline is lower (+) or higher (-) than usual
    brow_density: float  # 0 to 1
    freckles: float  # 0 none to 1 many
    stubble: float  # 0 none to 1 dark
    key_side: float  # direction of the key light, -1 from the image's left to 1 from its right


def sample_identity(seed: int) -> Identity:
    """The person that belongs to a seed."""
    rng = np.random.default_rng((seed, 1))
    names = IDENTITY_NAMES
    shape = np.zeros(300, np.float32)
    shape[: len(names)] = np.clip(rng.normal(0.0, 0.75, len(names)), -1.6, 1.6)
    tone = rng.beta(1.1, 1.5) * (len(_SKIN) - 1)
    base, part = min(int(tone), len(_SKIN) - 2), tone - min(int(tone), len(_SKIN) - 2)
    skin = (1 - part) * _SKIN[base] + part * _SKIN[base + 1]
    lips = (1 - part) * _LIPS[base] + part * _LIPS[base + 1]
    fair = tone < 2.0
    hair = _HAIR[rng.integers(0, len(_HAIR) if fair else 3)]
    iris = _IRIS[rng.integers(0, len(_IRIS) if fair else 2)]
    masculine = rng.random()
    shape[names.index("jaw_width")] += 1.0 * (masculine - 0.5)
    shape[names.index("brow_ridge")] += 1.2 * (masculine - 0.5)
    shape[names.index("lip_fullness")] += 0.9 * (0.5 - masculine) + 0.25 * tone
    shape[names.index("nose_width")] += 0.3 * tone
    shape[names.index("neck_girth")] += 1.6 * (masculine - 0.6)
    return Identity(
        seed=seed,
        shape=shape,
        skin_colour=skin * rng.uniform(0.93, 1.07),
        lip_colour=lips * rng.uniform(0.9, 1.15),
        hair_colour=hair * rng.uniform(0.8, 1.25),
        iris_colour=iris * rng.uniform(0.8, 1.2),
        shirt_colour=_SHIRT[rng.integers(0, len(_SHIRT))] * rng.uniform(0.8, 1.2),
        background=np.array([0.20, 0.21, 0.22]) * rng.uniform(0.5, 1.3) * (1 + 0.12 * rng.uniform(-1, 1, 3)),
        frame_colour=np.array([[0.012, 0.012, 0.014], [0.10, 0.035, 0.012], [0.015, 0.03, 0.07]])[rng.integers(0, 3)],
        glasses=bool(rng.random() < 0.55),
        glasses_roundness=float(rng.uniform(2.2, 4.5)),
        hair_length=float(rng.uniform(0.006, 0.022)),
        hair_parting=float(rng.uniform(-0.035, 0.035)),
        hairline=float(rng.uniform(-0.007, 0.005)),
        brow_density=float(0.55 + 0.45 * rng.random()),
        freckles=float(max(0.0, rng.uniform(-0.8, 1.0)) if fair else 0.0),
        stubble=float(max(0.0, masculine - 0.55) * 1.6),
        key_side=float(rng.choice([-1.0, 1.0]) * rng.uniform(0.55, 1.0)),
    )
