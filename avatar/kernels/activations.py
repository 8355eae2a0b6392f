"""Activations and quaternions, as `avatar.gaussians.apply_offsets` uses them."""

import triton
import triton.language as tl

SMALLEST_NORM = tl.constexpr(1e-12)  # of torch.nn.functional.normalize


@triton.jit
def tanh(x):
    """Within a few units in the last place over the whole range; the polynomial is that of tanhf in the Cephes library."""
    size, z = tl.abs(x), x * x
    p = z * -5.70498872745e-3 + 2.06390887954e-2
    p = p * z - 5.37397155531e-2
    p = p * z + 1.33314422036e-1
    p = p * z - 3.33332819422e-1
    far = 1.0 - 2.0 / (tl.exp(2.0 * size) + 1.0)  # without a minimum: that would not give NaN for NaN
    return tl.where(size < 0.625, p * z * x + x, tl.where(x < 0.0, -far, far))


@triton.jit
def sigmoid(x):
    return 1.0 / (1.0 + tl.exp(-x))


@triton.jit
def tanh_slope(y):
    """The derivative of tanh where its value is y."""
    return (1.0 - y) * (1.0 + y)


@triton.jit
def product(aw, ax, ay, az, bw, bx, by, bz):
    """Hamilton product a b, (w, x, y, z)."""
    w = aw * bw - ax * bx - ay * by - az * bz
    x = aw * bx + ax * bw + ay * bz - az * by
    y = aw * by - ax * bz + ay * bw + az * bx
    z = aw * bz + ax * by - ay * bx + az * bw
    return w, x, y, z


@triton.jit
def normalized(w, x, y, z):
    """A quaternion divided by its norm, or by SMALLEST_NORM if that is larger; with one over what it was divided by."""
    norm = tl.sqrt_rn(w * w + x * x + y * y + z * z)
    inverse = 1.0 / tl.maximum(norm, SMALLEST_NORM)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse, norm >= SMALLEST_NORM


@triton.jit
def normalized_backward(w, x, y, z, inverse, is_long, by_w, by_x, by_y, by_z):
    """The gradient of what `normalized` took, from that of what it gave."""
    along = tl.where(is_long, w * by_w + x * by_x + y * by_y + z * by_z, 0.0)
    return (
        (by_w - w * along) * inverse,
        (by_x - x * along) * inverse,
        (by_y - y * along) * inverse,
        (by_z - z * along) * inverse,
    )
