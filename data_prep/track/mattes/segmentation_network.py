"""Networks that tell a person from the background: which one there is, and MediaPipe's, which are coarse.

`selfie_segmentation` gives the probability of the foreground at 256x256, of the picture and of its mirror image;
`selfie_multiclass` is taken instead where its file is. `matting_network` has the others.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from avatar.errors import UserError
from avatar.files.third_party import (
    MATTING_FILES,
    SELFIE_MULTICLASS,
    SELFIE_SEGMENTATION,
    ThirdPartyFile,
    find,
    require,
)

SIDE = 256  # of the networks' pictures
_LOADING = threading.Lock()
"""Two loads at once find operators unsupported, or crash: OpenCV's table of them is filled by the first."""
MatteFunction = Callable[[UInt8[np.ndarray, "H W 3"]], UInt8[np.ndarray, "H W"]]
"""From a picture to its matte."""


def matte_network() -> ThirdPartyFile:
    """The best that is there; the one that tracking needs, where there is none."""
    optional = (*MATTING_FILES, SELFIE_MULTICLASS)
    return next((file for file in optional if find(file) is not None), SELFIE_SEGMENTATION)


def open_segmentation(network: ThirdPartyFile) -> MatteFunction:
    """MediaPipe's, for one thread. Raises UserError where the file is not the published one."""
    return _with_mirrored(_segmentation() if network is SELFIE_SEGMENTATION else _multiclass())


def _with_mirrored(matte_of: MatteFunction) -> MatteFunction:
    """The mean of a picture's matte and its mirror image's, which errs less than either."""

    def matte(image: np.ndarray) -> np.ndarray:
        mirrored = matte_of(np.ascontiguousarray(image[:, ::-1]))[:, ::-1]
        return cv2.addWeighted(matte_of(image), 0.5, mirrored, 0.5, 0.0)

    return matte


def _segmentation() -> MatteFunction:
    file = require(SELFIE_SEGMENTATION)
    try:
        with _LOADING:
            net = cv2.dnn.readNetFromTFLite(str(file))
    except cv2.error as error:
        raise UserError(f"OpenCV cannot load {file} ({error.err}); fetch {SELFIE_SEGMENTATION.url} again") from None

    def matte(image: np.ndarray) -> np.ndarray:
        small = cv2.resize(image, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
        net.setInput(cv2.dnn.blobFromImage(small, 1 / 255.0))
        return enlarged(net.forward().reshape(SIDE, SIDE), image.shape[1], image.shape[0])

    return matte


def _multiclass() -> MatteFunction:
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
