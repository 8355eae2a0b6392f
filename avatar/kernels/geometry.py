"""From a Gaussian to its ellipse on the image plane, in float64, as both directions of the projection need it.

Written out, product by product and in the order of the other backends: a depth must round alike in all of them, or
near-ties would be drawn in another order. Zwicker et al., "EWA splatting" (2002).
"""

import triton
import triton.language as tl

from avatar.kernels.load_store import load3, load4

# Where `pose` holds what, float64; `avatar.splat.pose` makes it.
TRANSLATION = tl.constexpr(9)  # behind the nine elements of the rotation, row by row
POSE_VALUES = tl.constexpr(12)
# Where `intrinsics` holds what, float64; `avatar.splat.gpu` makes it of a camera and two options.
FX, FY, CX, CY = tl.constexpr(0), tl.constexpr(1), tl.constexpr(2), tl.constexpr(3)
SLOPE_X, SLOPE_Y = tl.constexpr(4), tl.constexpr(6)  # lowest and highest, two each
BLUR, NEAR = tl.constexpr(8), tl.constexpr(9)

WHITENING = tl.constexpr(0.84932180028801904272)  # the root of log2(e) / 2


@triton.jit
def not_finite(x):
    """On the bits of a float32, so that no optimisation can decide it."""
    bits = x.to(tl.int32, bitcast=True)
    return (bits & 0x7F800000) == 0x7F800000


@triton.jit
def pose_is_not_finite(pose):
    """On the bits of its float64 values."""
    found = False
    for k in tl.static_range(POSE_VALUES):
        bits = tl.load(pose + k).to(tl.int64, bitcast=True)
        found |= (bits & 0x7FF0000000000000) == 0x7FF0000000000000
    return found


@triton.jit
def dot3(ax, ay, az, bx, by, bz):
    return ax * bx + ay * by + az * bz


@triton.jit
def in_camera(pose, mean_x, mean_y, mean_z):
    """The centre in camera coordinates; the third is the depth that splats are sorted by."""
    x, y, z = mean_x.to(tl.float64), mean_y.to(tl.float64), mean_z.to(tl.float64)
    p_x = dot3(tl.load(pose), tl.load(pose + 1), tl.load(pose + 2), x, y, z) + tl.load(pose + TRANSLATION)
    p_y = dot3(tl.load(pose + 3), tl.load(pose + 4), tl.load(pose + 5), x, y, z) + tl.load(pose + TRANSLATION + 1)
    p_z = dot3(tl.load(pose + 6), tl.load(pose + 7), tl.load(pose + 8), x, y, z) + tl.load(pose + TRANSLATION + 2)
    return p_x, p_y, p_z


@triton.jit
def clamped_slope(intrinsics, limits: tl.constexpr, slope):
    """The slope within its limits, and whether it was there already."""
    low, high = tl.load(intrinsics + limits), tl.load(intrinsics + limits + 1)
    clamped = tl.where(slope < low, low, tl.where(slope > high, high, slope))
    return clamped, (slope >= low) & (slope <= high)


@triton.jit
def image_rows(pose, intrinsics, slope_x, slope_y, inv_z):
    """d(image) / d(world), the Jacobian times the camera's rotation: two rows of three."""
    scale_x, scale_y = tl.load(intrinsics + FX) * inv_z, tl.load(intrinsics + FY) * inv_z
    r6, r7, r8 = tl.load(pose + 6), tl.load(pose + 7), tl.load(pose + 8)
    t00 = scale_x * (tl.load(pose) - slope_x * r6)
    t01 = scale_x * (tl.load(pose + 1) - slope_x * r7)
    t02 = scale_x * (tl.load(pose + 2) - slope_x * r8)
    t10 = scale_y * (tl.load(pose + 3) - slope_y * r6)
    t11 = scale_y * (tl.load(pose + 4) - slope_y * r7)
    t12 = scale_y * (tl.load(pose + 5) - slope_y * r8)
    return t00, t01, t02, t10, t11, t12


@triton.jit
def unit_quaternion(quats, index, mask):
    """A quaternion (w, x, y, z) divided by its length, and one over that; the identity and 0 where all of it is zero."""
    w, x, y, z = load4(quats, index, mask)
    w, x, y, z = w.to(tl.float64), x.to(tl.float64), y.to(tl.float64), z.to(tl.float64)
    squared = w * w + x * x + y * y + z * z
    is_zero = squared <= 0.0
    inv_length = tl.where(is_zero, 0.0, 1.0 / tl.sqrt(tl.where(is_zero, 1.0, squared)))
    return tl.where(is_zero, 1.0, w * inv_length), x * inv_length, y * inv_length, z * inv_length, inv_length


@triton.jit
def rotation_of(w, x, y, z):
    """The rotation matrix of a unit quaternion, row by row."""
    r00, r01, r02 = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    r10, r11, r12 = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    r20, r21, r22 = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return r00, r01, r02, r10, r11, r12, r20, r21, r22


@triton.jit
def load_scales(scales, index, mask):
    x, y, z = load3(scales, index, mask)
    return x.to(tl.float64), y.to(tl.float64), z.to(tl.float64)


@triton.jit
def covariance(intrinsics, f00, f01, f02, f10, f11, f12):
    """Of the splat with F = (f0; f1) as root: F F^T + blur. Gives the area |f0 x f1| with its vector, xx, xy, yy and det.

    The determinant by Cauchy-Binet is a sum of squares: it does not cancel for thin splats.
    """
    blur = tl.load(intrinsics + BLUR)
    c0, c1, c2 = f01 * f12 - f02 * f11, f02 * f10 - f00 * f12, f00 * f11 - f01 * f10
    area2 = dot3(c0, c1, c2, c0, c1, c2)
    xx, yy = dot3(f00, f01, f02, f00, f01, f02), dot3(f10, f11, f12, f10, f11, f12)
    det = area2 + blur * (xx + yy) + blur * blur
    return c0, c1, c2, tl.sqrt(area2), xx + blur, dot3(f00, f01, f02, f10, f11, f12), yy + blur, det


@triton.jit
def view_direction(pose, mean_x, mean_y, mean_z):
    """The unit vector from the camera to the centre, float32, and one over their distance, float64."""
    t0, t1, t2 = tl.load(pose + TRANSLATION), tl.load(pose + TRANSLATION + 1), tl.load(pose + TRANSLATION + 2)
    # Minus where the camera is, -R^T t.
    x = mean_x.to(tl.float64) + dot3(tl.load(pose), tl.load(pose + 3), tl.load(pose + 6), t0, t1, t2)
    y = mean_y.to(tl.float64) + dot3(tl.load(pose + 1), tl.load(pose + 4), tl.load(pose + 7), t0, t1, t2)
    z = mean_z.to(tl.float64) + dot3(tl.load(pose + 2), tl.load(pose + 5), tl.load(pose + 8), t0, t1, t2)
    squared = dot3(x, y, z, x, y, z)
    inv_distance = 1.0 / tl.sqrt(tl.where(squared > 0.0, squared, 1.0))
    return (
        (x * inv_distance).to(tl.float32),
        (y * inv_distance).to(tl.float32),
        (z * inv_distance).to(tl.float32),
        inv_distance,
    )
