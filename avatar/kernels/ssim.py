"""D-SSIM and its gradient as separable convolutions: two launches for the value, two more for the gradient.

Of x and y, two images times a mask, four maps are smoothed: x, d = x - y, x^2 + y^2 and d^2. With m, e, q and f for the
smoothed ones and n = m - e for y's,

    SSIM = (1 - e^2 / (m^2 + n^2 + C1)) (1 - (f - e^2) / (q - m^2 - n^2 + C2)),

which is the usual quotient, but what 1 - SSIM is made of is small where the images are alike, and does not cancel.
"""

import triton
import triton.language as tl

WINDOW = tl.constexpr(11)
C1, C2 = tl.constexpr(0.01**2), tl.constexpr(0.03**2)


@triton.jit(do_not_specialize=["height", "width"])
def smooth_rows(image, target, mask, window, height, width, maps, BLOCK: tl.constexpr):
    """The four maps smoothed along the rows: maps [4, H, W - 10, 3]; window [11]; mask [H, W]."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    across = width - (WINDOW - 1)
    size = height * across * 3
    here = i < size
    row, rest = i // (3 * across), i % (3 * across)
    column, channel = rest // 3, rest % 3
    zero = tl.zeros([BLOCK], tl.float32)
    m, e, q, f = zero, zero, zero, zero
    for k in tl.static_range(WINDOW):
        pixel = row * width + column + k
        weight, shown = tl.load(window + k), tl.load(mask + pixel, mask=here, other=0.0)
        x = tl.load(image + 3 * pixel + channel, mask=here, other=0.0) * shown
        y = tl.load(target + 3 * pixel + channel, mask=here, other=0.0) * shown
        d = x - y
        m += weight * x
        e += weight * d
        q += weight * (x * x + y * y)
        f += weight * (d * d)
    tl.store(maps + i, m, mask=here)
    tl.store(maps + size + i, e, mask=here)
    tl.store(maps + 2 * size + i, q, mask=here)
    tl.store(maps + 3 * size + i, f, mask=here)


@triton.jit(do_not_specialize=["height", "width"])
def compare(maps, window, height, width, partial, slopes, GRADIENT: tl.constexpr, BLOCK: tl.constexpr):
    """Smooth the maps along the columns too, and write each program's share of the sum of 1 - SSIM, partial [programs].

    With GRADIENT slopes [3, H - 10, W - 10, 3]: of SSIM by m + e, q and f.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    line = 3 * (width - (WINDOW - 1))
    size, windows = height * line, (height - (WINDOW - 1)) * line
    here = i < windows
    zero = tl.zeros([BLOCK], tl.float32)
    m, e, q, f = zero, zero, zero, zero
    for k in tl.static_range(WINDOW):
        weight, at = tl.load(window + k), maps + k * line + i
        m += weight * tl.load(at, mask=here, other=0.0)
        e += weight * tl.load(at + size, mask=here, other=0.0)
        q += weight * tl.load(at + 2 * size, mask=here, other=0.0)
        f += weight * tl.load(at + 3 * size, mask=here, other=0.0)
    n = m - e
    brightness, contrast = m * m + n * n + C1, q - m * m - n * n + C2
    dark, flat = e * e / brightness, (f - e * e) / contrast  # 1 - the two factors of SSIM
    tl.store(partial + tl.program_id(0), tl.sum(tl.where(here, dark + flat - dark * flat, 0.0), 0))
    if GRADIENT:
        light, structure = 1.0 - dark, 1.0 - flat
        by_m = 2.0 * (m + n) * (structure * dark / brightness - light * flat / contrast)
        by_e = structure * (-2.0 * e - 2.0 * n * dark) / brightness + light * (2.0 * e + 2.0 * n * flat) / contrast
        tl.store(slopes + i, by_m + by_e, mask=here)
        tl.store(slopes + windows + i, light * flat / contrast, mask=here)
        tl.store(slopes + 2 * windows + i, -light / contrast, mask=here)


@triton.jit(do_not_specialize=["height", "width"])
def spread_columns(slopes, window, height, width, maps, BLOCK: tl.constexpr):
    """The transposed smoothing along the columns: slopes [3, H - 10, W - 10, 3] -> maps [3, H, W - 10, 3]."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    line = 3 * (width - (WINDOW - 1))
    size, windows = height * line, (height - (WINDOW - 1)) * line
    here = i < size
    zero = tl.zeros([BLOCK], tl.float32)
    a, b, c = zero, zero, zero
    for k in tl.static_range(WINDOW):
        weight, at = tl.load(window + k), i - k * line
        inside = here & (at >= 0) & (at < windows)
        a += weight * tl.load(slopes + at, mask=inside, other=0.0)
        b += weight * tl.load(slopes + windows + at, mask=inside, other=0.0)
        c += weight * tl.load(slopes + 2 * windows + at, mask=inside, other=0.0)
    tl.store(maps + i, a, mask=here)
    tl.store(maps + size + i, b, mask=here)
    tl.store(maps + 2 * size + i, c, mask=here)


@triton.jit(do_not_specialize=["height", "width"])
def spread_rows(maps, image, target, mask, window, scale, height, width, gradient, BLOCK: tl.constexpr):
    """The transposed smoothing along the rows, and from there the image's gradient [H, W, 3], times `scale`."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < 3 * height * width
    pixel, channel = i // 3, i % 3
    row, column = pixel // width, pixel % width
    across = width - (WINDOW - 1)
    size = height * across * 3
    zero = tl.zeros([BLOCK], tl.float32)
    a, b, c = zero, zero, zero
    for k in tl.static_range(WINDOW):
        weight, from_column = tl.load(window + k), column - k
        inside = here & (from_column >= 0) & (from_column < across)
        at = maps + 3 * (row * across + from_column) + channel
        a += weight * tl.load(at, mask=inside, other=0.0)
        b += weight * tl.load(at + size, mask=inside, other=0.0)
        c += weight * tl.load(at + 2 * size, mask=inside, other=0.0)
    shown = tl.load(mask + pixel, mask=here, other=0.0)
    x = tl.load(image + i, mask=here, other=0.0) * shown
    y = tl.load(target + i, mask=here, other=0.0) * shown
    tl.store(gradient + i, scale * shown * (a + 2.0 * (x * b + (x - y) * c)), mask=here)
