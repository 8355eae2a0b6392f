"""Points on a head model's surface and their derivatives by everything that moves them.

Linear blend skinning of a point that a triangle's corners k carry with weights b_k, where jaw and eyes turn by R_j about
their places c_j and nothing else does (a tracked head's pose is the camera's, and its neck stays at rest), is

    p = g_0 + sum_j (R_j - 1) g_j,    g_0 = sum_k b_k s_k + eyelids,    g_j = sum_k b_k w_kj (s_k - c_j),

with s = template + shape + expression + pose correctives: every g is linear in the coefficients and the pose features. When
a joint turns by d, p moves by d x (R_j g_j), besides what the pose correctives add.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from avatar.errors import UserError
from avatar.head.assets import HeadAssets
from avatar.head.model import JAW, LEFT_EYE, NECK, RIGHT_EYE, ROOT
from data_prep.track.fit.frame_poses import Motion, cross_matrix, gaze_axes, gaze_rotations, left_jacobians, rotations

JOINTS = (JAW, LEFT_EYE, RIGHT_EYE)  # that turn
FEATURES = 9 * len(JOINTS)  # pose features: the entries of R_j - 1


class _Group(NamedTuple):
    """Points that the same joints turn: their g_0 and g_j are `template` plus the bases times the coefficients."""

    joints: tuple[int, ...]  # P - 1 positions in JOINTS
    rows: Int[Tensor, " M"]
    template: Float[Tensor, "M W"]  # W = 3 P
    identity: Float[Tensor, "M W I"]
    basis: Float[Tensor, "M W C"]  # expression, eyelids, pose features


class Derivatives(NamedTuple):
    """Of Q directional components q_nq . p_n of each of N points, by a frame's coefficients and by the identity.

    One row for each direction of each point (row n Q + q), then frames, then columns: what a product over the rows wants.
    """

    coefficients: Float[Tensor, "R T C"]  # jaw 3, gaze 4, eyelids 2, expression: as in `Motion.coefficients`
    identity: Float[Tensor, "R T I"]  # I = 0 unless asked for


class Placed(NamedTuple):
    """Points where a motion places them, and what their derivatives are made from."""

    positions: Float[Tensor, "T N 3"]  # in the head's own space, metres
    motion: Motion
    turns: Float[Tensor, "T 3 3 3"]  # rotations of JOINTS
    unturned: list[Float[Tensor, "T M P 3"]]  # g_0 and g_j of every group's points


class SurfacePoints:
    """N points of a head model, given by the corners of their triangles and barycentric weights; float64.

    `identities` is how many identity coefficients count, `expressions` are the expression coefficients (columns of the
    model's basis) that a `Motion` holds.
    """

    def __init__(
        self,
        assets: HeadAssets,
        corners: Int[Tensor, "N 3"],
        barycentric: Float[Tensor, "N 3"],
        identities: int,
        expressions: Int[Tensor, " E"],
    ) -> None:
        """Raises UserError for a head model whose jaw or eyes hang on each other."""
        if any(assets.parents[joint] not in (ROOT, NECK) for joint in JOINTS):
            raise UserError("the head model's jaw and eyes must hang on its neck or its root; track with another one")
        self._made_of = assets, corners, barycentric, identities, expressions
        self.num_points, self.num_identities, self.num_expressions = len(corners), identities, len(expressions)
        self._groups = _groups(assets, corners, barycentric.double(), identities, expressions)
        self._rest: tuple[Tensor, list[Tensor]] | None = None  # an identity and what `_at_rest` gives for it

    def of(self, rows: Int[Tensor, " M"]) -> SurfacePoints:
        """Some of the points."""
        assets, corners, barycentric, identities, expressions = self._made_of
        return SurfacePoints(assets, corners[rows], barycentric[rows], identities, expressions)

    def positions(self, identity: Float[Tensor, " I"], motion: Motion) -> Float[Tensor, "T N 3"]:
        """Where the points are in the head's own space, metres."""
        return self.placed(identity, motion).positions

    def placed(self, identity: Float[Tensor, " I"], motion: Motion) -> Placed:
        """`positions`, with what `derivatives` needs."""
        turns, T = _turns(motion), len(motion)
        change = turns - torch.eye(3, dtype=torch.float64)
        coefficients = torch.cat((motion.expression, motion.eyelids, change.flatten(1)), dim=1)
        positions, unturned = torch.empty(T, self.num_points, 3, dtype=torch.float64), []
        for group, rest in zip(self._groups, self._at_rest(identity), strict=True):
            g = rest.flatten() + coefficients @ group.basis.flatten(0, 1).T
            unturned.append(g.unflatten(1, (len(rest), -1, 3)))
            placed = unturned[-1][:, :, 0]
            for k, joint in enumerate(group.joints, start=1):
                placed = placed + unturned[-1][:, :, k] @ change[:, joint].mT
            positions[:, group.rows] = placed
        return Placed(positions, motion, turns, unturned)

    def derivatives(
        self, placed: Placed, directions: Float[Tensor, "T N Q 3"], with_identity: bool = False
    ) -> Derivatives:
        """Of directions . positions."""
        (T, N, Q), motion, turns = directions.shape[:3], placed.motion, placed.turns
        E, I = self.num_expressions, self.num_identities if with_identity else 0  # noqa: E741
        by_coefficients = torch.empty(N, Q * T, E + 2 + FEATURES, dtype=torch.float64)
        by_identity = torch.empty(N, Q * T, I, dtype=torch.float64)
        moments = torch.zeros(len(JOINTS), N, Q, T, 3, dtype=torch.float64)
        q = directions.permute(1, 2, 0, 3)  # [N, Q, T, 3]
        change = turns - torch.eye(3, dtype=torch.float64)
        for group, g in zip(self._groups, placed.unturned, strict=True):
            own = q[group.rows]
            along = torch.cat([own, *(_rows_times(own, change[:, j]) for j in group.joints)], dim=-1).flatten(1, 2)
            by_coefficients[group.rows] = along @ group.basis
            if with_identity:
                by_identity[group.rows] = along @ group.identity
            for k, joint in enumerate(group.joints, start=1):
                turned = (g[:, :, k] @ turns[:, joint].mT).transpose(0, 1)[:, None]  # [M, 1, T, 3]
                moments[joint, group.rows] = torch.linalg.cross(turned, own)  # q . (w x r) = w . (r x q)
        by_coefficients = by_coefficients.unflatten(1, (Q, T)).flatten(0, 1)
        by_features = by_coefficients[..., E + 2 :].unflatten(-1, (len(JOINTS), 9))
        columns = []
        for joint, axes in enumerate(_axes(motion)):
            features = cross_matrix(axes.mT) @ turns[:, joint, None]  # [T, K, 3, 3]
            columns.append(
                _rows_times(moments[joint].flatten(0, 1), axes)
                + _rows_times(by_features[..., joint, :], features.flatten(2).mT)
            )
        eyelids, expression = by_coefficients[..., E : E + 2], by_coefficients[..., :E]
        return Derivatives(
            torch.cat([*columns, eyelids, expression], dim=-1), by_identity.unflatten(1, (Q, T)).flatten(0, 1)
        )

    def _at_rest(self, identity: Tensor) -> list[Float[Tensor, "M W"]]:
        """g of every group's points without expression and features. Kept: all frames share an identity."""
        kept = self._rest
        if kept is None or kept[0] is not identity:
            kept = self._rest = identity, [group.template + group.identity @ identity for group in self._groups]
        return kept[1]


def _turns(motion: Motion) -> Float[Tensor, "T 3 3 3"]:
    """The rotations of JOINTS."""
    return torch.cat((rotations(motion.jaw)[:, None], gaze_rotations(motion.gaze.unflatten(1, (2, 2)))), dim=1)


def _axes(motion: Motion) -> tuple[Float[Tensor, "T 3 K"], ...]:
    """The axes about which each of JOINTS turns when one of its K parameters grows."""
    return left_jacobians(motion.jaw), gaze_axes(motion.gaze[:, :2]), gaze_axes(motion.gaze[:, 2:])


def _rows_times(rows: Float[Tensor, "*B T C"], matrices: Float[Tensor, "T C K"]) -> Float[Tensor, "*B T K"]:
    """Row vectors times their frame's matrix."""
    by_frame = rows.flatten(0, -3).transpose(0, 1) @ matrices
    return by_frame.transpose(0, 1).unflatten(0, rows.shape[:-2])


def _groups(
    assets: HeadAssets, corners: Tensor, barycentric: Tensor, identities: int, expressions: Tensor
) -> list[_Group]:
    """The points by the set of joints that turn them."""
    skinned = torch.cat(
        (assets.template[:, :, None], assets.shape_dirs[:, :, :identities], assets.expression_dirs[:, :, expressions]),
        dim=2,
    ).double()
    places = torch.einsum("jv,vcb->jcb", assets.joint_regressor.double()[list(JOINTS)], skinned)
    eyelids = assets.eyelid_dirs.double().permute(1, 2, 0)  # are not skinned
    by_pose = assets.pose_dirs.double()[..., 9 * (JAW - 1) :]
    whole = assets.weights.double().sum(1)[:, None, None]  # 1, but for rounding
    everything = torch.cat((whole * skinned, eyelids, whole * by_pose), dim=2)
    turning = torch.cat((skinned, torch.zeros_like(eyelids), by_pose), dim=2)
    places = torch.nn.functional.pad(places, (0, everything.shape[2] - places.shape[2]))
    share = barycentric[..., None] * assets.weights[corners][..., list(JOINTS)].double()  # [N, 3, 3]
    depends: Bool[Tensor, "N 3"] = (share != 0).any(1)
    groups = []
    for members in torch.unique(depends, dim=0):
        rows = torch.nonzero((depends == members).all(1)).squeeze(1)
        joints = torch.nonzero(members).squeeze(1).tolist()
        parts = [torch.einsum("nk,nkcb->ncb", barycentric[rows], everything[corners[rows]])]
        for j in joints:
            own = share[rows, :, j]
            moved = torch.einsum("nk,nkcb->ncb", own, turning[corners[rows]])
            parts.append(moved - own.sum(1)[:, None, None] * places[j])
        basis = torch.cat(parts, dim=1)  # [M, 3 P, 1 + I + E + 2 + F]
        template, identity, rest = basis.split((1, identities, basis.shape[2] - 1 - identities), dim=2)
        groups.append(_Group(tuple(joints), rows, template[..., 0].clone(), identity.contiguous(), rest.contiguous()))
    return groups
