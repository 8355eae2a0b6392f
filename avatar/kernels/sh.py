"""Colour from real spherical harmonics of degree 0 to 3: `avatar.splat.sh` states the functions and their source."""

import triton
import triton.language as tl

C0 = tl.constexpr(0.28209479177387814)
C1 = tl.constexpr(0.4886025119029199)
C2, C20 = tl.constexpr(1.0925484305920792), tl.constexpr(0.31539156525252005)
C33, C32, C31 = tl.constexpr(0.5900435899266435), tl.constexpr(2.890611442640554), tl.constexpr(0.4570457994644658)
C30 = tl.constexpr(0.3731763325901154)


# The degree is an argument of the kernels, not a constant that they are compiled for: it rises during a training. The
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
def _at(coefficients, k: tl.constexpr, mask):
    return tl.load(coefficients + 3 * k, mask=mask, other=0.0)


@triton.jit
def _through(gradients, k: tl.constexpr, basis, by, mask):
    tl.store(gradients + 3 * k, basis * by, mask=mask)


@triton.jit
def colour_backward(sh, grad_sh, x, y, z, by_red, by_green, by_blue, degree, STORED: tl.constexpr, mask, store_mask):
    """Write the gradients of all STORED coefficients, zeros beyond `mask`; gives that of (x, y, z), its components taken
    as independent. `by_red` and so on: the gradients of the colour, where it is not clamped.

    A loop over the channels: one after the other they took the compilers six times as long.
    """
    zero = tl.zeros_like(x)
    g1, g2, g3, g4, g5, g6, g7, g8 = zero, zero, zero, zero, zero, zero, zero, zero
    g9, g10, g11, g12, g13, g14, g15 = zero, zero, zero, zero, zero, zero, zero
    if STORED >= 4:
        on = used(degree, 1)
        b1, b2, b3 = -y * C1 * on, z * C1 * on, -x * C1 * on
    if STORED >= 9:
        on = used(degree, 2)
        b4, b5, b7 = x * y * C2 * on, -y * z * C2 * on, -x * z * C2 * on
        b6, b8 = (2 * z * z - x * x - y * y) * C20 * on, (x * x - y * y) * (0.5 * C2) * on
    if STORED >= 16:
        on = used(degree, 3)
        b9, b10 = -y * (3 * x * x - y * y) * C33 * on, x * y * z * C32 * on
        b11, b12 = -y * (4 * z * z - x * x - y * y) * C31 * on, z * (2 * z * z - 3 * x * x - 3 * y * y) * C30 * on
        b13, b14 = -x * (4 * z * z - x * x - y * y) * C31 * on, z * (x * x - y * y) * (0.5 * C32) * on
        b15 = -x * (x * x - 3 * y * y) * C33 * on
    for channel in range(3):
        c, grad = sh + channel, grad_sh + channel
        upstream = tl.where(channel == 0, by_red, tl.where(channel == 1, by_green, by_blue))
        value = zero + 0.5 + (zero + C0) * _at(c, 0, mask)
        if STORED >= 4:
            c1, c2, c3 = _at(c, 1, mask), _at(c, 2, mask), _at(c, 3, mask)
            value = value + b1 * c1 + b2 * c2 + b3 * c3
        if STORED >= 9:
            c4, c5, c6, c7, c8 = _at(c, 4, mask), _at(c, 5, mask), _at(c, 6, mask), _at(c, 7, mask), _at(c, 8, mask)
            value = value + b4 * c4 + b5 * c5 + b6 * c6 + b7 * c7 + b8 * c8
        if STORED >= 16:
            c9, c10, c11, c12 = _at(c, 9, mask), _at(c, 10, mask), _at(c, 11, mask), _at(c, 12, mask)
            c13, c14, c15 = _at(c, 13, mask), _at(c, 14, mask), _at(c, 15, mask)
            value = value + b9 * c9 + b10 * c10 + b11 * c11 + b12 * c12 + b13 * c13 + b14 * c14 + b15 * c15
        by = tl.where(value > 0.0, upstream, 0.0).to(tl.float32)
        _through(grad, 0, zero + C0, by, store_mask)
        if STORED >= 4:
            _through(grad, 1, b1, by, store_mask)
            _through(grad, 2, b2, by, store_mask)
            _through(grad, 3, b3, by, store_mask)
            g1, g2, g3 = g1 + by * c1, g2 + by * c2, g3 + by * c3
        if STORED >= 9:
            _through(grad, 4, b4, by, store_mask)
            _through(grad, 5, b5, by, store_mask)
            _through(grad, 6, b6, by, store_mask)
            _through(grad, 7, b7, by, store_mask)
            _through(grad, 8, b8, by, store_mask)
            g4, g5, g6, g7, g8 = g4 + by * c4, g5 + by * c5, g6 + by * c6, g7 + by * c7, g8 + by * c8
        if STORED >= 16:
            _through(grad, 9, b9, by, store_mask)
            _through(grad, 10, b10, by, store_mask)
            _through(grad, 11, b11, by, store_mask)
            _through(grad, 12, b12, by, store_mask)
            _through(grad, 13, b13, by, store_mask)
            _through(grad, 14, b14, by, store_mask)
            _through(grad, 15, b15, by, store_mask)
            g9, g10, g11, g12 = g9 + by * c9, g10 + by * c10, g11 + by * c11, g12 + by * c12
            g13, g14, g15 = g13 + by * c13, g14 + by * c14, g15 + by * c15

    dx, dy, dz = zero, zero, zero
    if STORED >= 4:
        on = used(degree, 1)
        dy -= g1 * C1 * on
        dz += g2 * C1 * on
        dx -= g3 * C1 * on
    if STORED >= 9:
        on = used(degree, 2)
        g = g4 * C2 * on
        dx += y * g
        dy += x * g
        g = g5 * C2 * on
        dy -= z * g
        dz -= y * g
        g = g6 * (2 * C20) * on
        dx -= x * g
        dy -= y * g
        dz += 2 * z * g
        g = g7 * C2 * on
        dx -= z * g
        dz -= x * g
        g = g8 * C2 * on
        dx += x * g
        dy -= y * g
    if STORED >= 16:
        on = used(degree, 3)
        g = g9 * (3 * C33) * on
        dx -= 2 * x * y * g
        dy -= (x * x - y * y) * g
        g = g10 * C32 * on
        dx += y * z * g
        dy += x * z * g
        dz += x * y * g
        g = g11 * C31 * on
        dx += 2 * x * y * g
        dy -= (4 * z * z - x * x - 3 * y * y) * g
        dz -= 8 * y * z * g
        g = g12 * (3 * C30) * on
        dx -= 2 * x * z * g
        dy -= 2 * y * z * g
        dz += (2 * z * z - x * x - y * y) * g
        g = g13 * C31 * on
        dx -= (4 * z * z - 3 * x * x - y * y) * g
        dy += 2 * x * y * g
        dz -= 8 * x * z * g
        g = g14 * C32 * on
        dx += x * z * g
        dy -= y * z * g
        dz += 0.5 * (x * x - y * y) * g
        g = g15 * (3 * C33) * on
        dx -= (x * x - y * y) * g
        dy += 2 * x * y * g
    return dx, dy, dz
