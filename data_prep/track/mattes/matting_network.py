"""Soft mattes, by a matting network whose file a person has put there; onnxruntime runs it.

Robust Video Matting carries four states from frame to frame, so that a clip's mattes are steady. MODNet sees each picture
by itself. Both give the share of the person in each pixel of hair, which closed-form matting would make hard again.

Sources: Lin et al., Robust High-Resolution Video Matting with Temporal Guidance (WACV 2022); Ke et al., MODNet (AAAI 2022).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from avatar.compute.native import thread_count
from avatar.errors import UserError, check_installed
from avatar.files.third_party import MATTING_FILES, MODNET, ThirdPartyFile, require
from data_prep.track.mattes.segmentation_network import MatteFunction, enlarged

_MODNET_SIDE, _MODNET_MULTIPLE = 512, 32  # of its pictures' shorter side, and of both
_RVM_SIDE = 512  # of the longer side, at which Robust Video Matting works; the rest is its own upsampling
_STATES = ("r1", "r2", "r3", "r4")


def open_matting(network: ThirdPartyFile) -> MatteFunction:
    """One of MATTING_FILES; the pictures of a clip have to be given in order, all of one size.

    Raises UserError where onnxruntime is missing, and where the file is not the published one or cannot be run.
    """
    check_installed(f"{network.name} (mattes)", "track", "onnxruntime")
    import onnxruntime

    file, options = require(network), onnxruntime.SessionOptions()
    options.intra_op_num_threads = thread_count()
    try:
        session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's have no common base
        raise UserError(f"onnxruntime cannot load {file} ({error}); fetch {network.url} again, or remove it") from None
    return (_modnet if network.name == MODNET.name else _robust_video_matting)(session, file)


def check_matting(network: ThirdPartyFile) -> None:
    """Raises UserError where it is one of MATTING_FILES and makes no matte of a picture."""
    if network in MATTING_FILES:
        open_matting(network)(np.zeros((_MODNET_SIDE, _MODNET_SIDE, 3), np.uint8))


def _modnet(session: Any, file: Path) -> MatteFunction:
    def matte(image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W"]:
        height, width = image.shape[:2]
        scale = _MODNET_SIDE / min(height, width)
        size = tuple(max(1, round(side * scale / _MODNET_MULTIPLE)) * _MODNET_MULTIPLE for side in (width, height))
        resized = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR)
        alpha, _ = _outputs(session, file, ["output"], {"input": 2.0 * _planes(resized) - 1.0})
        return enlarged(alpha, width, height)

    return matte


def _robust_video_matting(session: Any, file: Path) -> MatteFunction:
    states = [np.zeros((1, 1, 1, 1), np.float32)] * len(_STATES)

    def matte(image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W"]:
        nonlocal states
        ratio = np.array([min(1.0, _RVM_SIDE / max(image.shape[:2]))], np.float32)
        given = {f"{name}i": state for name, state in zip(_STATES, states, strict=True)}
        inputs = {"src": _planes(image), "downsample_ratio": ratio} | given
        alpha, states = _outputs(session, file, ["pha", *(f"{name}o" for name in _STATES)], inputs)
        return enlarged(alpha, image.shape[1], image.shape[0])

    return matte


def _outputs(
    session: Any, file: Path, names: list[str], inputs: dict[str, np.ndarray]
) -> tuple[Float32[np.ndarray, "h w"], list[np.ndarray]]:
    """The matte of the first input, and the other outputs. Raises UserError for a network of other inputs or outputs."""
    try:
        alpha, *others = session.run(names, inputs)
        return alpha.reshape(next(iter(inputs.values())).shape[2:]), others
    except Exception as error:  # onnxruntime's have no common base
        raise UserError(
            f"{file} makes no matte of a picture ({error}); put the published file there, or remove it"
        ) from None


def _planes(image: UInt8[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "1 3 H W"]:
    """In [0, 1]."""
    return np.ascontiguousarray(image.transpose(2, 0, 1)[None], np.float32) / np.float32(255.0)
