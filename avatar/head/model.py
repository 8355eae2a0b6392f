"""Linear blend skinning of a FLAME-format head.

Source: Li, Bolkart, Black, Li, Romero, "Learning a model of facial shape and expression from 4D scans" (2017), eq. 2-5;
eyelid blendshapes after skinning as in metrical-tracker.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from avatar.compute.device import CPU, to_device
from avatar.compute.gpu_functions import gpu_function
from avatar.head.assets import HeadAssets
from avatar.tensors import check_shapes
from avatar.types import HeadParams

ROOT, NECK, JAW, LEFT_EYE, RIGHT_EYE = range(5)
FLAME_PARENTS = (-1, ROOT, NECK, NECK, NECK)


def matrix_from_6d(rotation: Float[Tensor, "*B 6"]) -> Float[Tensor, "*B 3 3"]:
    """6D rotation (the first two rows of the matrix) -> matrix, made orthonormal by Gram-Schmidt.

    Source: Zhou et al., "On the continuity of rotation representations in neural networks" (2019), in rows.
    """
    first = torch.nn.functional.normalize(rotation[..., :3], dim=-1)
    second = rotation[..., 3:] - (first * rotation[..., 3:]).sum(-1, keepdim=True) * first
    second = torch.nn.functional.normalize(second, dim=-1)
    return torch.stack((first, second, torch.linalg.cross(first, second)), dim=-2)


def nearest_rotation(matrices: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B 3 3"]:
    """The rotation nearest to each matrix, by singular value decomposition: of a mean of rotations, their chordal mean."""
    U, _, Vh = torch.linalg.svd(matrices)
    U = torch.cat((U[..., :2], U[..., 2:] * torch.det(U @ Vh)[..., None, None]), dim=-1)
    return U @ Vh


class PoseTensors(NamedTuple):
    """What posing one identity takes, float32 and contiguous, for the kernels of `avatar.kernels.pose`."""

    shape: Float[Tensor, " V*3"]  # without expression
    basis: Float[Tensor, "V*3 E+36"]  # expression, then pose correctives
    joints: Float[Tensor, "5 3"]
    joint_directions: Float[Tensor, "15 E"]
    weights: Float[Tensor, "V 5"]
    eyelid_directions: Float[Tensor, "2 V 3"]


class HeadModel:
    """A head of one identity: expression and joint rotations in, vertices out.

    `identity` [up to 300] holds the identity coefficients; missing ones are zero. The arithmetic runs in `dtype`.
    """

    def __init__(self, assets: HeadAssets, identity: Float[Tensor, " S"], dtype: torch.dtype = torch.float32) -> None:
        if identity.ndim != 1 or len(identity) > assets.shape_dirs.shape[2]:
            raise ValueError(
                f"identity must have shape [at most {assets.shape_dirs.shape[2]}], got {list(identity.shape)}"
            )
        self.assets = assets
        self.faces: Int[Tensor, "F 3"] = assets.faces
        V, E = assets.num_vertices, assets.num_expressions
        shape_dirs = assets.shape_dirs[:, :, : len(identity)].to(dtype)
        self._identity_shape = assets.template.to(dtype) + shape_dirs @ identity.to(dtype)
        self._expression_dirs = assets.expression_dirs.to(dtype).reshape(V * 3, E)
        regressor = assets.joint_regressor.to(dtype)
        self._identity_joints = regressor @ self._identity_shape
        # Joints follow the expression too; their regressor is folded into the basis once.
        folded = torch.einsum("jv,vce->jce", regressor, assets.expression_dirs.to(dtype))
        self._expression_joints = folded.reshape(-1, E)
        self._pose_dirs = assets.pose_dirs.to(dtype).reshape(V * 3, -1)
        self._weights = assets.weights.to(dtype)
        self._eyelid_dirs = assets.eyelid_dirs.to(dtype)
        self._parents = assets.parents
        self._pose_tensors: PoseTensors | None = None

    def pose_tensors(self, device: torch.device) -> PoseTensors | None:
        """Copies for posing on a GPU; None for a head whose joints hang together in another way than FLAME's."""
        if self._parents != FLAME_PARENTS:
            return None
        tensors = (
            self._identity_shape.reshape(-1),
            torch.cat((self._expression_dirs, self._pose_dirs), dim=1),
            self._identity_joints,
            self._expression_joints,
            self._weights,
            self._eyelid_dirs,
        )
        return PoseTensors(*(tensor.float().contiguous().to(device) for tensor in tensors))

    def on(self, device: torch.device) -> HeadModel:
        """A copy there, which poses with gradients; `pose_gpu` is faster without."""
        there = copy(self)
        for name, value in vars(self).items():
            if isinstance(value, Tensor):
                setattr(there, name, value.to(device))
        return there

    def neutral_vertices(self) -> Float[Tensor, "V 3"]:
        """The identity without expression, joints at rest, in metres."""
        return self._identity_shape.clone()

    def neck(self) -> tuple[Float[Tensor, " 3"], Float[Tensor, " V"]]:
        """The joint of the identity's neck, metres, and which share of the head each vertex is; the rest is torso."""
        return self._identity_joints[NECK].clone(), self._carried(self._weights, NECK)

    def _carried(self, weights: Float[Tensor, "R J"], joint: int) -> Float[Tensor, " R"]:
        """How much of vertices with these weights hangs on a joint and on what it carries."""
        return weights[:, [_follows(self._parents, j, joint) for j in range(len(self._parents))]].sum(dim=1)

    def vertices(self, params: HeadParams) -> Float[Tensor, "V 3"]:
        """The posed head in metres, world space: the head's pose is in the camera, so `neck` turns the torso beneath it.

        Raises ValueError when the parameters' shapes are wrong; fewer expression coefficients than the basis has stand
        for zeros in the rest.
        """
        check_shapes(
            jaw=(params.jaw, "6"),
            eyes=(params.eyes, "12"),
            eyelids=(params.eyelids, "2"),
            neck=(params.neck, "6"),
            expression=(params.expression, "E"),
        )
        E = len(params.expression)
        if self._expression_dirs.shape[1] < E:
            raise ValueError(
                f"expression has {E} coefficients, but the head model has {self._expression_dirs.shape[1]} directions"
            )
        dtype = self._identity_shape.dtype
        expression = params.expression.to(dtype)
        shape = self._identity_shape + (self._expression_dirs[:, :E] @ expression).reshape(-1, 3)
        joints = self._identity_joints + (self._expression_joints[:, :E] @ expression).reshape(-1, 3)

        identity = torch.eye(3, dtype=dtype, device=expression.device)
        rotations = torch.stack(
            (
                identity,
                matrix_from_6d(params.neck.to(dtype)),
                matrix_from_6d(params.jaw.to(dtype)),
                *matrix_from_6d(params.eyes.to(dtype).reshape(2, 6)),
            )
        )
        correctives = self._pose_dirs @ (rotations[1:] - identity).reshape(-1)
        shape = shape + correctives.reshape(-1, 3)
        R, t = self._joint_transforms(rotations, joints)
        # Blend the transforms, then apply: sum_j w_j (R_j v + t_j).
        blended_R = (self._weights @ R.reshape(-1, 9)).reshape(-1, 3, 3)
        posed = (blended_R @ shape[:, :, None]).squeeze(-1) + self._weights @ t
        return posed + torch.einsum("s,svc->vc", params.eyelids.to(dtype), self._eyelid_dirs)

    def vertices_on_gpu(self, params: HeadParams, device: torch.device) -> Float[Tensor, "V 3"]:
        """`vertices` there, without gradients; `params` may be on either side."""
        if self._pose_tensors is None or self._pose_tensors.shape.device != device:
            self._pose_tensors = self.pose_tensors(device)
        if self._pose_tensors is None:
            return to_device(self.vertices(params.to(CPU)), device)
        return gpu_function("pose a head")(self._pose_tensors, params.to(device))

    def still_vertices(
        self, expression: Float[Tensor, "N E"], jaw: Float[Tensor, "N 3 3"], rows: Int[Tensor, " R"]
    ) -> Float[Tensor, "N R 3"]:
        """The vertices `rows` of N heads, as `vertices` poses them with neck, eyes and eyelids at rest; metres.

        All at once, so much faster. `jaw` holds rotation matrices. Raises ValueError for more expression coefficients than
        the basis has.
        """
        sizes = check_shapes(expression=(expression, "N E"), jaw=(jaw, "N 3 3"))
        E, directions = sizes["E"], self._expression_dirs.shape[1]
        if directions < E:
            raise ValueError(f"expression has {E} coefficients, but the head model has {directions} directions")
        dtype = self._identity_shape.dtype
        expression, turn = expression.to(dtype), jaw.to(dtype) - torch.eye(3, dtype=dtype)
        by_expression = self._expression_dirs.unflatten(0, (-1, 3))[rows, :, :E].flatten(0, 1)
        by_jaw = self._pose_dirs.unflatten(0, (-1, 3))[rows, :, 9 * (JAW - 1) : 9 * JAW].flatten(0, 1)
        moved = expression @ by_expression.T + turn.flatten(1) @ by_jaw.T
        shape = self._identity_shape[rows] + moved.unflatten(1, (-1, 3))
        pivot = self._identity_joints[JAW] + expression @ self._expression_joints[3 * JAW : 3 * JAW + 3, :E].T
        # All other transforms are the identity, so what the jaw carries turns about its joint and the rest stays.
        carried = self._carried(self._weights[rows], JAW)
        return shape + carried[:, None] * ((shape - pivot[:, None]) @ turn.mT)

    def _joint_transforms(
        self, rotations: Float[Tensor, "J 3 3"], joints: Float[Tensor, "J 3"]
    ) -> tuple[Float[Tensor, "J 3 3"], Float[Tensor, "J 3"]]:
        """Rest space -> posed space for every joint, along the kinematic tree: p -> R p + t.

        The root turns backwards about the identity's neck joint, so that the head stays where the camera expects it.
        """
        pivot = self._identity_joints[NECK]
        R = [rotations[ROOT] @ rotations[NECK].mT]
        t = [pivot - R[ROOT] @ pivot]
        for joint in range(1, len(self._parents)):
            parent = self._parents[joint]
            R.append(R[parent] @ rotations[joint])
            # The joint itself moves with its parent; rotate about it.
            t.append(R[parent] @ joints[joint] + t[parent] - R[joint] @ joints[joint])
        return torch.stack(R), torch.stack(t)


def _follows(parents: Sequence[int], joint: int, ancestor: int) -> bool:
    """Whether a joint is another one or is carried by it."""
    return joint == ancestor or (parents[joint] >= 0 and _follows(parents, parents[joint], ancestor))
