"""The tracked mesh and the masks drawn over a frame."""

from __future__ import annotations

import cv2
import numpy as np

from avatar.data.read_image import read_image
from avatar.data.split import evenly_spread
from avatar.errors import UserError
from data_prep.check.clip import Clip
from data_prep.prepare.mask_overlap import Mesh, MeshProjector
from data_prep.prepare.masks import read_masks
from data_prep.prepare.projection import filled_lips

SHOWN = 8
DRAWN_WIDTH = 560  # pixels; the mesh needs room for its lines
MESH, MASK, LIPS, MOUTH = (79, 179, 255), (63, 208, 122), (255, 95, 168), (255, 210, 63)  # as in html/style.css
_CROSS = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
_SUBPIXEL = 4  # bits of the fixed-point coordinates of cv2's lines


def choose_frames(clip: Clip) -> list[int]:
    """Image numbers of `SHOWN` frames: half spread over the clip, half with the worst fit of head or lips."""
    drawable = [n for n, _ in clip.tracked() if clip.is_whole(n)]
    if len(drawable) <= SHOWN:
        return drawable
    spread = evenly_spread(drawable, SHOWN // 2)

    def misfit(number: int) -> float:
        fit = clip.fits.get(number)
        if fit is None:
            return 0.0
        away = np.nan_to_num(fit.mouth) + np.nan_to_num(fit.overhang)
        return float(away / fit.size) if np.isfinite(fit.size) else np.inf  # not in the picture

    worst = sorted((n for n in drawable if n not in spread), key=misfit, reverse=True)
    apart: list[int] = []
    for number in worst:  # neighbours look alike
        if all(abs(number - other) > len(drawable) // 100 for other in apart):
            apart.append(number)
    return sorted([*spread, *apart[: SHOWN - len(spread)]])


def draw_overlays(clip: Clip) -> list[tuple[np.ndarray, str]]:
    """The chosen frames with mesh, head mask, lips and mouth mask, uint8 [h, w, 3], each with its caption. Empty where
    nothing can be projected."""
    tracks = dict(clip.tracked())
    if clip.head is None or not tracks:
        return []
    project = MeshProjector(clip.head)
    overlays = []
    for number in choose_frames(clip):
        try:
            image = read_image(clip.files.images[number])
            head, mouth = read_masks(clip.files, number)
        except UserError:
            continue  # named in its own finding; it may have changed since
        width = DRAWN_WIDTH
        height = max(1, round(image.shape[0] * width / image.shape[1]))
        canvas = cv2.resize(image, (width, height), interpolation=cv2.INTER_CUBIC)
        mesh = project(tracks[number], width, height)
        canvas = draw_mesh(canvas, mesh)
        for colour, mask in ((MASK, head), (MOUTH, mouth)):
            if mask is None:
                continue
            outline(canvas, cv2.resize(mask, (width, height), interpolation=cv2.INTER_LINEAR) > 127, colour)
        if len(mesh.lip_faces):
            outline(canvas, filled_lips(mesh.screen, mesh.lip_faces, width, height), LIPS)
        overlays.append((canvas, _caption(clip, number)))
    return overlays


def draw_mesh(image: np.ndarray, mesh: Mesh) -> np.ndarray:
    """The edges of the faces that look at the camera, as thin lines."""
    corners = mesh.screen[mesh.faces]  # [F, 3, 3]
    a, b = corners[:, 1, :2] - corners[:, 0, :2], corners[:, 2, :2] - corners[:, 0, :2]
    area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    in_front = (corners[..., 2] > 0).all(axis=1) & np.isfinite(corners).all(axis=(1, 2))
    # Counter-clockwise seen from outside, in an image whose y points down.
    facing = mesh.faces[in_front & (area < 0)]
    ends = np.sort(np.concatenate((facing[:, [0, 1]], facing[:, [1, 2]], facing[:, [2, 0]])).astype(np.int64), axis=1)
    # Sorting one number for each edge takes a fifth of sorting pairs.
    edges = np.stack(np.divmod(np.unique(ends[:, 0] * len(mesh.screen) + ends[:, 1]), len(mesh.screen)), axis=1)
    lines = np.clip(mesh.screen[edges][..., :2], -(2**13), 2**13)
    points = np.round((lines - 0.5) * 2**_SUBPIXEL).astype(np.int32)
    drawn = cv2.polylines(image.copy(), list(points), False, MESH, 1, cv2.LINE_AA, _SUBPIXEL)
    return cv2.addWeighted(drawn, 0.3, image, 0.7, 0)


def outline(canvas: np.ndarray, mask: np.ndarray, colour: tuple[int, int, int]) -> None:
    """Draw the outer pixels of the mask's pieces, and those around its holes, on the canvas."""
    inside = mask.astype(np.uint8)
    canvas[cv2.erode(inside, _CROSS) != inside] = colour


def _caption(clip: Clip, number: int) -> str:
    name = clip.image_name(number)
    fit = clip.fits.get(number)
    if fit is None:
        return name
    head = "" if np.isnan(fit.overhang) else f": overlap {fit.overlap:.2f}, sticks out {fit.overhang:.1f} px"
    lips = "" if np.isnan(fit.mouth) else f", lips off by {fit.mouth:.1f} px"
    return f"{name}{head}{lips}"
