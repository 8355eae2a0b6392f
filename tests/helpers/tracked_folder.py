"""A small tracked folder for tests, in the real on-disk formats: a FLAME-format head model, images, masks and tracking.

The head is a coarse ellipsoid with nose, lips, eyes and neck; the images are its flat-shaded projection, so that masks,
images and tracking agree up to rounding and the true image offset is known.
"""

from __future__ import annotations

import pickle
from pathlib import Path

import cv2
import numpy as np
import torch

from avatar.head.assets import HeadAssets, load_head_assets
from avatar.head.model import HeadModel
from avatar.head.rasterize import rasterize_mesh
from avatar.types import IDENTITY_6D, Camera, HeadParams

ROWS, COLUMNS = 24, 32  # of the latitude-longitude grid
RADII = np.array([0.075, 0.11, 0.09])  # metres; x right, y up, z to the front, as in FLAME
SHAPE_COEFFICIENTS = 300
FOCAL = 2.8  # in image widths


def write_tracked_folder(
    directory: Path,
    frames: int = 12,
    size: int = 64,
    offset: int = 1,
    *,
    height: int | None = None,
    alpha: bool = True,
    head_masks: bool = True,
    mouth_masks: bool = True,
    suffix: str = ".jpg",
    expressions: int = 10,
    seed: int = 0,
    mouth_opening: bool = False,
) -> Path:
    """Write `directory` with imgs/, alpha/, parsing/, checkpoint/ and head_model/; image number = tracking + offset.

    Tracking is numbered from 0, or from -offset where the images would have negative numbers otherwise.
    """
    directory = Path(directory)
    height = height or size
    assets = write_head_model(directory / "head_model", expressions, mouth_opening)
    for name in ("imgs", "alpha", "parsing", "checkpoint"):
        (directory / name).mkdir(parents=True, exist_ok=True)
    identity = np.zeros(SHAPE_COEFFICIENTS, np.float32)
    identity[:2] = 0.5, -0.3
    head = HeadModel(assets, torch.from_numpy(identity))
    for number, track in enumerate(motion(frames, expressions, seed), start=max(0, -offset)):
        content = frame_content(track, identity, size, height, number)
        torch.save(content, directory / "checkpoint" / f"{number:05d}.frame")
        image, head_mask, mouth_mask = render(head, content, size, height)
        name = f"{number + offset:05d}"
        cv2.imwrite(str(directory / "imgs" / f"{name}{suffix}"), image[..., ::-1])
        if alpha:
            cv2.imwrite(str(directory / "alpha" / f"{name}{suffix}"), head_mask * 255)
        if head_masks:
            cv2.imwrite(str(directory / "parsing" / f"{name}_neckhead.png"), head_mask * 255)
        if mouth_masks:
            cv2.imwrite(str(directory / "parsing" / f"{name}_mouth.png"), mouth_mask * 255)
    return directory


def motion(frames: int, expressions: int, seed: int) -> list[dict[str, np.ndarray]]:
    """Restless tracks: quick turns and lip movements, so that a few frames show which image belongs to which."""
    rng = np.random.default_rng(seed)

    def wander(count: int) -> np.ndarray:
        """[frames, count] in about [-1, 1], correlation time two frames."""
        noise = rng.standard_normal((frames + 4, count))
        return (noise[:-4] + 2 * noise[1:-3] + 3 * noise[2:-2] + 2 * noise[3:-1] + noise[4:]) / 6

    angles, shift, mouth = 0.2 * wander(3), 0.02 * wander(3), wander(expressions)
    jaw, eyes, eyelids = 0.15 * np.abs(wander(1)), 0.15 * wander(4), np.abs(wander(2))
    flip = np.diag([1.0, -1.0, -1.0])  # FLAME looks along +z with y up; an OpenCV camera sees y down
    return [
        {
            "R": flip @ rotation(*angles[i]),
            "t": np.array([0.0, 0.0, 0.8]) + shift[i],
            "expression": mouth[i],
            "jaw": rotation(jaw[i, 0], 0, 0)[:2].ravel(),
            "eyes": np.concatenate([rotation(eyes[i, k], eyes[i, k + 1], 0)[:2].ravel() for k in (0, 2)]),
            "eyelids": eyelids[i],
        }
        for i in range(frames)
    ]


def rotation(x: float, y: float, z: float) -> np.ndarray:
    """Rotations about x, then y, then z (radians)."""
    about_x, about_y, about_z = (cv2.Rodrigues(np.eye(3)[axis] * angle)[0] for axis, angle in enumerate((x, y, z)))
    return about_z @ about_y @ about_x


def frame_content(
    track: dict[str, np.ndarray], identity: np.ndarray, width: int, height: int, number: int
) -> dict[str, object]:
    """What metrical-tracker puts in a `.frame` file."""
    K = np.array([[FOCAL * width, 0, width / 2], [0, FOCAL * width, height / 2], [0, 0, 1]])
    flame = {
        "exp": track["expression"],
        "shape": identity,
        "tex": np.zeros(140),
        "sh": np.zeros((9, 3)),
        "eyes": track["eyes"],
        "eyelids": track["eyelids"],
        "jaw": track["jaw"],
    }
    return {
        "flame": {name: value[None].astype(np.float32) for name, value in flame.items()},
        "opencv": {name: v[None].astype(np.float32) for name, v in (("R", track["R"]), ("t", track["t"]), ("K", K))},
        "img_size": np.array([width, height]),
        "frame_id": f"{number:05d}",
        "global_step": 20 * number,
    }


def render(head: HeadModel, content: dict, width: int, height: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """uint8 image [H, W, 3], head mask and mouth mask [H, W] in {0, 1} of the posed head."""
    flame, opencv = ({k: torch.from_numpy(v[0]) for k, v in content[part].items()} for part in ("flame", "opencv"))
    K = opencv["K"]
    fx, fy, cx, cy = K[0, 0].item(), K[1, 1].item(), K[0, 2].item(), K[1, 2].item()
    camera = Camera(opencv["R"], opencv["t"], fx, fy, cx, cy, width, height)
    neck = torch.tensor(IDENTITY_6D)
    params = HeadParams(flame["exp"], flame["jaw"], flame["eyes"], flame["eyelids"], neck)
    vertices = head.vertices(params)
    faces = head.faces.numpy()
    raster = rasterize_mesh(camera.project(vertices).numpy(), faces, height, width)
    covered = raster.face_id >= 0
    lips = head.assets.regions["lips"].numpy()
    eyes = np.concatenate([head.assets.regions[f"{side}_eyeball"].numpy() for side in ("left", "right")])
    is_lip, is_eye = (covered & np.all(np.isin(faces, region), 1)[raster.face_id] for region in (lips, eyes))
    corners = vertices.numpy()[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12
    shade = (0.55 + 0.4 * normals @ np.array([0.4, 0.5, 0.77]))[raster.face_id]
    colour = np.where(is_lip[..., None], (190, 70, 80), np.where(is_eye[..., None], (235, 235, 240), (215, 170, 145)))
    image = np.where(covered[..., None], colour * np.clip(shade, 0, 1)[..., None], (90, 110, 130))
    return image.astype(np.uint8), covered.astype(np.uint8), is_lip.astype(np.uint8)


def write_head_model(directory: Path, expressions: int = 10, mouth_opening: bool = False) -> HeadAssets:
    """Write generic_model.pkl, head_template.obj, eyelids and FLAME_masks.pkl; return them as the program reads them.

    With a mouth opening, the mesh has a hole between the lips.
    """
    directory.mkdir(parents=True, exist_ok=True)
    theta = np.linspace(0.02, np.pi - 0.45, ROWS)  # from the crown to the open neck
    phi = np.linspace(0, 2 * np.pi, COLUMNS, endpoint=False)  # from the back, where the UV seam is
    direction = np.stack(
        (
            (-np.sin(theta)[:, None] * np.sin(phi)).ravel(),
            np.repeat(np.cos(theta), COLUMNS),
            (-np.sin(theta)[:, None] * np.cos(phi)).ravel(),
        ),
        axis=1,
    )

    def patch(x: float, y: float, width: float) -> np.ndarray:
        """[V] bump of 1 at the front of the head where the direction is (x, y)."""
        d = ((direction[:, 0] - x) ** 2 + (direction[:, 1] - y) ** 2) / width**2
        return np.exp(-d) * (direction[:, 2] > 0)

    template = direction * RADII
    template[:, 2] += 0.025 * patch(0, -0.05, 0.12)  # nose
    lip_distance = (direction[:, 0] / 0.36) ** 2 + ((direction[:, 1] + 0.42) / 0.17) ** 2
    lips = np.flatnonzero((lip_distance < 1) & (direction[:, 2] > 0))
    left_eye, right_eye = (np.flatnonzero(patch(x, 0.2, 0.17) > 0.2) for x in (0.38, -0.38))
    V = len(template)
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(ROWS - 1), np.arange(COLUMNS), indexing="ij"))
    quad = np.stack((i * COLUMNS + j, (i + 1) * COLUMNS + j, (i + 1) * COLUMNS + (j + 1) % COLUMNS,
                     i * COLUMNS + (j + 1) % COLUMNS), axis=1)  # fmt: skip
    uv_quad = np.stack((i * (COLUMNS + 1) + j, (i + 1) * (COLUMNS + 1) + j, (i + 1) * (COLUMNS + 1) + j + 1,
                        i * (COLUMNS + 1) + j + 1), axis=1)  # fmt: skip
    faces, uv_faces = (np.concatenate((q[:, [0, 1, 2]], q[:, [0, 2, 3]])) for q in (quad, uv_quad))
    if mouth_opening:
        is_between = lip_distance[faces].max(axis=1) < 0.7
        faces, uv_faces = faces[~is_between], uv_faces[~is_between]

    rng = np.random.default_rng(1)
    directions = np.zeros((V, 3, SHAPE_COEFFICIENTS + expressions))
    directions[:, :, :3] = 0.004 * direction[:, :, None] * rng.standard_normal((1, 3, 3))
    below = patch(0, -0.55, 0.2)[:, None] * np.array([0, -0.012, 0])  # lower lip down
    wide = patch(0, -0.42, 0.3)[:, None] * direction * np.array([0.05, 0, 0])  # lips wide
    directions[:, :, SHAPE_COEFFICIENTS], directions[:, :, SHAPE_COEFFICIENTS + 1] = below, wide
    for k in range(2, expressions):
        x, y = rng.uniform(-0.5, 0.5, 2)
        directions[:, :, SHAPE_COEFFICIENTS + k] = patch(x, y, 0.25)[:, None] * rng.normal(0, 0.002, 3)

    weights = np.zeros((V, 5))
    weights[:, 2] = np.clip(-direction[:, 1] * 2.5, 0, 1) * np.clip(direction[:, 2] * 2, 0, 1)
    for joint, eye in ((3, left_eye), (4, right_eye)):
        weights[eye] = 0
        weights[eye, joint] = 1
    weights[:, 1] = 1 - weights.sum(1)
    regressor = np.zeros((5, V))
    regressor[0, -COLUMNS:] = regressor[1, -COLUMNS:] = 1 / COLUMNS
    regressor[2] = 1 / V
    regressor[3, left_eye], regressor[4, right_eye] = 1 / len(left_eye), 1 / len(right_eye)
    model = {
        "v_template": template.astype(np.float32),
        "f": faces.astype(np.uint32),
        "shapedirs": directions.astype(np.float32),
        "posedirs": np.zeros((V, 3, 36), np.float32),
        "J_regressor": regressor.astype(np.float32),
        "weights": weights.astype(np.float32),
        "kintree_table": np.array([[2**32 - 1, 0, 1, 1, 1], [0, 1, 2, 3, 4]], np.uint32),
    }
    (directory / "generic_model.pkl").write_bytes(pickle.dumps(model, protocol=2))
    for name, x in (("l_eyelid.npy", 0.38), ("r_eyelid.npy", -0.38)):
        np.save(directory / name, (patch(x, 0.3, 0.15)[:, None] * np.array([0, -0.004, 0])).astype(np.float32))
    regions = {
        "lips": lips,
        "left_eyeball": left_eye,
        "right_eyeball": right_eye,
        "boundary": np.arange(V - COLUMNS, V),
        "neck": np.arange(V - 4 * COLUMNS, V),
        "face": np.flatnonzero((direction[:, 2] > 0.3) & (direction[:, 1] > -0.8)),
        "scalp": np.flatnonzero((direction[:, 1] > 0.5) | (direction[:, 2] < -0.3)),
    }
    (directory / "FLAME_masks.pkl").write_bytes(pickle.dumps(regions, protocol=2))
    uvs = [(c / COLUMNS, 1 - (r + 0.5) / ROWS) for r in range(ROWS) for c in range(COLUMNS + 1)]
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in template] + [f"vt {u:.6f} {v:.6f}" for u, v in uvs]
    lines += [
        "f " + " ".join(f"{v + 1}/{t + 1}" for v, t in zip(*fs, strict=True))
        for fs in zip(faces, uv_faces, strict=True)
    ]
    (directory / "head_template.obj").write_text("\n".join(lines) + "\n")
    return load_head_assets(directory)
