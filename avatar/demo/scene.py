"""The meshes of one person in one frame: the posed head, its hair, and what only the renderer has."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import csr_matrix

from avatar.demo.accessories import Prop, glasses_frame, glasses_lenses, grid_faces, lower_mouth, shirt, upper_mouth
from avatar.demo.blendshape_fields import identity_displacement, smooth_step
from avatar.demo.head import JOINTS, NUM_EXPRESSION, PARENTS, DemoHead, demo_head
from avatar.demo.identity import Identity
from avatar.demo.skin import fractal_noise, hair_cover
from avatar.head.assets import HeadAssets
from avatar.head.model import HeadModel, matrix_from_6d
from avatar.types import HeadParams

SKIN, EYE_LEFT, EYE_RIGHT, MOUTH_UPPER, MOUTH_LOWER, LINING, HAIR, FRAME, SHIRT = range(9)
LINING_COLOUR = np.array([0.09, 0.022, 0.018], np.float32)
LINING_REACH = np.array([0.0, 0.0, -0.026], np.float32)  # metres


def head_assets(head: DemoHead) -> HeadAssets:
    """The demo head as the program's own head assets, in memory (without the file's fingerprint)."""
    pad = NUM_EXPRESSION - head.expression_dirs.shape[2]
    return HeadAssets(
        template=torch.from_numpy(head.template),
        faces=torch.from_numpy(head.mesh.faces.astype(np.int64)),
        shape_dirs=torch.from_numpy(head.identity_dirs),
        expression_dirs=torch.from_numpy(np.pad(head.expression_dirs, ((0, 0), (0, 0), (0, pad)))),
        pose_dirs=torch.from_numpy(head.pose_dirs),
        joint_regressor=torch.from_numpy(head.joint_regressor),
        weights=torch.from_numpy(head.weights),
        parents=PARENTS,
        eyelid_dirs=torch.from_numpy(head.eyelid_dirs),
        uvs=torch.from_numpy(head.mesh.uvs.astype(np.float32)),
        uv_faces=torch.from_numpy(head.mesh.uv_faces.astype(np.int64)),
        regions={k: torch.from_numpy(v.astype(np.int64)) for k, v in head.regions.items()},
        fingerprint="",
    )


class Geometry(NamedTuple):
    """All opaque meshes of a frame in the head's space, metres."""

    points: np.ndarray  # float32 [N, 3]
    normals: np.ndarray  # float32 [N, 3], unit
    lens_points: np.ndarray  # float32 [L, 3], empty without glasses
    eye_turns: np.ndarray  # float32 [2, 3, 3] eyeball to head rotations
    eye_centres: np.ndarray  # float32 [2, 3]


def _vertex_normal_operator(faces: np.ndarray, count: int) -> csr_matrix:
    rows = faces.reshape(-1)
    columns = np.repeat(np.arange(len(faces)), 3)
    return csr_matrix((np.ones(len(rows), np.float32), (rows, columns)), shape=(count, len(faces)))


def face_normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Normals [F, 3], as long as twice the area."""
    a, b, c = points[faces[:, 0]], points[faces[:, 1]], points[faces[:, 2]]
    return np.cross(b - a, c - a)


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)


class Performer:
    """One person, ready to be posed. The topology is fixed: only points and normals change from frame to frame."""

    def __init__(self, identity: Identity) -> None:
        self.identity = identity
        self.head = head = demo_head()
        self.model = HeadModel(head_assets(head), torch.from_numpy(identity.shape[: head.identity_dirs.shape[2]]))
        self.head_faces = head.mesh.faces
        self._neutral = self.model.neutral_vertices().numpy()
        self._joints = head.joint_regressor @ self._neutral
        V = len(self._neutral)
        self._normals_of = _vertex_normal_operator(self.head_faces, V)
        self._chart_slopes()
        self.props = {MOUTH_UPPER: self._fitted(upper_mouth()), MOUTH_LOWER: self._fitted(lower_mouth())}
        if identity.glasses:
            self.props[FRAME] = self._fitted(glasses_frame(identity))
            self.lenses = self._fitted(glasses_lenses(identity))
        else:
            self.lenses = Prop(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))
        self.props[SHIRT] = self._fitted(shirt(identity))
        self._hair_shell()
        self._inner_lips = np.concatenate((head.mesh.mouth_rings[0, 0], head.mesh.mouth_rings[1, 0, -2:0:-1]))
        self._assemble()

    def _fitted(self, prop: Prop) -> Prop:
        """A prop of the generic head in millimetres -> of this person in metres."""
        points = prop.points * 1e-3
        moved = points + identity_displacement(points) @ self.identity.shape[: self.head.identity_dirs.shape[2]].astype(
            np.float64
        )
        return Prop(moved.astype(np.float32), prop.faces.astype(np.int32), prop.colours.astype(np.float32))

    def _chart_slopes(self) -> None:
        """Per-vertex gradients of u and v over the neutral surface, from the faces' own (exact for linear functions)."""
        mesh = self.head.mesh
        p, uv = self._neutral[mesh.faces], mesh.uvs[mesh.uv_faces]
        e1, e2 = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
        n = np.cross(e1, e2)
        area2 = np.maximum((n**2).sum(-1, keepdims=True), 1e-18)
        d1, d2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
        g1, g2 = np.cross(e2, n) / area2, np.cross(n, e1) / area2
        weight = np.sqrt(area2)
        total = self._normals_of @ np.concatenate((weight * (d1[:, :1] * g1 + d2[:, :1] * g2),
                                                   weight * (d1[:, 1:] * g1 + d2[:, 1:] * g2), weight), -1)  # fmt: skip
        self.slopes_u = (total[:, :3] / total[:, 6:]).astype(np.float32)
        self.slopes_v = (total[:, 3:6] / total[:, 6:]).astype(np.float32)

    def _hair_shell(self) -> None:
        """Hair as a finer copy of the scalp, raised along its normals by a thickness with clumps and a parting."""
        head, identity = self.head, self.identity
        template = head.template * 1e3
        inside = hair_cover(template, identity)
        banned = np.zeros(len(template), bool)
        banned[head.mesh.ear_rings[:, :-2]] = True
        banned[np.concatenate(head.mesh.eyeballs)] = True
        near = (inside > -4.0) & ~banned
        faces = head.mesh.faces[near[head.mesh.faces].all(1)].astype(np.int64)
        parents = np.repeat(np.arange(len(template))[:, None], 2, 1)
        for _ in range(2):
            faces, parents = _subdivide(faces, parents)
        # After two rounds a vertex has up to four ancestors; keep the operator sparse instead of nesting them.
        used, faces = np.unique(faces, return_inverse=True)
        self.hair_faces = faces.reshape(-1, 3).astype(np.int32)
        self._hair_of = _ancestry(parents, len(template))[used]
        at = self._hair_of @ template
        depth = hair_cover(at, identity)
        seed = identity.seed * 101
        flow = np.stack((at[:, 0] * 1.0, at[:, 1] * 0.32, at[:, 2] * 0.32), -1)
        clumps = fractal_noise(flow, 9.0, 2, seed + 31)
        broad = fractal_noise(at, 45.0, 2, seed + 32)
        top = smooth_step(at[:, 1], 55, 118)
        front = smooth_step(at[:, 2], 10, 70) * top
        length = identity.hair_length * 1e3 * (0.42 + 0.58 * top + 0.35 * front)
        parting = np.exp(-(((at[:, 0] - 1e3 * identity.hair_parting) / 5.0) ** 2)) * top
        height = length * (1 + 0.13 * clumps + 0.10 * broad) * (1 - 0.40 * parting)
        height = height * smooth_step(depth + 1.4 * clumps, -1.0, 15.0) - 0.9 * (1 - smooth_step(depth, -2.0, 2.5))
        self.hair_rest = at.astype(np.float32)
        # Hair lies from the crown outwards, combed a little away from the parting.
        away = at - np.array([1e3 * identity.hair_parting, 118.0, -38.0])
        self.strands = _unit(away * np.array([1.0, 0.6, 1.0]) + np.array([0.0, -14.0, 0.0])).astype(np.float32)
        self.hair_height = (height * 1e-3).astype(np.float32)
        streak = fractal_noise(flow * np.array([1.0, 0.4, 0.4]), 3.2, 2, seed + 33)
        self.hair_colours = (
            identity.hair_colour * np.clip(1 + 0.22 * streak + 0.12 * clumps, 0.4, 1.8)[:, None]
        ).astype(np.float32)

    def _assemble(self) -> None:
        parts = [(SKIN, self.head_faces, len(self._neutral))]
        parts.append((HAIR, self.hair_faces, len(self.hair_height)))
        lip_count = len(self._inner_lips)
        parts.append((LINING, grid_faces(2, lip_count, wrap=True), 2 * lip_count))
        parts += [(material, prop.faces, len(prop.points)) for material, prop in self.props.items()]
        faces, materials, self.starts, start = [], [], {}, 0
        for material, own, count in parts:
            faces.append(own + start)
            materials.append(np.full(len(own), material, np.uint8))
            self.starts[material] = start
            start += count
        self.num_points = start
        self.faces = np.concatenate(faces).astype(np.int32)
        self.materials = np.concatenate(materials)
        for k, ball in enumerate(self.head.mesh.eyeballs):
            is_ball = np.zeros(len(self._neutral), bool)
            is_ball[ball] = True
            self.materials[: len(self.head_faces)][is_ball[self.head_faces].all(1)] = EYE_LEFT + k
        self.colours = np.zeros((start, 3), np.float32)
        self.colours[self.starts[HAIR] :][: len(self.hair_colours)] = self.hair_colours
        self.colours[self.starts[LINING] :][: 2 * lip_count] = LINING_COLOUR
        for material, prop in self.props.items():
            self.colours[self.starts[material] :][: len(prop.points)] = prop.colours
        self._prop_normals = {}
        for material, prop in self.props.items():
            operator = _vertex_normal_operator(prop.faces, len(prop.points))
            self._prop_normals[material] = _unit(operator @ face_normals(prop.points, prop.faces)).astype(np.float32)
        lens_operator = _vertex_normal_operator(self.lenses.faces, len(self.lenses.points))
        self.lens_normals = _unit(lens_operator @ face_normals(self.lenses.points, self.lenses.faces))
        self._hair_normals_of = _vertex_normal_operator(self.hair_faces, len(self.hair_height))

    def pose(self, params: HeadParams, body_turn: np.ndarray) -> Geometry:
        """The scene with the head posed by FLAME parameters; `body_turn` [3, 3] turns the clothes under the head."""
        with torch.no_grad():
            points = self.model.vertices(params).numpy()
            jaw = matrix_from_6d(params.jaw).numpy()
            eyes = matrix_from_6d(params.eyes.reshape(2, 6)).numpy()
        normals = _unit(self._normals_of @ face_normals(points, self.head_faces)).astype(np.float32)
        all_points = np.empty((self.num_points, 3), np.float32)
        all_normals = np.empty((self.num_points, 3), np.float32)
        V = len(points)
        all_points[:V], all_normals[:V] = points, normals
        hair = slice(self.starts[HAIR], self.starts[HAIR] + len(self.hair_height))
        strands = self._hair_of @ points + self.hair_height[:, None] * _unit(self._hair_of @ normals)
        all_points[hair] = strands
        all_normals[hair] = _unit(self._hair_normals_of @ face_normals(all_points[hair], self.hair_faces))
        # The inside of the cheeks: from the inner edge of the lips back, around the teeth.
        lining = slice(self.starts[LINING], self.starts[LINING] + 2 * len(self._inner_lips))
        edge = points[self._inner_lips]
        back = edge + LINING_REACH
        all_points[lining] = np.concatenate((edge, back))
        inward = _unit(edge.mean(0) - edge)
        all_normals[lining] = np.concatenate((inward, inward))
        pivot = JOINTS[0].astype(np.float32)
        turns = {MOUTH_LOWER: (jaw, self._joints[2]), SHIRT: (body_turn.astype(np.float32), pivot)}
        for material, prop in self.props.items():
            at = slice(self.starts[material], self.starts[material] + len(prop.points))
            R, centre = turns.get(material, (None, None))
            if R is None:
                all_points[at], all_normals[at] = prop.points, self._prop_normals[material]
            else:
                all_points[at] = (prop.points - centre) @ R.T + centre
                all_normals[at] = self._prop_normals[material] @ R.T
        return Geometry(all_points, all_normals, self.lenses.points, eyes, self._joints[3:])


def _subdivide(faces: np.ndarray, parents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every face into four; `parents` [N, 2] grows by a row of two for each new vertex."""
    edges = np.sort(np.concatenate((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]])), -1)
    unique, index = np.unique(edges, axis=0, return_inverse=True)
    ab, bc, ca = (index.reshape(3, -1) + len(parents))[:]
    a, b, c = faces.T
    finer = np.concatenate([np.stack(t, -1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    return finer, np.concatenate((parents, unique))


def _ancestry(parents: np.ndarray, count: int) -> csr_matrix:
    """Midpoints of midpoints as weights [N, count] on the original vertices."""
    total = len(parents)
    weights = csr_matrix((np.ones(count, np.float32), (np.arange(count), np.arange(count))), shape=(total, count))
    rows = np.repeat(np.arange(total), 2)
    step = csr_matrix((np.full(2 * total, 0.5, np.float32), (rows, parents.reshape(-1))), shape=(total, total))
    for _ in range(2):
        weights = step @ weights
    return csr_matrix(weights)
