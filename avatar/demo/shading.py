"""What each material does with the light: linear RGB [N, 3] for the pixels of one material at a time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from avatar.demo import lighting
from avatar.demo.lighting import FILL_COLOUR, KEY_COLOUR, RIM_COLOUR, Lights, along, lookup, turn, unit
from avatar.demo.mesh import EYE_RADIUS

SKIN_WRAP = np.array([0.42, 0.20, 0.13], np.float32)
_CLOTH_WRAP = np.array([0.25, 0.25, 0.25], np.float32)
IRIS_EDGE = 0.455  # sine of the iris' angle on the eyeball


class Surface(NamedTuple):
    """The N pixels of a material; float32, the studio's axes."""

    normals: np.ndarray  # [N, 3]
    view: np.ndarray  # [N, 3] unit, towards the camera
    occlusion: np.ndarray  # [N] share of the sky that is seen
    colours: np.ndarray  # [N, 3] of the vertices
    lit: np.ndarray  # [N] share of the key light that arrives


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("nc,nc->n", a, b)


def _three_lights(normals: np.ndarray, lights: Lights, wrap: np.ndarray, key_share: np.ndarray) -> np.ndarray:
    total = lighting.wrapped(normals, lights.key, wrap) * (KEY_COLOUR * key_share)
    total += lighting.wrapped(normals, lights.fill, wrap) * FILL_COLOUR
    total += lighting.wrapped(normals, lights.rim, wrap) * RIM_COLOUR
    return total


def _mirrored(normals: np.ndarray, view: np.ndarray, lights: Lights, f0: float, most: float) -> np.ndarray:
    facing = np.clip(_dot(view, normals), 0.0, 1.0)
    fresnel = np.minimum(f0 + (1.0 - f0) * (1.0 - facing) ** 5, most)
    reflected = 2.0 * facing[:, None] * normals - view
    return lighting.mirror_world(reflected, lights) * fresnel[:, None]


def skin(s: Surface, lights: Lights, colour_gloss: np.ndarray, relief: np.ndarray, gradients: np.ndarray) -> np.ndarray:
    """Skin: `colour_gloss` [N, 4]; `relief` [N, 2] slopes dh/du, dh/dv; `gradients` [N, 6] of u and v over the surface."""
    fine = unit(s.normals - relief[:, :1] * gradients[:, :3] - relief[:, 1:] * gradients[:, 3:])
    soft = unit(0.45 * s.normals + 0.55 * fine)  # light that enters the skin blurs its fine relief
    # Red light leaks into the edges of cast shadows and into creases.
    share = np.stack((s.lit**0.65, s.lit**0.9, s.lit), -1)
    open_sky = s.occlusion[:, None] ** np.array([0.7, 1.0, 1.1], np.float32)
    diffuse = _three_lights(soft, lights, SKIN_WRAP, share * (0.45 + 0.55 * open_sky) / np.maximum(open_sky, 0.05))
    sky = lighting.ambient(soft)
    diffuse = (diffuse + sky) * open_sky
    lobes = 0.65 * lighting.gloss(fine, s.view, lights.key, 0.46, 0.04)
    lobes += 0.35 * lighting.gloss(fine, s.view, lights.key, 0.28, 0.04)
    shine = (lobes * s.lit)[:, None] * KEY_COLOUR
    shine += lighting.gloss(fine, s.view, lights.fill, 0.45, 0.04)[:, None] * FILL_COLOUR
    shine += lighting.gloss(fine, s.view, lights.rim, 0.50, 0.04)[:, None] * RIM_COLOUR
    sheen = 0.14 * (1.0 - np.clip(_dot(fine, s.view), 0.0, 1.0)) ** 4
    shine += sheen[:, None] * sky
    return colour_gloss[:, :3] * diffuse + (1.35 * colour_gloss[:, 3] * s.occlusion)[:, None] * shine


_CROWN = np.array([0.0, 0.94, -0.34], np.float32)  # where the hair's whorl is, from the middle of the skull
_SKULL = np.array([0.0, 52.0, -16.0], np.float32)


def strand_pattern(tile: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Strands [N] at places [N, 3] (millimetres) of the head at rest: a periodic tile laid out from the crown."""
    d = unit(rest - _SKULL)
    side = np.array([1.0, 0.0, 0.0], np.float32)
    ahead = np.cross(side, _CROWN)
    x, z, up = turn(d, np.stack((side, ahead, _CROWN))).T
    around = np.arctan2(x, z) / (2 * np.pi)
    away = np.arccos(np.clip(up, -1.0, 1.0))
    size = tile.shape[0]
    wave = 0.004 * np.sin(9.0 * away + 40.0 * around)
    at = np.stack(((around + wave) * 3 * size, away * 0.55 * size), -1) % size
    return lookup(np.pad(tile, ((0, 1), (0, 1)), mode="wrap"), at)[:, 0]


def hair(s: Surface, lights: Lights, strands: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """Hair along `strands` [N, 3] with light and dark ones by `pattern` [N].

    Source: Kajiya, Kay, "Rendering fur with three dimensional textures" (1989).
    """
    s = s._replace(colours=s.colours * np.clip(1.0 + 0.30 * pattern, 0.25, 2.0)[:, None])
    strand = unit(strands - _dot(strands, s.normals)[:, None] * s.normals)
    out = s.colours * lighting.ambient(s.normals) * s.occlusion[:, None]
    jitter = 0.16 * pattern
    bent = unit(strand + jitter[:, None] * s.normals)
    tint = (0.018 + 0.5 * s.colours) * np.clip(1.0 + 0.5 * pattern, 0.0, 2.2)[:, None]
    for light, colour, lit in (
        (lights.key, KEY_COLOUR, s.lit),
        (lights.fill, FILL_COLOUR, np.float32(1.0)),
        (lights.rim, RIM_COLOUR, np.float32(1.0)),
    ):
        across = np.sqrt(np.maximum(1.0 - along(strand, light) ** 2, 0.0))
        front = np.clip(along(s.normals, light) * 0.75 + 0.25, 0.0, 1.0) * lit
        shine = np.maximum(1.0 - _dot(bent, unit(s.view + light)) ** 2, 0.0) ** 30
        out += (front * across * 0.8)[:, None] * colour * s.colours
        out += (front * shine * s.occlusion * 0.45)[:, None] * colour * tint
    return out


def eye(s: Surface, lights: Lights, iris: np.ndarray, eye_turn: np.ndarray, lid_shadow: np.ndarray) -> np.ndarray:
    """Eyeball with its colour map `iris`; `eye_turn` [3, 3] eyeball to studio; `lid_shadow` [N] from the lids."""
    outward = turn(s.normals, eye_turn.T)  # in the eyeball's own axes; the pupil is at +z
    edge = np.hypot(outward[:, 0], outward[:, 1])
    on_iris = np.clip((0.51 - edge) / 0.06, 0.0, 1.0) * (outward[:, 2] > 0)
    # The cornea is a smaller sphere that stands out of the eyeball; the iris lies behind it.
    own_view = turn(s.view, eye_turn.T)
    behind = np.clip(np.sqrt(np.maximum(1.0 - edge**2, 0.0)) - np.sqrt(1 - IRIS_EDGE**2), 0.0, 0.12) * on_iris
    at = outward[:, :2] - (1.1 * behind)[:, None] * own_view[:, :2] / np.maximum(own_view[:, 2:], 0.35)
    colour = lookup(iris, np.stack((at[:, 0] + 1, 1 - at[:, 1]), -1) * (iris.shape[0] / 2) - 0.5)
    cornea = unit(outward * np.float32(EYE_RADIUS) - np.array([0.0, 0.0, 5.6], np.float32))
    wet = turn(unit(cornea * on_iris[:, None] + outward * (1 - on_iris[:, None])), eye_turn)
    diffuse = _three_lights(s.normals, lights, SKIN_WRAP, (0.25 + 0.75 * s.lit)[:, None])
    diffuse += 0.9 * lighting.ambient(s.normals)
    tinted = lid_shadow[:, None] ** np.array([0.85, 1.0, 1.05], np.float32)
    mirror = _mirrored(wet, s.view, lights, 0.03, 0.35) * lid_shadow[:, None]
    return colour * diffuse * tinted + 1.5 * mirror


def mouth(s: Surface, lights: Lights) -> np.ndarray:
    """Teeth, gums, tongue and the dark behind them."""
    diffuse = lighting.wrapped(s.normals, lights.key, SKIN_WRAP) * (KEY_COLOUR * s.lit[:, None])
    diffuse += lighting.wrapped(s.normals, lights.fill, SKIN_WRAP) * FILL_COLOUR
    diffuse += lighting.ambient(s.normals)
    wet = lighting.gloss(s.normals, s.view, lights.key, 0.24, 0.05) * s.lit * np.minimum(s.colours[:, 0] * 2.0, 1.0)
    return s.colours * diffuse + 0.7 * wet[:, None] * KEY_COLOUR


def frame(s: Surface, lights: Lights) -> np.ndarray:
    """The polished frame of the glasses."""
    direct = np.maximum(along(s.normals, lights.key), 0.0)[:, None] * KEY_COLOUR * s.lit[:, None]
    return s.colours * (lighting.ambient(s.normals) + direct) + _mirrored(s.normals, s.view, lights, 0.05, 0.6)


def lens(behind: np.ndarray, normals: np.ndarray, view: np.ndarray, lights: Lights) -> np.ndarray:
    """A thin lens over the light [N, 3] from behind it: a little absorbed, and the room mirrored on top."""
    facing = np.clip(_dot(view, normals), 0.05, 1.0)
    fresnel = 0.06 + 0.94 * (1.0 - facing) ** 5
    mirror = lighting.mirror_world(2.0 * facing[:, None] * normals - view, lights)
    return behind * (0.96 - fresnel)[:, None] + 0.6 * mirror * np.minimum(fresnel, 0.5)[:, None]


def cloth(s: Surface, lights: Lights) -> np.ndarray:
    """Cotton: matte, with a little sheen at grazing angles."""
    light = _three_lights(s.normals, lights, _CLOTH_WRAP, s.lit[:, None]) + lighting.ambient(s.normals)
    sheen = 0.05 * (1.0 - np.clip(_dot(s.view, s.normals), 0.0, 1.0)) ** 3
    return (s.colours * light + sheen[:, None] * lighting.ambient(s.normals)) * s.occlusion[:, None]
