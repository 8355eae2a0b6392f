"""The tracked head as masks: its silhouette, and the lips with what is between them."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from avatar.head.model import HeadModel
from avatar.head.rasterize import rasterize_mesh
from avatar.types import Camera, HeadParams
from data_prep.formats.frame_track import FrameTrack


def head_params(track: FrameTrack) -> HeadParams:
    return HeadParams(
        expression=torch.from_numpy(track.expression.astype(np.float32)),
        jaw=torch.from_numpy(track.jaw.astype(np.float32)),
        eyes=torch.from_numpy(track.eyes.astype(np.float32)),
        eyelids=torch.from_numpy(track.eyelids.astype(np.float32)),
        neck=torch.from_numpy(track.neck.astype(np.float32)),
    )


def project_head(head: HeadModel, track: FrameTrack, intrinsics: np.ndarray, width: int, height: int) -> np.ndarray:
    """Vertices [V, 3] as (x pixel, y pixel, depth) in an image of width x height pixels."""
    fx, fy, cx, cy = intrinsics.tolist()
    camera = Camera(
        torch.from_numpy(track.R).float(), torch.from_numpy(track.t).float(), fx, fy, cx, cy, *track.size
    ).resized(width, height)
    with torch.no_grad():
        return camera.project(head.vertices(head_params(track))).numpy()


def silhouette(screen: np.ndarray, faces: np.ndarray, width: int, height: int) -> np.ndarray:
    """uint8 [H, W], 1 where a face of the mesh covers the pixel."""
    return (rasterize_mesh(screen, faces, height, width).face_id >= 0).astype(np.uint8)


def filled_lips(screen: np.ndarray, lip_faces: np.ndarray, width: int, height: int) -> np.ndarray:
    """bool [H, W], true on the lips and on what they enclose (teeth, tongue)."""
    return filled(silhouette(screen, lip_faces, width, height))


def filled(mask: np.ndarray) -> np.ndarray:
    """bool [H, W]: the mask, uint8 or bool, with its holes filled."""
    canvas = mask.astype(np.uint8)
    outlines, _ = cv2.findContours(canvas, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(canvas, outlines, -1, 1, thickness=cv2.FILLED) > 0


def lip_faces(head: HeadModel) -> np.ndarray:
    """Faces [F', 3] whose three vertices belong to the lips; empty where the model does not name them."""
    faces = head.faces.numpy()
    members = head.assets.regions.get("lips")
    if members is None:
        return faces[:0]
    return faces[np.isin(faces, members.numpy()).all(axis=1)]
