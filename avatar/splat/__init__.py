"""Drawing of Gaussians, with colours or with features: functions with one meaning on every backend."""

from __future__ import annotations

import math
import struct
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.compute.device import on_gpu
from avatar.compute.gpu_functions import gpu_function
from avatar.splat.cpu import CannotDraw, splat_cpu
from avatar.splat.gpu_buffers import checked_drawings, is_checked
from avatar.splat.options import Options, check_region
from avatar.splat.reference import splat_reference
from avatar.splat.sh import sh_degree_of
from avatar.tensors import check_finite, check_shapes
from avatar.types import Camera, FeatureGaussians, Gaussians, Rendering

__all__ = ["CannotDraw", "checked_drawings", "is_checked", "splat", "splat_features"]

Backend = Literal["cpu", "gpu", "reference"]

MAX_SIDE = 1 << 15  # pixels
MAX_GPU_PIXELS = 2**31 // 3  # the kernels count the values of a picture in 32 bits
T_MIN = 1e-30
NEAR = 0.01  # metres


def splat(
    gaussians: Gaussians,
    camera: Camera,
    background: Float[Tensor, " 3"],
    *,
    backend: Backend | None = None,
    sh_degree: int | None = None,
    alpha_min: float = 1 / 255,
    alpha_max: float = 0.999,
    t_min: float = 1e-4,
    blur: float = 0.3,
    near: float = NEAR,
    antialiased: bool = False,
    region: tuple[slice, slice] | None = None,
) -> Rendering:
    """Draw 3D Gaussians over a background; differentiable in all five fields of `gaussians`, in `background`, and in the
    camera's pose, `camera.R_cam_world` and `camera.t_cam_world`.

    backend      "cpu": C++, float32, multithreaded (torch.get_num_threads(), or the variable AVATAR_THREADS);
                 "gpu": Triton, float32, tensors on a GPU (or on the CPU, with TRITON_INTERPRET=1, slowly, for tests);
                 "reference": plain torch in float64 whatever the dtype, any device, slow, the definition of the result;
                 None: "gpu" or "cpu", by where `gaussians.means` is
    sh_degree    colour from the first (sh_degree + 1)^2 coefficients only; None: all. The others get zero gradient
    alpha_min    a splat is skipped at pixels where its alpha is below this, and everywhere if its opacity is; in [0, 1)
    alpha_max    alpha is clamped to this, with zero gradient where it is; in (0, 0.9999]
    t_min        the splat that would bring the transmittance of a pixel below this is not drawn, nor any after it; in
                 [0, 1). Below 1e-30 it counts as 1e-30: float32 ends soon after, and what lies behind could not be seen
    blur         pixels^2 added to both variances of a projected splat, so that none falls between pixels; >= 0
    near         splats whose centre is nearer than this along the optical axis are left out; metres, > 0
    antialiased  multiply the opacity by sqrt(det / det with blur), so that the blur adds no light (Mip-Splatting)

    region       draw only these rows and columns of the image, each a slice of consecutive pixels within it; None: all.
                 Inside, every bit is that of the whole drawing; outside, the image shows the background and alpha is 0,
                 so that those pixels have a gradient in `background` alone. Time is spent on the region only

    Splats are drawn by depth of the centre and, at equal depth, by index; pixel centres are at + 0.5; every pixel in
    which a splat reaches alpha_min is drawn. Colour is max(SH + 0.5, 0) along the direction from the camera to the mean.
    The Jacobian of the projection is taken at a slope clamped to 0.3 tan(fov / 2) outside the image, as in gsplat. A
    zero quaternion is the identity, with zero gradient. The sign of a scale has no effect.

    The gradient in the pose is that of any 3 x 3 matrix R and vector t: with p = R m + t for each mean m,
    dL/dR = sum of (dL/dp) m^T and dL/dt = sum of dL/dp, plus what R changes in the covariance J R Sigma R^T J^T, and both
    in the direction m + R^T t of the colour. It is computed where R or t requires it. R and t are on the CPU or where the
    Gaussians are. Nothing waits for a pose on a GPU; the backward pass waits for the gradient of a pose on the CPU.

    Image, alpha and gradients of the "cpu" backend are the same to the last bit for any number of threads.
    Raises TypeError or ValueError, naming the argument, for a wrong type, shape, dtype or device; CannotDraw, a ValueError,
    for non-finite values (with count and first index), colours that overflow and scenes beyond the kernel's limits. On
    the "gpu" backend image and alpha are NaN instead wherever it draws, also where the scene needs more memory than the
    first of its kind fixed; within `checked_drawings()` it waits for the GPU, and raises.
    """
    pixels = check_region(region, camera.width, camera.height)
    options = Options(sh_degree, alpha_min, alpha_max, t_min, blur, near, antialiased, pixels)
    return _draw(backend, gaussians, camera, background, options)


def splat_features(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, " N"],
    features: Float[Tensor, "N C"],
    camera: Camera,
    background: Float[Tensor, " C"],
    *,
    backend: Backend | None = None,
    alpha_min: float = 1 / 255,
    alpha_max: float = 0.999,
    t_min: float = 1e-4,
    blur: float = 0.3,
    near: float = NEAR,
    antialiased: bool = False,
    region: tuple[slice, slice] | None = None,
) -> Rendering:
    """Draw C >= 1 values a Gaussian, without a view direction and without a clamp, over a background of C channels.

    means       metres, world;  quats  (w, x, y, z), of any length;  scales  metres;  opacities  in [0, 1]
    features    finite, of any size and sign

    Image [H, W, C] and alpha [H, W]. Differentiable in all six tensors and in the camera's pose. A splat's alpha at a
    pixel is found once for all channels ("gpu": for 32). Everything else, options and errors included, is as of `splat`,
    whose image this is where its colours are the features.
    """
    gaussians = FeatureGaussians(means, quats, scales, opacities, features)
    pixels = check_region(region, camera.width, camera.height)
    options = Options(None, alpha_min, alpha_max, t_min, blur, near, antialiased, pixels)
    return _draw(backend, gaussians, camera, background, options)


def _draw(
    backend: Backend | None,
    gaussians: Gaussians | FeatureGaussians,
    camera: Camera,
    background: Tensor,
    options: Options,
) -> Rendering:
    means: Any = gaussians.means
    chosen = backend or ("gpu" if isinstance(means, Tensor) and on_gpu(means) else "cpu")
    options = check_options(gaussians, camera, background, chosen, options)
    if chosen == "reference":
        try:
            check_finite(**gaussians._asdict(), background=background)
        except ValueError as error:
            raise CannotDraw(str(error)) from None
        return splat_reference(gaussians, camera, background, options)
    return (gpu_function("splat") if chosen == "gpu" else splat_cpu)(gaussians, camera, background, options)


def check_options(
    gaussians: Gaussians | FeatureGaussians, camera: Camera, background: Tensor, backend: str, options: Options
) -> Options:
    """Check everything, and give the options as the backends take them."""
    if isinstance(gaussians, Gaussians):
        shown, channels = {"sh": (gaussians.sh, "N K 3")}, "3"
    else:
        shown, channels = {"features": (gaussians.features, "N C")}, "C"
    sizes = check_shapes(
        means=(gaussians.means, "N 3"),
        quats=(gaussians.quats, "N 4"),
        scales=(gaussians.scales, "N 3"),
        opacities=(gaussians.opacities, "N"),
        **shown,
        background=(background, channels),
        R_cam_world=(camera.R_cam_world, "3 3"),
        t_cam_world=(camera.t_cam_world, "3"),
    )
    if sizes.get("C") == 0:
        raise ValueError(f"features must have one channel or more, got {list(shown['features'][0].shape)}")
    sh_degree, alpha_min, alpha_max, t_min, blur, near, *_ = options
    _check_dtype_and_device(gaussians, background, backend)
    _check_camera(camera, gaussians.means.device, backend)
    if isinstance(gaussians, Gaussians):
        stored_degree = sh_degree_of(sizes["K"])
        if sh_degree is None:
            sh_degree = stored_degree
        elif not 0 <= sh_degree <= stored_degree:
            raise ValueError(f"sh_degree must be 0 to {stored_degree}, the degree that sh holds, got {sh_degree}")
    if not 0 <= alpha_min < 1:
        raise ValueError(f"alpha_min must be in [0, 1), got {alpha_min}")
    if not 0 < alpha_max <= 0.9999:
        raise ValueError(f"alpha_max must be in (0, 0.9999], got {alpha_max}")
    if not 0 <= t_min < 1:
        raise ValueError(f"t_min must be in [0, 1), got {t_min}")
    if not (blur >= 0 and math.isfinite(blur)):
        raise ValueError(f"blur must be finite and not negative, got {blur}")
    if not (near > 0 and math.isfinite(near)):
        raise ValueError(f"near must be finite and above 0, got {near}")
    # A cut-off means the same float32 value in all backends, so that an alpha that equals it is treated alike.
    alpha_min, alpha_max, t_min = struct.unpack("3f", struct.pack("3f", alpha_min, alpha_max, max(t_min, T_MIN)))
    return options._replace(sh_degree=sh_degree, alpha_min=alpha_min, alpha_max=alpha_max, t_min=t_min)


def _check_dtype_and_device(gaussians: Gaussians | FeatureGaussians, background: Tensor, backend: str) -> None:
    if backend not in ("cpu", "gpu", "reference"):
        raise ValueError(f'backend must be "cpu", "gpu" or "reference", got {backend!r}')
    if backend == "gpu" and not on_gpu(gaussians.means):
        raise ValueError(f'means must be on a GPU for backend "gpu", got {gaussians.means.device}')
    allowed = (torch.float32, torch.float64) if backend == "reference" else (torch.float32,)
    device = torch.device("cpu") if backend == "cpu" else gaussians.means.device
    for name, tensor in (*gaussians._asdict().items(), ("background", background)):
        if tensor.dtype not in allowed:
            wanted = " or ".join(str(dtype).removeprefix("torch.") for dtype in allowed)
            raise TypeError(f'{name} must be {wanted} for backend "{backend}", got {tensor.dtype}')
        if tensor.device != device:
            raise ValueError(f'{name} must be on {device} for backend "{backend}", got {tensor.device}')


def _check_camera(camera: Camera, device: torch.device, backend: str) -> None:
    for name in ("R_cam_world", "t_cam_world"):
        pose = getattr(camera, name)
        if not pose.is_cpu and pose.device != device:
            raise ValueError(f"camera.{name} must be on the cpu or where means are, {device}, got {pose.device}")
        # The "gpu" backend does not wait for a pose that is on a GPU.
        if backend == "reference" or (pose.is_cpu and not all(map(math.isfinite, pose.flatten().tolist()))):
            check_finite(**{name: pose})
    for name in ("fx", "fy"):
        value = getattr(camera, name)
        if not (value > 0 and math.isfinite(value)):
            raise ValueError(f"camera.{name} must be finite and above 0 pixels, got {value}")
    for name in ("cx", "cy"):
        if not math.isfinite(getattr(camera, name)):
            raise ValueError(f"camera.{name} must be finite, got {getattr(camera, name)}")
    for name in ("width", "height"):
        value = getattr(camera, name)
        if not 1 <= value <= MAX_SIDE:
            raise ValueError(f"camera.{name} must be 1 to {MAX_SIDE} pixels, got {value}")
    if backend == "gpu" and camera.width * camera.height > MAX_GPU_PIXELS:
        raise ValueError(f"camera has {camera.width}x{camera.height} pixels; a GPU draws at most {MAX_GPU_PIXELS}")
