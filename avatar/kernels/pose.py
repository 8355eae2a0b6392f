"""Posing of a FLAME-format head without gradients: what `HeadModel.vertices` does, in two launches around one product."""

import triton
import triton.language as tl

from avatar.kernels.load_store import store3

SMALLEST_NORM = tl.constexpr(1e-12)  # of torch.nn.functional.normalize
TRANSFORM = tl.constexpr(12)  # values of a joint's transform: its rotation, row by row, and its translation
FEATURES = tl.constexpr(36)  # four rotations minus the identity


@triton.jit
def matrix_of_6d(rotation):
    """6D rotation (the first two rows) -> matrix, made orthonormal by Gram-Schmidt."""
    a0, a1, a2 = tl.load(rotation), tl.load(rotation + 1), tl.load(rotation + 2)
    b0, b1, b2 = tl.load(rotation + 3), tl.load(rotation + 4), tl.load(rotation + 5)
    length = tl.maximum(tl.sqrt_rn(a0 * a0 + a1 * a1 + a2 * a2), SMALLEST_NORM)
    a0, a1, a2 = a0 / length, a1 / length, a2 / length
    along = a0 * b0 + a1 * b1 + a2 * b2
    b0, b1, b2 = b0 - along * a0, b1 - along * a1, b2 - along * a2
    length = tl.maximum(tl.sqrt_rn(b0 * b0 + b1 * b1 + b2 * b2), SMALLEST_NORM)
    b0, b1, b2 = b0 / length, b1 / length, b2 / length
    return a0, a1, a2, b0, b1, b2, a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0


@triton.jit
def _put_feature(features, r0, r1, r2, r3, r4, r5, r6, r7, r8):
    store3(features, 0, r0 - 1.0, r1, r2, True)
    store3(features, 1, r3, r4 - 1.0, r5, True)
    store3(features, 2, r6, r7, r8 - 1.0, True)


@triton.jit
def _joint(identity_joints, directions, weights, joint: tl.constexpr, stride, e, mask):
    """A joint's place at rest under the expression `weights`."""
    at = directions + 3 * joint * stride + e
    x = tl.load(identity_joints + 3 * joint) + tl.sum(weights * tl.load(at, mask=mask, other=0.0), 0)
    y = tl.load(identity_joints + 3 * joint + 1) + tl.sum(weights * tl.load(at + stride, mask=mask, other=0.0), 0)
    z = tl.load(identity_joints + 3 * joint + 2) + tl.sum(weights * tl.load(at + 2 * stride, mask=mask, other=0.0), 0)
    return x, y, z


@triton.jit
def rotated(r0, r1, r2, r3, r4, r5, r6, r7, r8, x, y, z):
    return r0 * x + r1 * y + r2 * z, r3 * x + r4 * y + r5 * z, r6 * x + r7 * y + r8 * z


@triton.jit
def _put_transform(to, r0, r1, r2, r3, r4, r5, r6, r7, r8, t0, t1, t2):
    store3(to, 0, r0, r1, r2, True)
    store3(to, 1, r3, r4, r5, True)
    store3(to, 2, r6, r7, r8, True)
    store3(to, 3, t0, t1, t2, True)


@triton.jit(do_not_specialize=["given", "stride"])
def pose(
    expression,
    neck,
    jaw,
    eyes,
    identity_joints,
    joint_directions,
    given,
    stride,
    coefficients,
    transforms,
    EXPRESSIONS: tl.constexpr,
):
    """One program. Write what the basis is multiplied by, and where each joint takes the vertices.

    expression [given]: as many of the `stride` coefficients as there are; identity_joints [5, 3] at rest, without
    expression; joint_directions [5, 3, stride];  coefficients [stride + 36]: of the expression, then of the correctives
    transforms [5, 12]: of root, neck, jaw, left and right eye; all but the root hang on the neck, which stays where it is
    on the identity: the root turns backwards about it.
    """
    e = tl.arange(0, EXPRESSIONS)
    weights = tl.load(expression + e, mask=e < given, other=0.0)
    tl.store(coefficients + e, weights, mask=e < stride)
    one, zero = tl.sum(tl.where(e == 0, 1.0, 0.0), 0), tl.sum(tl.where(e == 0, 0.0, 0.0), 0)

    n0, n1, n2, n3, n4, n5, n6, n7, n8 = matrix_of_6d(neck)
    _put_feature(coefficients + stride, n0, n1, n2, n3, n4, n5, n6, n7, n8)
    px, py, pz = tl.load(identity_joints + 3), tl.load(identity_joints + 4), tl.load(identity_joints + 5)
    a, b, c = rotated(n0, n3, n6, n1, n4, n7, n2, n5, n8, px, py, pz)
    _put_transform(transforms, n0, n3, n6, n1, n4, n7, n2, n5, n8, px - a, py - b, pz - c)
    x, y, z = _joint(identity_joints, joint_directions, weights, 1, stride, e, e < stride)
    a, b, c = rotated(n0, n3, n6, n1, n4, n7, n2, n5, n8, x - px, y - py, z - pz)
    t0, t1, t2 = a + px - x, b + py - y, c + pz - z
    _put_transform(transforms + TRANSFORM, one, zero, zero, zero, one, zero, zero, zero, one, t0, t1, t2)
    for joint in tl.static_range(2, 5):
        rotation = jaw if joint == 2 else eyes + 6 * (joint - 3)
        r0, r1, r2, r3, r4, r5, r6, r7, r8 = matrix_of_6d(rotation)
        _put_feature(coefficients + stride + 9 * (joint - 1), r0, r1, r2, r3, r4, r5, r6, r7, r8)
        x, y, z = _joint(identity_joints, joint_directions, weights, joint, stride, e, e < stride)
        u, v, w = rotated(r0, r1, r2, r3, r4, r5, r6, r7, r8, x, y, z)
        to = transforms + TRANSFORM * joint
        _put_transform(to, r0, r1, r2, r3, r4, r5, r6, r7, r8, x + t0 - u, y + t1 - v, z + t2 - w)


@triton.jit
def _blended(weights, transforms, i, k: tl.constexpr, mask):
    """Value k of each vertex's transform: those of the joints by the vertex's weights."""
    value = tl.load(weights + 5 * i, mask=mask, other=0.0) * tl.load(transforms + k)
    for joint in tl.static_range(1, 5):
        value += tl.load(weights + 5 * i + joint, mask=mask, other=0.0) * tl.load(transforms + TRANSFORM * joint + k)
    return value


@triton.jit(do_not_specialize=["count"])
def blend(shape, weights, transforms, eyelids, eyelid_directions, count, vertices, BLOCK: tl.constexpr):
    """Linear blend skinning of `shape` [V, 3] by weights [V, 5], and the eyelids' shapes [2, V, 3] after it."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < count
    x, y, z = (
        tl.load(shape + 3 * i, mask=here, other=0.0),
        tl.load(shape + 3 * i + 1, mask=here, other=0.0),
        tl.load(shape + 3 * i + 2, mask=here, other=0.0),
    )
    left, right = tl.load(eyelids), tl.load(eyelids + 1)
    for row in tl.static_range(3):
        value = _blended(weights, transforms, i, 3 * row, here) * x
        value += _blended(weights, transforms, i, 3 * row + 1, here) * y
        value += _blended(weights, transforms, i, 3 * row + 2, here) * z
        value += _blended(weights, transforms, i, 9 + row, here)
        value += left * tl.load(eyelid_directions + 3 * i + row, mask=here, other=0.0)
        value += right * tl.load(eyelid_directions + 3 * (count + i) + row, mask=here, other=0.0)
        tl.store(vertices + 3 * i + row, value, mask=here)
