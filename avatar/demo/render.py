"""The true image of a demo person: z-buffer, deferred shading, box-filtered supersampling.

Shading runs in the studio's axes (x right, y up, z towards the front camera), in which the lights are fixed.
`render_frame` is a function of the person, FLAME parameters and camera alone, so the truth of a cross-reenactment (one
person performing another's parameters) can be computed as well.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
import torch

from avatar.demo import lighting, loose_hair, scene, shading
from avatar.demo.identity import Identity, sample_identity
from avatar.demo.mesh import EYE_RADIUS
from avatar.demo.occlusion import ambient_occlusion
from avatar.demo.pixels import Pixels, covered, to_screen
from avatar.demo.skin import bake_skin, paint_iris, strand_tile
from avatar.head.rasterize import MeshRaster, rasterize_mesh
from avatar.types import Camera, HeadParams

SUPERSAMPLE = 2
TEXTURE_SIZE = 768
BODY_SHARE = 0.35  # share of the head's turn that the shoulders follow
VIEW_AXES = np.diag([1.0, -1.0, -1.0]).astype(np.float32)  # OpenCV camera axes <-> x right, y up, z to the camera
SCENE_CENTRE = np.array([0.0, -0.03, 0.0], np.float32)  # of the shadow map, head space, metres
_MAP_SCALE = lighting.SHADOW_SIZE / lighting.SHADOW_REACH
_ON_MAP = np.array([_MAP_SCALE, _MAP_SCALE, 1.0], np.float32)
_MAP_CENTRE = np.array([lighting.SHADOW_SIZE / 2, lighting.SHADOW_SIZE / 2, 0.0], np.float32)
_WRINKLED_BY = (("brow_inner_up", "brow_outer_up"), ("brow_down",), ("smile", "cheek_up", "sneer"))


class RenderedFrame(NamedTuple):
    """uint8; `image` [H, W, 3] is sRGB over the person's background, the masks [H, W] are coverage times 255."""

    image: np.ndarray
    alpha: np.ndarray  # everything but the background
    head: np.ndarray  # head, neck, hair, glasses
    mouth: np.ndarray  # lips and what is seen between them


class PosedScene(NamedTuple):
    """A person posed in the studio: what all cameras share. Vertex values are in the studio's axes."""

    params: HeadParams
    geometry: scene.Geometry  # in the head's space
    R_studio_head: np.ndarray  # float32 [3, 3]
    t_studio_head: np.ndarray  # float32 [3]
    surface: np.ndarray  # [N, 7] normal, occlusion, colour
    skin_slopes: np.ndarray  # [V, 6] gradients of u and v
    strands: np.ndarray  # [H, 3] directions of the hair
    shadow_map: np.ndarray  # of the key light


class Renderer:
    """Renders one person, with loose hair where asked to. Baking the textures takes some seconds, a frame then about a
    tenth of one."""

    def __init__(self, identity: Identity, has_loose_hair: bool = False) -> None:
        self.identity = identity
        self.performer = performer = scene.Performer(identity)
        self.lights = lighting.make_lights(identity.key_side)
        self.skin = bake_skin(performer.head, identity, TEXTURE_SIZE)
        self._relief = (self.skin.relief[..., :4].copy(), self.skin.relief[..., 4:].copy())
        self.iris = paint_iris(identity)
        self._strands = strand_tile(identity.seed)
        self._loose = loose_hair.LooseHair(performer) if has_loose_hair else None
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
        """The picture of this person with FLAME parameters `params` (metres, radians as 6D) from `camera`.

        The camera's world is the head's space, and the studio stands still around the camera.
        """
        R_studio_head = VIEW_AXES @ camera.R_cam_world.numpy().astype(np.float32)
        t_studio_head = VIEW_AXES @ camera.t_cam_world.numpy().astype(np.float32)
        in_front = replace(camera, R_cam_world=torch.from_numpy(VIEW_AXES), t_cam_world=torch.zeros(3))
        return self.render_scene(self.pose_scene(params, R_studio_head, t_studio_head), in_front)

    def pose_scene(self, params: HeadParams, R_studio_head: np.ndarray, t_studio_head: np.ndarray) -> PosedScene:
        """The person with FLAME parameters `params` and the head's float32 pose in the studio."""
        performer = self.performer
        geometry = performer.pose(params, _partial_turn(R_studio_head.T, 1.0 - BODY_SHARE))
        slopes = (lighting.turn(slopes, R_studio_head) for slopes in (performer.slopes_u, performer.slopes_v))
        return PosedScene(
            params=params,
            geometry=geometry,
            R_studio_head=R_studio_head,
            t_studio_head=t_studio_head,
            surface=np.concatenate(
                (lighting.turn(geometry.normals, R_studio_head), self._occlusion[:, None], performer.colours), -1
            ),
            skin_slopes=np.concatenate(tuple(slopes), -1),
            strands=lighting.turn(performer.strands, R_studio_head),
            shadow_map=self._shadow_map(geometry, R_studio_head),
        )

    def render_scene(self, posed: PosedScene, camera: Camera) -> RenderedFrame:
        """The picture of a scene from `camera`, whose world is the studio."""
        big = camera.resized(SUPERSAMPLE * camera.width, SUPERSAMPLE * camera.height)
        R_view_studio = VIEW_AXES @ camera.R_cam_world.numpy().astype(np.float32)
        t_view_studio = VIEW_AXES @ camera.t_cam_world.numpy().astype(np.float32)
        R_view = R_view_studio @ posed.R_studio_head
        t_view = R_view_studio @ posed.t_studio_head + t_view_studio
        geometry = posed.geometry
        raster = rasterize_mesh(
            to_screen(geometry.points, R_view, t_view, big), self.performer.faces, big.height, big.width
        )
        pixels = covered(raster, self.performer.faces, big, R_view_studio)
        depth = raster.depth[pixels.row, pixels.column]
        lit = self._key_share(posed, pixels.ray * depth[:, None] - R_view_studio.T @ t_view_studio)

        attributes = pixels.interpolate(posed.surface)
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
            colour[at] = self._shade(int(kind), surface, pixels.take(at), posed)
        if len(geometry.lens_points):
            lenses = to_screen(geometry.lens_points, R_view, t_view, big)
            front = rasterize_mesh(lenses, self.performer.lenses.faces, big.height, big.width)
            self._add_lenses(colour, front, pixels, depth, whole.view, posed)
        if self._loose is None:
            return self._to_picture(colour, material, pixels, camera, None)
        at = self._loose.points(geometry.points)
        flat, R = at.reshape(-1, 3), posed.R_studio_head
        ahead = lighting.turn(lighting.turn(flat, R_view) + t_view, R_view_studio.T)  # from the camera
        lit = self._key_share(posed, ahead - R_view_studio.T @ t_view_studio)
        placed = lighting.turn(flat, R).reshape(at.shape)
        shades = loose_hair.shade(self._loose, placed, posed.surface, -lighting.unit(ahead), lit, self.lights)
        screen = to_screen(flat, R_view, t_view, big).reshape(at.shape)
        strands = loose_hair.draw(screen, self._loose.widths * big.fx / screen[..., 2], shades, raster.depth)
        return self._to_picture(colour, material, pixels, camera, strands)

    def _shade(self, kind: int, surface: shading.Surface, pixels: Pixels, posed: PosedScene) -> np.ndarray:
        if kind == scene.SKIN:
            return self._shade_skin(surface, pixels, posed)
        if kind == scene.HAIR:
            corners = pixels.corners - self.performer.starts[kind]
            strands, rest = (pixels.interpolate(a, corners) for a in (posed.strands, self.performer.hair_rest))
            return shading.hair(surface, self.lights, strands, shading.strand_pattern(self._strands, rest))
        if kind in (scene.EYE_LEFT, scene.EYE_RIGHT):
            side = int(kind == scene.EYE_RIGHT)
            outward = lighting.turn(surface.normals, posed.R_studio_head.T)
            shadow = _lid_shadow(self.performer.head, posed.geometry, side, outward)
            turn = posed.R_studio_head @ posed.geometry.eye_turns[side]
            return shading.eye(surface, self.lights, self.iris, turn, shadow)
        if kind in (scene.MOUTH_UPPER, scene.MOUTH_LOWER, scene.LINING):
            return shading.mouth(surface, self.lights)
        if kind == scene.FRAME:
            return shading.frame(surface, self.lights)
        return shading.cloth(surface, self.lights)

    def _shade_skin(self, surface: shading.Surface, pixels: Pixels, posed: PosedScene) -> np.ndarray:
        texels = pixels.interpolate(self._texels, self.performer.head.mesh.uv_faces[pixels.face])
        expression = posed.params.expression.numpy()[: self._wrinkles_of.shape[1]]
        wrinkle = np.clip(self._wrinkles_of[:, : len(expression)] @ expression, 0.0, 1.2)
        low, high = (lighting.lookup(half, texels) for half in self._relief)
        relief = low[:, :2] + wrinkle[0] * low[:, 2:] + wrinkle[1] * high[:, :2] + wrinkle[2] * high[:, 2:]
        colour = lighting.lookup(self.skin.colour, texels)
        return shading.skin(surface, self.lights, colour, relief, pixels.interpolate(posed.skin_slopes))

    def _shadow_map(self, geometry: scene.Geometry, R_studio_head: np.ndarray) -> np.ndarray:
        """What the key light sees first."""
        size, basis = lighting.SHADOW_SIZE, lighting.shadow_basis(self.lights.key)
        on_map = lighting.turn(geometry.points - SCENE_CENTRE, basis @ R_studio_head) * _ON_MAP + _MAP_CENTRE
        away = np.array([0.0, 0.0, 10.0], np.float32)  # the rasteriser draws positive depths
        raster = rasterize_mesh(on_map + away, self.performer.faces, size, size)
        return lighting.blurred_shadow_map(raster.depth - away[2], raster.face_id >= 0)

    def _key_share(self, posed: PosedScene, at: np.ndarray) -> np.ndarray:
        """Share of the key light [N] at points [N, 3] of the studio."""
        centre = posed.R_studio_head @ SCENE_CENTRE + posed.t_studio_head
        on_map = lighting.turn(at - centre, lighting.shadow_basis(self.lights.key)) * _ON_MAP + _MAP_CENTRE
        return lighting.lit_share(posed.shadow_map, on_map)

    def _add_lenses(
        self,
        colour: np.ndarray,
        front: MeshRaster,
        pixels: Pixels,
        depth: np.ndarray,
        view: np.ndarray,
        posed: PosedScene,
    ) -> None:
        """Lay what the lenses, rasterised as `front`, mirror over the pixels behind them, in place."""
        faces = self.performer.lenses.faces
        face, lens_depth = front.face_id[pixels.row, pixels.column], front.depth[pixels.row, pixels.column]
        at = np.flatnonzero((face >= 0) & (lens_depth < depth))
        weights = front.barycentric[pixels.row[at], pixels.column[at]]
        normals = np.einsum("nkc,nk->nc", self.performer.lens_normals[faces[face[at]]], weights)
        normals = lighting.turn(normals, posed.R_studio_head)
        colour[at] = shading.lens(colour[at], lighting.unit(normals), view[at], self.lights)

    def _to_picture(
        self,
        colour: np.ndarray,
        material: np.ndarray,
        pixels: Pixels,
        camera: Camera,
        strands: loose_hair.Drawn | None,
    ) -> RenderedFrame:
        height, width = SUPERSAMPLE * camera.height, SUPERSAMPLE * camera.width
        canvas = _background(tuple(self.identity.background.tolist()), height, width).copy()
        canvas[pixels.row, pixels.column] = lighting.tone_map(colour)
        masks = np.zeros((height, width, 3), np.float32)
        in_mouth = np.isin(material, (scene.MOUTH_UPPER, scene.MOUTH_LOWER, scene.LINING)) | self._is_lip[pixels.face]
        everything = np.ones(len(material), bool)
        masks[pixels.row, pixels.column] = np.column_stack((everything, material != scene.SHIRT, in_mouth)) * 255.0
        if strands is not None:
            clear, at = strands.clear[..., None], (strands.row, strands.column)
            canvas[at] = canvas[at] * clear[at] + lighting.tone_map(strands.colour) * (1.0 - clear[at])
            masks = masks * clear + np.array([255.0, 255.0, 0.0], np.float32) * (1.0 - clear)
        small = (camera.width, camera.height)
        image = cv2.resize(canvas, small, interpolation=cv2.INTER_AREA)
        masks = cv2.resize(masks, small, interpolation=cv2.INTER_AREA)
        image, masks = (np.clip(np.rint(a), 0, 255).astype(np.uint8) for a in (image, masks))
        return RenderedFrame(image, *[np.ascontiguousarray(masks[..., k]) for k in range(3)])


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
def renderer_of(seed: int) -> Renderer:
    """The person of a seed; kept, since baking the textures takes seconds."""
    return Renderer(sample_identity(seed))


def render_frame(seed: int, params: HeadParams, camera: Camera) -> RenderedFrame:
    """The person of a seed performing `params`, seen by `camera`."""
    return renderer_of(seed).render(params, camera)
