"""Colour from real spherical harmonics of degree 0 to 3: `avatar.splat.sh` states the functions and their source."""

import triton
import triton.language as tl

C0 = tl.constexpr(0.28209479177387814)
C1 = tl.constexpr(0.4886025119029199)
C2, C20 = tl.constexpr(1.0925484305920792), tl.constexpr(0.31539156525252005)
C33, C32, C31 = tl.constexpr(0.5900435899266435), tl.constexpr(2.890611442640554), tl.constexpr(0.4570457994644658)
C30 = tl.constexpr(0.3731763325901154)


# The degree is a number that the kernels are told, not one that they are compiled for: it rises during a training. The
# functions of higher degrees are multiplied by 0.


@triton.jit
def used(degree, least: tl.constexpr):
    return (degree >= least).to(tl.float32)


@triton.jit
def _add(red, green, blue, basis, sh, k: tl.constexpr, mask):
    red = red + basis * tl.load(sh + 3 * k, mask=mask, other=0.0)
    green = green + basis * tl.load(sh + 3 * k + 1, mask=mask, other=0.0)
    blue = blue + basis * tl.load(sh + 3 * k + 2, mask=mask, other=0.0)
    return red, green, blue


@triton.jit
def colour(sh, x, y, z, degree, STORED: tl.constexpr, mask):
    """The colour before it is clamped at 0; `sh` points at each splat's first coefficient, (x, y, z) is a unit vector."""
    half = tl.zeros_like(x) + 0.5
    red, green, blue = _add(half, half, half, tl.zeros_like(x) + C0, sh, 0, mask)
    if STORED >= 4:
        on = used(degree, 1)
        red, green, blue = _add(red, green, blue, -y * C1 * on, sh, 1, mask)
        red, green, blue = _add(red, green, blue, z * C1 * on, sh, 2, mask)
        red, green, blue = _add(red, green, blue, -x * C1 * on, sh, 3, mask)
    if STORED >= 9:
        on = used(degree, 2)
        red, green, blue = _add(red, green, blue, x * y * C2 * on, sh, 4, mask)
        red, green, blue = _add(red, green, blue, -y * z * C2 * on, sh, 5, mask)
        red, green, blue = _add(red, green, blue, (2 * z * z - x * x - y * y) * C20 * on, sh, 6, mask)
        red, green, blue = _add(red, green, blue, -x * z * C2 * on, sh, 7, mask)
        red, green, blue = _add(red, green, blue, (x * x - y * y) * (0.5 * C2) * on, sh, 8, mask)
    if STORED >= 16:
        on = used(degree, 3)
        red, green, blue = _add(red, green, blue, -y * (3 * x * x - y * y) * C33 * on, sh, 9, mask)
        red, green, blue = _add(red, green, blue, x * y * z * C32 * on, sh, 10, mask)
        red, green, blue = _add(red, green, blue, -y * (4 * z * z - x * x - y * y) * C31 * on, sh, 11, mask)
        red, green, blue = _add(red, green, blue, z * (2 * z * z - 3 * x * x - 3 * y * y) * C30 * on, sh, 12, mask)
        red, green, blue = _add(red, green, blue, -x * (4 * z * z - x * x - y * y) * C31 * on, sh, 13, mask)
        red, green, blue = _add(red, green, blue, z * (x * x - y * y) * (0.5 * C32) * on, sh, 14, mask)
        red, green, blue = _add(red, green, blue, -x * (x * x - 3 * y * y) * C33 * on, sh, 15, mask)
    return red, green, blue


@triton.jit
def _through(sh, grad_sh, k: tl.constexpr, basis, red, green, blue, mask):
    """Write the gradient of coefficient k; gives that of its basis function. `red` and so on: of the colour."""
    tl.store(grad_sh + 3 * k, basis * red, mask=mask)
    tl.store(grad_sh + 3 * k + 1, basis * green, mask=mask)
    tl.store(grad_sh + 3 * k + 2, basis * blue, mask=mask)
    grad = red * tl.load(sh + 3 * k, mask=mask, other=0.0)
    grad += green * tl.load(sh + 3 * k + 1, mask=mask, other=0.0)
    return grad + blue * tl.load(sh + 3 * k + 2, mask=mask, other=0.0)


@triton.jit
def colour_backward(sh, grad_sh, x, y, z, red, green, blue, degree, STORED: tl.constexpr, mask):
    """Write the gradients of all STORED coefficients; gives that of (x, y, z), its components taken as independent."""
    _through(sh, grad_sh, 0, tl.zeros_like(x) + C0, red, green, blue, mask)
    dx, dy, dz = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    if STORED >= 4:
        on = used(degree, 1)
        dy -= _through(sh, grad_sh, 1, -y * C1 * on, red, green, blue, mask) * C1 * on
        dz += _through(sh, grad_sh, 2, z * C1 * on, red, green, blue, mask) * C1 * on
        dx -= _through(sh, grad_sh, 3, -x * C1 * on, red, green, blue, mask) * C1 * on
    if STORED >= 9:
        on = used(degree, 2)
        g = _through(sh, grad_sh, 4, x * y * C2 * on, red, green, blue, mask) * C2 * on
        dx += y * g
        dy += x * g
        g = _through(sh, grad_sh, 5, -y * z * C2 * on, red, green, blue, mask) * C2 * on
        dy -= z * g
        dz -= y * g
        g = _through(sh, grad_sh, 6, (2 * z * z - x * x - y * y) * C20 * on, red, green, blue, mask) * (2 * C20) * on
        dx -= x * g
        dy -= y * g
        dz += 2 * z * g
        g = _through(sh, grad_sh, 7, -x * z * C2 * on, red, green, blue, mask) * C2 * on
        dx -= z * g
        dz -= x * g
        g = _through(sh, grad_sh, 8, (x * x - y * y) * (0.5 * C2) * on, red, green, blue, mask) * C2 * on
        dx += x * g
        dy -= y * g
    if STORED >= 16:
        on = used(degree, 3)
        g = _through(sh, grad_sh, 9, -y * (3 * x * x - y * y) * C33 * on, red, green, blue, mask) * (3 * C33) * on
        dx -= 2 * x * y * g
        dy -= (x * x - y * y) * g
        g = _through(sh, grad_sh, 10, x * y * z * C32 * on, red, green, blue, mask) * C32 * on
        dx += y * z * g
        dy += x * z * g
        dz += x * y * g
        g = _through(sh, grad_sh, 11, -y * (4 * z * z - x * x - y * y) * C31 * on, red, green, blue, mask) * C31 * on
        dx += 2 * x * y * g
        dy -= (4 * z * z - x * x - 3 * y * y) * g
        dz -= 8 * y * z * g
        g = (
            _through(sh, grad_sh, 12, z * (2 * z * z - 3 * x * x - 3 * y * y) * C30 * on, red, green, blue, mask)
            * (3 * C30)
            * on
        )
        dx -= 2 * x * z * g
        dy -= 2 * y * z * g
        dz += (2 * z * z - x * x - y * y) * g
        g = _through(sh, grad_sh, 13, -x * (4 * z * z - x * x - y * y) * C31 * on, red, green, blue, mask) * C31 * on
        dx -= (4 * z * z - 3 * x * x - y * y) * g
        dy += 2 * x * y * g
        dz -= 8 * x * z * g
        g = _through(sh, grad_sh, 14, z * (x * x - y * y) * (0.5 * C32) * on, red, green, blue, mask) * C32 * on
        dx += x * z * g
        dy -= y * z * g
        dz += 0.5 * (x * x - y * y) * g
        g = _through(sh, grad_sh, 15, -x * (x * x - 3 * y * y) * C33 * on, red, green, blue, mask) * (3 * C33) * on
        dx -= (x * x - y * y) * g
        dy += 2 * x * y * g
    return dx, dy, dz
