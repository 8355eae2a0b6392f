"""Foreground mattes: the person against the background, by a small published network.

`selfie_segmentation` gives the probability of the foreground at 256x256; it is enlarged bilinearly as it is, since neither
a guided filter nor GrabCut made its edge better. `selfie_multiclass` is taken instead where its file is.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from avatar.errors import UserError
from avatar.files.third_party import SELFIE_MULTICLASS, SELFIE_SEGMENTATION, find, require

SIDE = 256  # of the networks' pictures
Matter = Callable[[UInt8[np.ndarray, "H W 3"]], UInt8[np.ndarray, "H W"]]


def open_matter() -> tuple[Matter, str]:
    """The best network that is there, as a function from a picture to its matte (0 to 255), and the network's name."""
    if find(SELFIE_MULTICLASS) is not None:
        return _multiclass(), SELFIE_MULTICLASS.name
    return _segmentation(), SELFIE_SEGMENTATION.name


def _segmentation() -> Matter:
    file = require(SELFIE_SEGMENTATION)
    try:
        net = cv2.dnn.readNetFromTFLite(str(file))
    except cv2.error as error:
        raise UserError(f"OpenCV cannot load {file} ({error.err}); fetch {SELFIE_SEGMENTATION.url} again") from None

    def matte(image: np.ndarray) -> np.ndarray:
        small = cv2.resize(image, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
        net.setInput(cv2.dnn.blobFromImage(small, 1 / 255.0))
        return enlarged(net.forward().reshape(SIDE, SIDE), image.shape[1], image.shape[0])

    return matte


def _multiclass() -> Matter:
    """Through MediaPipe's own runner, which knows the file's normalisation. Class 0 is the background."""
    file = require(SELFIE_MULTICLASS)
    from data_prep.track.faces.detect import load_mediapipe, quiet

    mediapipe, vision, options = load_mediapipe()
    settings = vision.ImageSegmenterOptions(base_options=options(file), output_confidence_masks=True)
    with quiet():
        segmenter = vision.ImageSegmenter.create_from_options(settings)

    def matte(image: np.ndarray) -> np.ndarray:
        small = cv2.resize(image, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
        found = segmenter.segment(mediapipe.Image(image_format=mediapipe.ImageFormat.SRGB, data=small))
        background = np.asarray(found.confidence_masks[0].numpy_view(), np.float32).reshape(SIDE, SIDE)
        return enlarged(1.0 - background, image.shape[1], image.shape[0])

    return matte


def enlarged(probability: Float32[np.ndarray, "h w"], width: int, height: int) -> UInt8[np.ndarray, "H W"]:
    large = cv2.resize(probability, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.rint(np.clip(large, 0.0, 1.0) * 255.0).astype(np.uint8)
