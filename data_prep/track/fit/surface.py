"""Points on a head model's surface and their derivatives by everything that moves them.

Linear blend skinning of a point that a triangle's corners k carry with weights b_k is

    p = sum_k b_k sum_j w_kj (R_j s_k + t_j) + eyelids,    s = template + shape + expression + pose correctives.

Sorted by the rotations R_j, with every bone (the joint's place relative to its parent's) given to the joint that turns it,

    p = sum_j R_j g_j + eyelids,    g_j linear in identity, expression and pose features,

which leaves one basis for each joint. Turning a joint by d in its parent's axes turns R_i g_i of all joints i that hang on
it and nothing else, so that dp = (R_parent d) x sum_i R_i g_i, besides what the pose correctives add.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from avatar.head.assets import HeadAssets
from avatar.head.model import JAW, LEFT_EYE, NECK, RIGHT_EYE, ROOT
from data_prep.track.fit.motion import Motion, cross_matrix, gaze_axes, gaze_rotations, left_jacobians, rotations


class _Group(NamedTuple):
    """Points that hang on the same joints: g of all of them is `template` plus `basis` times the coefficients."""

    joints: tuple[int, ...]  # P of them, the root first
    rows: Int[Tensor, " M"] | slice  # a slice where they are neighbours, which saves copies
    template: Float[Tensor, "M 3*P"]
    identity: Float[Tensor, "M 3*P I"]
    basis: Float[Tensor, "M 3*P E+2+F"]  # expression, eyelids (which are not skinned: the root's), pose features


class Derivatives(NamedTuple):
    """Of Q directional components q_nq . p_n of each of N points, by a frame's coefficients and by the identity.

    One row for each direction of each point (row n Q + q), then frames, then columns: what a product over the rows wants.
    """

    joints: Float[Tensor, "N*Q T 10"]  # jaw 3, gaze 4, neck 3
    expression: Float[Tensor, "N*Q T E"]
    eyelids: Float[Tensor, "N*Q T 2"]
    identity: Float[Tensor, "N*Q T I"]  # I = 0 unless asked for


class Placed(NamedTuple):
    """Points where a motion places them, and what their derivatives are made from."""

    positions: Float[Tensor, "T N 3"]  # in the head's own space, metres
    motion: Motion
    local: list[Float[Tensor, "T 3 3"]]  # every joint's rotation relative to its parent
    world: Float[Tensor, "T J 3 3"]  # and in the head's space
    turned: list[Float[Tensor, "T M P 3"]]  # R_j g_j of every group's points and joints


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
        self._made_of = assets, corners, barycentric, identities, expressions
        self._parents = assets.parents
        self.num_points, self.num_identities, self.num_expressions = len(corners), identities, len(expressions)
        self._has_features = bool(assets.pose_dirs[corners].any())
        self._groups = _groups(assets, corners, barycentric.double(), identities, expressions, self._has_features)
        self._rest: tuple[Tensor, list[Tensor]] | None = None  # an identity and what `_at_rest` gives for it

    def of(self, rows: Int[Tensor, " M"]) -> SurfacePoints:
        """Some of the points."""
        assets, corners, barycentric, identities, expressions = self._made_of
        return SurfacePoints(assets, corners[rows], barycentric[rows], identities, expressions)

    def positions(self, identity: Float[Tensor, " I"], motion: Motion) -> Float[Tensor, "T N 3"]:
        """Where the points are in the head's own space, metres."""
        local, world = self._pose(motion)
        T = len(motion)
        total = torch.empty(T, self.num_points, 3, dtype=torch.float64)
        for group, g in zip(self._groups, self._unturned(identity, motion, local), strict=True):
            # [g_1 .. g_P] times the transposed rotations below each other: the sum of R_j g_j
            total[:, group.rows] = g @ world[:, list(group.joints)].transpose(2, 3).flatten(1, 2)
        return total

    def placed(self, identity: Float[Tensor, " I"], motion: Motion) -> Placed:
        """`positions`, to the last digits, on the way to `derivatives`."""
        local, world = self._pose(motion)
        turned = self._turned(identity, motion, local, world)
        return Placed(self._carried(turned, ROOT, len(motion)), motion, local, world, turned)

    def derivatives(
        self, placed: Placed, directions: Float[Tensor, "T N Q 3"], with_identity: bool = False
    ) -> Derivatives:
        """Of directions . positions."""
        (T, N, Q), motion = directions.shape[:3], placed.motion
        E, I = self.num_expressions, self.num_identities if with_identity else 0  # noqa: E741
        local, world, turned = placed[2:]
        by_coefficients = torch.empty(N, Q * T, E + 2 + self._num_features, dtype=torch.float64)
        by_identity = torch.empty(N, Q * T, I, dtype=torch.float64)
        q = directions.permute(1, 2, 0, 3)  # [N, Q, T, 3]
        for group in self._groups:
            along = torch.cat([_rows_times(q[group.rows], world[:, j]) for j in group.joints], dim=-1).flatten(1, 2)
            _multiply(along, group.basis, by_coefficients, group.rows)
            if with_identity:
                _multiply(along, group.identity, by_identity, group.rows)
        by_coefficients = by_coefficients.unflatten(1, (Q, T)).flatten(0, 1)
        by_features = by_coefficients[..., E + 2 :]
        axes = _axes(motion)
        columns = []
        for joint in (JAW, LEFT_EYE, RIGHT_EYE, NECK):
            carried = self._carried(turned, joint, T).transpose(0, 1)[:, None]  # [N, 1, T, 3]
            moment = torch.linalg.cross(carried, q)  # q . (w x r) = w . (r x q)
            column = _rows_times(moment, world[:, self._parents[joint]] @ axes[joint]).flatten(0, 1)
            if self._has_features:
                change = cross_matrix(axes[joint].transpose(1, 2)) @ local[joint][:, None]  # [T, K, 3, 3]
                own = by_features[..., 9 * (joint - 1) : 9 * joint]
                column = column + _rows_times(own, change.flatten(2).transpose(1, 2))
            columns.append(column)
        return Derivatives(
            torch.cat(columns, dim=-1),
            by_coefficients[..., :E],
            by_coefficients[..., E : E + 2],
            by_identity.unflatten(1, (Q, T)).flatten(0, 1),
        )

    @property
    def _num_features(self) -> int:
        return 9 * (len(self._parents) - 1) if self._has_features else 0

    def _pose(self, motion: Motion) -> tuple[list[Float[Tensor, "T 3 3"]], Float[Tensor, "T J 3 3"]]:
        """Every joint's rotation relative to its parent, and in the head's space."""
        local = [torch.eye(3, dtype=torch.float64).expand(len(motion), 3, 3)]
        world = [local[0]]
        for joint in range(1, len(self._parents)):
            local.append(_joint_rotations(motion, joint))
            world.append(world[self._parents[joint]] @ local[-1])
        return local, torch.stack(world, dim=1)

    def _at_rest(self, identity: Tensor) -> list[Float[Tensor, "M 3*P"]]:
        """g_j of every group's points and joints without expression and features. Kept: all frames share an identity."""
        kept = self._rest
        if kept is None or kept[0] is not identity:
            kept = self._rest = identity, [group.template + group.identity @ identity for group in self._groups]
        return kept[1]

    def _unturned(self, identity: Tensor, motion: Motion, local: list[Tensor]) -> Iterator[Float[Tensor, "T M 3*P"]]:
        """g_j of every group's points and joints."""
        parts = [motion.expression, motion.eyelids]
        if self._has_features:
            parts.append((torch.stack(local[1:], dim=1) - local[0][:, None]).flatten(1))
        coefficients = torch.cat(parts, dim=1)
        for group, rest in zip(self._groups, self._at_rest(identity), strict=True):
            g = rest.flatten() + coefficients @ group.basis.flatten(0, 1).T
            yield g.reshape(len(motion), *rest.shape)

    def _turned(
        self, identity: Tensor, motion: Motion, local: list[Tensor], world: Tensor
    ) -> list[Float[Tensor, "T M P 3"]]:
        """R_j g_j of every group's points and joints."""
        turned = []
        for group, g in zip(self._groups, self._unturned(identity, motion, local), strict=True):
            g = g.unflatten(2, (len(group.joints), 3))
            turned.append(torch.einsum("tpcd,tmpd->tmpc", world[:, list(group.joints)], g))
        return turned

    def _carried(self, turned: list[Tensor], below: int, T: int) -> Float[Tensor, "T N 3"]:
        """The sum of R_i g_i over the joint `below` and the joints that hang on it; over all of them for the root."""
        total = torch.zeros(T, self.num_points, 3, dtype=torch.float64)
        for group, own in zip(self._groups, turned, strict=True):
            for k, joint in enumerate(group.joints):
                if below in _ancestry(self._parents, joint):
                    total[:, group.rows] += own[:, :, k]
        return total


def _joint_rotations(motion: Motion, joint: int) -> Float[Tensor, "T 3 3"]:
    """A joint's rotation relative to its parent."""
    if joint == NECK:
        return rotations(motion.neck)
    if joint == JAW:
        return rotations(motion.jaw)
    return gaze_rotations(motion.gaze[:, :2] if joint == LEFT_EYE else motion.gaze[:, 2:])


def _axes(motion: Motion) -> dict[int, Float[Tensor, "T 3 K"]]:
    """In the parent's space, the axes about which a joint turns when one of its K parameters grows."""
    return {
        NECK: left_jacobians(motion.neck),
        JAW: left_jacobians(motion.jaw),
        LEFT_EYE: gaze_axes(motion.gaze[:, :2]),
        RIGHT_EYE: gaze_axes(motion.gaze[:, 2:]),
    }


def _rows_times(rows: Float[Tensor, "*B T C"], matrices: Float[Tensor, "T C K"]) -> Float[Tensor, "*B T K"]:
    """Row vectors times their frame's matrix."""
    by_frame = rows.flatten(0, -3).transpose(0, 1) @ matrices
    return by_frame.transpose(0, 1).unflatten(0, rows.shape[:-2])


def _multiply(left: Tensor, right: Tensor, out: Tensor, rows: Tensor | slice) -> None:
    """out[rows] = left @ right, in place where the rows are neighbours."""
    if isinstance(rows, slice):
        torch.bmm(left, right, out=out[rows])
    else:
        out[rows] = torch.bmm(left, right)


def _ancestry(parents: tuple[int, ...], joint: int) -> list[int]:
    """The joint itself, its parent, and so on up to the root."""
    line = [joint]
    while parents[line[-1]] >= 0:
        line.append(parents[line[-1]])
    return line


def joint_dependence(assets: HeadAssets, share: Float[Tensor, "N 3 J"]) -> Bool[Tensor, "N J"]:
    """Which joints move points, whose corners follow each joint by `share`."""
    depends = (share != 0).any(1)
    for joint in reversed(range(1, len(assets.parents))):  # a bone is turned by the joint above it
        depends[:, assets.parents[joint]] |= depends[:, joint]
    depends[:, ROOT] = True
    return depends


def _groups(
    assets: HeadAssets,
    corners: Tensor,
    barycentric: Tensor,
    identities: int,
    expressions: Tensor,
    has_features: bool,
) -> list[_Group]:
    """The points by the set of joints that they depend on."""
    share = barycentric[..., None] * assets.weights[corners].double()  # [N, 3, J]
    depends = joint_dependence(assets, share)
    bases = torch.cat(
        (
            assets.template[:, :, None],
            assets.shape_dirs[:, :, :identities],
            assets.expression_dirs[:, :, expressions],
        ),
        dim=2,
    ).double()
    joints = torch.einsum("jv,vcb->jcb", assets.joint_regressor.double(), bases)
    groups = []
    for members in torch.unique(depends, dim=0):
        rows = torch.nonzero((depends == members).all(1)).squeeze(1)
        own = torch.nonzero(members).squeeze(1).tolist()
        parts = []
        for j in own:
            skinned = torch.einsum("nk,nkcb->ncb", share[rows, :, j], bases[corners[rows]])
            skinned = skinned + _bones(assets.parents, j, share[rows].sum(1), joints)
            lids = torch.einsum("nk,snkc->ncs", barycentric[rows], assets.eyelid_dirs[:, corners[rows]].double())
            part = [skinned, lids if j == ROOT else torch.zeros_like(lids)]
            if has_features:
                part.append(torch.einsum("nk,nkcb->ncb", share[rows, :, j], assets.pose_dirs[corners[rows]].double()))
            parts.append(torch.cat(part, dim=2))
        basis = torch.stack(parts, dim=1).flatten(1, 2)  # [M, 3 P, 1 + I + E + 2 + F]
        is_run = len(rows) == int(rows[-1] - rows[0]) + 1
        groups.append(
            _Group(
                tuple(own),
                slice(int(rows[0]), int(rows[-1]) + 1) if is_run else rows,
                basis[..., 0].clone(),
                basis[..., 1 : 1 + identities].contiguous(),
                basis[..., 1 + identities :].contiguous(),
            )
        )
    return groups


def _bones(
    parents: tuple[int, ...], joint: int, carried: Float[Tensor, "M J"], joints: Float[Tensor, "J 3 B"]
) -> Float[Tensor, "M 3 B"]:
    """What a joint turns besides the skin: the bones to its children, less its own place, which it does not turn."""

    def below(j: int) -> Tensor:
        return torch.stack([carried[:, i] for i in range(len(parents)) if j in _ancestry(parents, i)]).sum(0)

    total = -carried[:, joint, None, None] * joints[joint]
    for child in (c for c in range(len(parents)) if parents[c] == joint):
        total = total + below(child)[:, None, None] * (joints[child] - joints[joint])
    if parents[joint] < 0:
        total = total + below(joint)[:, None, None] * joints[joint]
    return total
