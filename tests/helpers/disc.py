"""A run that needs no training: a disc that changes colour, and Gaussians that stand in for an avatar of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import torch
from safetensors.torch import save_file

from avatar.data.manifest import MANIFEST_FILE, TRACKS_FILE, FrameRecord, Manifest
from avatar.data.refinement_history import Refinement, Round
from avatar.data.subject import Subject
from avatar.splat import splat
from avatar.types import Camera, Gaussians, HeadParams, Rendering

SIZE, COUNT, TEST = 72, 10, (7, 8, 9)


def make_subject(folder: Path) -> Subject:
    """A disc that changes colour: images, a matte, a head mask with a soft rim, a mouth that is hidden in frame 8."""
    source, prepared = folder / "source", folder / "prepared"
    source.mkdir()
    prepared.mkdir()
    y, x = np.mgrid[0:SIZE, 0:SIZE]
    radius = np.hypot(x - SIZE / 2, y - SIZE / 2)
    records = []
    for index in range(COUNT):
        stem = f"{index + 1:05d}"
        pixels = np.stack((100 + 10 * index + x, 200 - y, 40 + radius), axis=-1).clip(0, 255).astype(np.uint8)
        head = ((26 - radius) * 80).clip(0, 255).astype(np.uint8)
        mouth = np.where((abs(y - 48) < 5) & (abs(x - 36) < 9) & (index != 8), 255, 0).astype(np.uint8)
        alpha = ((30 - radius) * 60).clip(0, 255).astype(np.uint8)
        for kind, picture in (("image", pixels), ("alpha", alpha), ("head", head), ("mouth", mouth)):
            assert cv2.imwrite(str(source / f"{stem}_{kind}.png"), picture)
        names = [f"{stem}_{kind}.png" for kind in ("image", "alpha", "head", "mouth")]
        records.append(FrameRecord(stem, names[0], index, *names[1:]))
    manifest = Manifest(
        name="disc",
        format="metrical-tracker",
        source=str(source),
        tracking=str(source),
        head_path=str(source),
        width=SIZE,
        height=SIZE,
        fps=20.0,
        intrinsics=(SIZE, SIZE, SIZE / 2, SIZE / 2),
        frame_offset=1,
        offset_evidence="written by a test",
        frames=tuple(records),
        train=tuple(range(TEST[0])),
        test=TEST,
        left_out={},
        notes=(),
        head_masks="source",
        mouth_masks="source",
        head_fingerprint="ab" * 32,
        input_hash="cd" * 32,
        data_hash="ef" * 32,
    )
    (prepared / MANIFEST_FILE).write_text(manifest.to_json())
    tracks = {
        "expression": torch.linspace(0, 1, COUNT)[:, None].repeat(1, 3),
        "jaw": torch.tensor([1.0, 0, 0, 0, 1, 0]).repeat(COUNT, 1),
        "eyes": torch.tensor([1.0, 0, 0, 0, 1, 0]).repeat(COUNT, 2),
        "eyelids": torch.zeros(COUNT, 2),
        "neck": torch.tensor([1.0, 0, 0, 0, 1, 0]).repeat(COUNT, 1),
        "R": torch.eye(3).repeat(COUNT, 1, 1),
        "t": torch.tensor([0.0, 0.0, 1.0]).repeat(COUNT, 1),
        "shape": torch.zeros(2),
    }
    save_file(tracks, prepared / TRACKS_FILE)
    return Subject.open(prepared)


def refined(subject: Subject, trained_on: tuple[int, ...] = tuple(range(TEST[0]))) -> Subject:
    """The subject as after a refinement through an avatar that was trained on the frames of these numbers."""
    rounds = (Round("runs/first", 1000, "fe" * 32, trained_on),)
    manifest = replace(subject.manifest, refinement=Refinement("insta", rounds), frame_offset=0)
    given = {**subject.recording.tracks, "expression": subject.recording.tracks["expression"] * 0.9}
    return replace(subject, manifest=manifest, given=replace(subject.recording, tracks=given))


# the corners of two eyeballs: with a focal length of SIZE at 1 m, pixels 18 to 30 and 42 to 54 across, 24 to 32 down
EYES = torch.tensor([[18.0, 24.0], [30.0, 32.0], [42.0, 24.0], [54.0, 32.0]]).sub(SIZE / 2).div(SIZE)
EYES = torch.cat((EYES, torch.zeros(4, 1)), dim=1)
NECK = torch.tensor([[0.0, 0.5, 0.0]])  # a vertex below


class Blob:
    """Stands in for a trained avatar: Gaussians on a disc whose colour follows the first expression coefficient."""

    has_colours = True

    def __init__(self, eyeballs: bool = True) -> None:
        regions = {"left_eyeball": torch.tensor([0, 1]), "right_eyeball": torch.tensor([2, 3])} if eyeballs else {}
        assets = SimpleNamespace(fingerprint="ab" * 32, regions=regions)

        def neck() -> tuple[torch.Tensor, torch.Tensor]:
            return torch.zeros(3), torch.tensor([1.0, 1.0, 1.0, 1.0, 0.0])

        self.head = SimpleNamespace(assets=assets, vertices=lambda _: torch.cat((EYES, NECK)), neck=neck)
        self.seen: list[float] = []
        generator = torch.Generator().manual_seed(1)
        self.means = torch.cat((torch.rand(400, 2, generator=generator) * 0.6 - 0.3, torch.zeros(400, 1)), dim=1)

    def __call__(self, params: HeadParams) -> Gaussians:
        assert not torch.is_grad_enabled()
        self.seen.append(float(params.expression[0]))
        return Gaussians(
            means=self.means,
            quats=torch.tensor([1.0, 0, 0, 0]).repeat(400, 1),
            scales=torch.full((400, 3), 0.03),
            opacities=torch.full((400,), 0.9),
            sh=torch.full((400, 1, 3), float(params.expression[0])),
        )


class BlobRenderer:
    """Stands in for `avatar.render.Renderer`."""

    def __init__(self, avatar: Blob, background: torch.Tensor) -> None:
        self.avatar, self.background = avatar, background

    def gaussians(self, params: HeadParams, camera: Camera) -> Gaussians:
        return self.avatar(params)

    def draw(self, gaussians: Gaussians, camera: Camera, background: torch.Tensor) -> Rendering:
        return splat(gaussians, camera, background)


def make_run(path: Path, subject: Subject) -> Any:
    data = SimpleNamespace(size=None, background=(1.0, 1.0, 1.0))
    trainer = SimpleNamespace(opposite_background_every=None)
    config = SimpleNamespace(data=data, trainer=trainer, to_dict=lambda: {"data": {"size": None}})
    return SimpleNamespace(
        path=path, config=config, avatar=Blob(), subject=subject, step=1500, trained=SimpleNamespace(perceptual="dssim")
    )


def read_png(path: Path) -> np.ndarray:
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
