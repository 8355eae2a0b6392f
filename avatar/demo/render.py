"""The true image of a demo person: z-buffer, deferred shading, box-filtered supersampling.

`render_frame` is a function of the person, FLAME parameters and camera alone, so the truth of a cross-reenactment (one
person performing another's parameters) can be computed as well.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from avatar.demo import lighting, scene, shading
from avatar.demo.identity import Identity, sample_identity
from avatar.demo.occlusion import ambient_occlusion
from avatar.demo.sculpt import EYE_RADIUS
from avatar.demo.skin import bake_skin, paint_iris, strand_tile
from avatar.head.rasterize import MeshRaster, rasterize_mesh
from avatar.types import Camera, HeadParams

SUPERSAMPLE = 2
TEXTURE_SIZE = 768
BODY_SHARE = 0.35  # share of the head's turn that the shoulders follow
VIEW_AXES = np.diag([1.0, -1.0, -1.0]).astype(np.float32)  # OpenCV camera axes <-> x right, y up, z to the camera
SCENE_CENTRE = np.array([0.0, -0.03, 0.0], np.float32)  # of the shadow map, head space, metres
_WRINKLED_BY = (("brow_inner_up", "brow_outer_up"), ("brow_down",), ("smile", "cheek_up", "sneer"))


class RenderedFrame(NamedTuple):
    """uint8; `image` [H, W, 3] is sRGB over the person's background, the masks [H, W] are coverage times 255."""

    image: np.ndarray
    alpha: np.ndarray  # everything but the background
    head: np.ndarray  # head, neck, hair, glasses
    mouth: np.ndarray  # lips and what is seen between them


class _Pixels(NamedTuple):
    """The covered pixels: which face, where in it, and from which direction they are seen."""

    row: np.ndarray
    column: np.ndarray
    face: np.ndarray  # [N]
    corners: np.ndarray  # [N, 3] vertex indices
    barycentric: np.ndarray  # [N, 3]
    ray: np.ndarray  # [N, 3] view-space direction with z = -1

    def take(self, at: np.ndarray) -> _Pixels:
        return _Pixels(*[np.take(values, at, axis=0) for values in self])

    def interpolate(self, values: np.ndarray, corners: np.ndarray | None = None) -> np.ndarray:
        """Per-vertex values [V, C] at the pixels [N, C]; other `corners` index other vertices, those of the chart say."""
        corners = self.corners if corners is None else corners
        out = np.take(values, corners[:, 0], axis=0) * self.barycentric[:, :1]
        out += np.take(values, corners[:, 1], axis=0) * self.barycentric[:, 1:2]
        out += np.take(values, corners[:, 2], axis=0) * self.barycentric[:, 2:]
        return out


class Renderer:
    """Renders one person. Baking the textures takes some seconds, a frame then about a tenth of one."""

    def __init__(self, identity: Identity) -> None:
        self.identity = identity
        self.performer = performer = scene.Performer(identity)
        self.lights = lighting.make_lights(identity.key_side)
        self.skin = bake_skin(performer.head, identity, TEXTURE_SIZE)
        self._relief = (self.skin.relief[..., :4].copy(), self.skin.relief[..., 4:].copy())
        self.iris = paint_iris(identity)
        self._strands = strand_tile(identity.seed)
        mesh = performer.head.mesh
        self._texels = np.stack((mesh.uvs[:, 0], 1.0 - mesh.uvs[:, 1]), -1).astype(np.float32) * TEXTURE_SIZE - 0.5
        on_lips = np.zeros(performer.num_points, bool)
        on_lips[mesh.mouth_rings[:, :7]] = True
        self._is_lip = np.asarray(on_lips[performer.faces].all(1))
        self._occlusion = ambient_occlusion(performer)
        names = performer.head.expression_names
        self._wrinkles_of = np.array(
            [[0.5 * name.startswith(stems) for name in names] for stems in _WRINKLED_BY], np.float32
        )

    def render(self, params: HeadParams, camera: Camera) -> RenderedFrame:
        """The picture of this person with FLAME parameters `params` (metres, radians as 6D) from `camera`."""
        big = camera.resized(SUPERSAMPLE * camera.width, SUPERSAMPLE * camera.height)
        R_view = VIEW_AXES @ camera.R_cam_world.numpy().astype(np.float32)
        t_view = VIEW_AXES @ camera.t_cam_world.numpy().astype(np.float32)
        geometry = self.performer.pose(params, _partial_turn(R_view.T, 1.0 - BODY_SHARE))
        raster = rasterize_mesh(
            _to_screen(geometry.points, R_view, t_view, big), self.performer.faces, big.height, big.width
        )
        pixels = _covered(raster, self.performer.faces, big)
        depth = raster.depth[pixels.row, pixels.column]
        lit = self._key_share(geometry, R_view, t_view, pixels.ray * depth[:, None])

        table = np.concatenate(
            (lighting.turn(geometry.normals, R_view), self._occlusion[:, None], self.performer.colours), -1
        )
        attributes = pixels.interpolate(table)
        whole = shading.Surface(
            normals=lighting.unit(attributes[:, :3]),
            view=-lighting.unit(pixels.ray),
            occlusion=attributes[:, 3],
            colours=attributes[:, 4:],
            lit=lit,
        )
        material = self.performer.materials[pixels.face]
        colour = np.empty((len(material), 3), np.float32)
        for kind in np.unique(material):
            at = np.flatnonzero(material == kind)
            surface = shading.Surface(*[np.take(values, at, axis=0) for values in whole])
            colour[at] = self._shade(int(kind), surface, pixels.take(at), geometry, R_view, params)
        if len(geometry.lens_points):
            self._add_lenses(colour, geometry, pixels, depth, whole.view, R_view, t_view, big)
        return self._develop(colour, material, pixels, camera)

    def _shade(
        self,
        kind: int,
        surface: shading.Surface,
        pixels: _Pixels,
        geometry: scene.Geometry,
        R_view: np.ndarray,
        params: HeadParams,
    ) -> np.ndarray:
        if kind == scene.SKIN:
            return self._shade_skin(surface, pixels, R_view, params)
        if kind == scene.HAIR:
            strands = pixels.interpolate(
                lighting.turn(self.performer.strands, R_view), pixels.corners - self.performer.starts[kind]
            )
            rest = pixels.interpolate(self.performer.hair_rest, pixels.corners - self.performer.starts[kind])
            return shading.hair(surface, self.lights, strands, shading.strand_pattern(self._strands, rest))
        if kind in (scene.EYE_LEFT, scene.EYE_RIGHT):
            side = int(kind == scene.EYE_RIGHT)
            shadow = _lid_shadow(self.performer.head, geometry, side, lighting.turn(surface.normals, R_view.T))
            return shading.eye(surface, self.lights, self.iris, R_view @ geometry.eye_turns[side], shadow)
        if kind in (scene.MOUTH_UPPER, scene.MOUTH_LOWER, scene.LINING):
            return shading.mouth(surface, self.lights)
        if kind == scene.FRAME:
            return shading.frame(surface, self.lights)
        return shading.cloth(surface, self.lights)

    def _shade_skin(
        self, surface: shading.Surface, pixels: _Pixels, R_view: np.ndarray, params: HeadParams
    ) -> np.ndarray:
        performer = self.performer
        texels = pixels.interpolate(self._texels, performer.head.mesh.uv_faces[pixels.face])
        expression = params.expression.numpy()[: self._wrinkles_of.shape[1]]
        wrinkle = np.clip(self._wrinkles_of[:, : len(expression)] @ expression, 0.0, 1.2)
        low, high = (lighting.lookup(half, texels) for half in self._relief)
        relief = low[:, :2] + wrinkle[0] * low[:, 2:] + wrinkle[1] * high[:, :2] + wrinkle[2] * high[:, 2:]
        gradients = np.concatenate(
            (lighting.turn(performer.slopes_u, R_view), lighting.turn(performer.slopes_v, R_view)), -1
        )
        colour = lighting.lookup(self.skin.colour, texels)
        return shading.skin(surface, self.lights, colour, relief, pixels.interpolate(gradients))

    def _key_share(
        self, geometry: scene.Geometry, R_view: np.ndarray, t_view: np.ndarray, at: np.ndarray
    ) -> np.ndarray:
        """Share of the key light [N] at view-space points [N, 3], by a shadow map seen from the light."""
        basis = lighting.shadow_basis(self.lights.key)
        size = lighting.SHADOW_SIZE
        scale = np.array([size / lighting.SHADOW_REACH, size / lighting.SHADOW_REACH, 1.0], np.float32)
        shift = np.array([size / 2, size / 2, 0.0], np.float32)
        on_map = lighting.turn(geometry.points - SCENE_CENTRE, basis @ R_view) * scale + shift
        away = np.array([0.0, 0.0, 10.0], np.float32)  # the rasteriser draws positive depths
        raster = rasterize_mesh(on_map + away, self.performer.faces, size, size)
        shadow_map = lighting.blurred_shadow_map(raster.depth - away[2], raster.face_id >= 0)
        centre = R_view @ SCENE_CENTRE + t_view
        return lighting.lit_share(shadow_map, lighting.turn(at - centre, basis) * scale + shift)

    def _add_lenses(
        self,
        colour: np.ndarray,
        geometry: scene.Geometry,
        pixels: _Pixels,
        depth: np.ndarray,
        view: np.ndarray,
        R_view: np.ndarray,
        t_view: np.ndarray,
        big: Camera,
    ) -> None:
        """Lay what the lenses mirror over the pixels behind them, in place."""
        faces = self.performer.lenses.faces
        front = rasterize_mesh(_to_screen(geometry.lens_points, R_view, t_view, big), faces, big.height, big.width)
        face, lens_depth = front.face_id[pixels.row, pixels.column], front.depth[pixels.row, pixels.column]
        at = np.flatnonzero((face >= 0) & (lens_depth < depth))
        weights = front.barycentric[pixels.row[at], pixels.column[at]]
        normals = np.einsum("nkc,nk->nc", self.performer.lens_normals[faces[face[at]]], weights)
        normals = lighting.turn(normals, R_view)
        colour[at] = shading.lens(colour[at], lighting.unit(normals), view[at], self.lights)

    def _develop(self, colour: np.ndarray, material: np.ndarray, pixels: _Pixels, camera: Camera) -> RenderedFrame:
        height, width = SUPERSAMPLE * camera.height, SUPERSAMPLE * camera.width
        canvas = _background(tuple(self.identity.background.tolist()), height, width).copy()
        canvas[pixels.row, pixels.column] = lighting.tone_map(colour)
        masks = np.zeros((height, width, 3), np.float32)
        in_mouth = np.isin(material, (scene.MOUTH_UPPER, scene.MOUTH_LOWER, scene.LINING)) | self._is_lip[pixels.face]
        everything = np.ones(len(material), bool)
        masks[pixels.row, pixels.column] = np.column_stack((everything, material != scene.SHIRT, in_mouth)) * 255.0
        small = (camera.width, camera.height)
        image = cv2.resize(canvas, small, interpolation=cv2.INTER_AREA)
        masks = cv2.resize(masks, small, interpolation=cv2.INTER_AREA)
        image, masks = (np.clip(np.rint(a), 0, 255).astype(np.uint8) for a in (image, masks))
        return RenderedFrame(image, *[np.ascontiguousarray(masks[..., k]) for k in range(3)])


def _to_screen(points: np.ndarray, R_view: np.ndarray, t_view: np.ndarray, camera: Camera) -> np.ndarray:
    p = lighting.turn(points, R_view) + t_view
    depth = -p[:, 2]
    return np.stack((p[:, 0] / depth * camera.fx + camera.cx, -p[:, 1] / depth * camera.fy + camera.cy, depth), -1)


def _covered(raster: MeshRaster, faces: np.ndarray, camera: Camera) -> _Pixels:
    row, column = np.nonzero(raster.face_id >= 0)
    face = raster.face_id[row, column]
    ray = np.empty((len(row), 3), np.float32)
    ray[:, 0] = (column + 0.5 - camera.cx) / camera.fx
    ray[:, 1] = -(row + 0.5 - camera.cy) / camera.fy
    ray[:, 2] = -1.0
    return _Pixels(row, column, face, faces[face], raster.barycentric[row, column], ray)


def _partial_turn(R: np.ndarray, share: float) -> np.ndarray:
    """The rotation about the same axis by a share of the angle."""
    axis_angle, _ = cv2.Rodrigues(R.astype(np.float64))
    return cv2.Rodrigues(axis_angle * share)[0].astype(np.float32)


def _lid_shadow(head: scene.DemoHead, geometry: scene.Geometry, side: int, outward: np.ndarray) -> np.ndarray:
    """Darkening [N] of the eyeball under the posed lids, at directions [N, 3] from its centre in head space."""
    ring = head.mesh.eye_rings[side, 0]
    margin = geometry.points[ring] - geometry.eye_centres[side]
    x, y = outward[:, 0] * (EYE_RADIUS * 1e-3), outward[:, 1] * (EYE_RADIUS * 1e-3)
    half = len(ring) // 2

    def height(line: np.ndarray) -> np.ndarray:
        order = np.argsort(line[:, 0])
        return np.interp(x, line[order, 0], line[order, 1])

    below_upper = height(margin[: half + 1]) - y
    above_lower = y - height(margin[np.r_[half : len(ring), 0]])
    shade = 0.36 + 0.64 * np.clip(below_upper / 0.0042, 0.0, 1.0) ** 0.8
    shade *= 0.72 + 0.28 * np.clip(above_lower / 0.0022, 0.0, 1.0)
    corner = np.clip((0.0138 - np.abs(x)) / 0.006, 0.0, 1.0)
    return (shade * (0.55 + 0.45 * corner)).astype(np.float32)


@lru_cache(maxsize=4)
def _background(wall_colour: tuple[float, float, float], height: int, width: int) -> np.ndarray:
    """A wall that is lighter behind the head, sRGB [H, W, 3] in 0 to 255."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    glow = np.exp(-((x / width - 0.5) ** 2 + (y / height - 0.35) ** 2) / 0.45)
    wall = (0.35 + 0.65 * glow)[..., None] * np.array(wall_colour)
    return lighting.tone_map(wall.reshape(-1, 3)).reshape(height, width, 3)


def background_of(identity: Identity, height: int, width: int) -> np.ndarray:
    """What lies behind the person, float32 [H, W, 3], levels of 255."""
    large = _background(tuple(identity.background.tolist()), SUPERSAMPLE * height, SUPERSAMPLE * width)
    return cv2.resize(large, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)


@lru_cache(maxsize=2)
def _renderer(seed: int) -> Renderer:
    return Renderer(sample_identity(seed))


def render_frame(seed: int, params: HeadParams, camera: Camera) -> RenderedFrame:
    """The person of a seed performing `params`, seen by `camera`; the person's textures are kept for the next call."""
    return _renderer(seed).render(params, camera)
