"""Every reader of files, with valid files to start from; here those of other programs and a run's."""

from __future__ import annotations

import contextlib
import io
import json
import pickle
import zipfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from exports import write_imavatar, write_insta, write_vhap
from nersemble_folder import HEIGHT, TRAINED, WIDTH, write_person
from nha_folder import write_nha
from own_targets import make_own_targets
from rig_recording import write_plain_gha
from scipy import sparse
from small_runs import run_info
from target import Reader, Target, member, of_copy, on_disk, with_member
from tracked_folder import write_tracked_folder

from avatar.config import load_config
from avatar.data.read_image import decode_image, decode_mask, decode_transparency
from avatar.data.source import Source
from avatar.data.subject import Subject
from avatar.errors import UserError, refuse
from avatar.evaluation.protocol import read_protocol
from avatar.files.pickles import load_npz, load_pickle, load_torch_pickle
from avatar.head.assets import load_head_assets
from avatar.head.expression_names import ExpressionNames
from avatar.head.model import NECK
from avatar.head.uv_obj import read_uv_obj
from avatar.motion.drive import subject_drive
from avatar.motion.drive_file import read_drive, write_drive
from avatar.runs.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from avatar.runs.run import read_run_info, write_run_info
from data_prep.formats import nersemble_tracking, nha
from data_prep.formats.detect import open_tracked_folder
from data_prep.formats.frame_track import BadFrame
from data_prep.formats.metrical_tracker import read_tracking
from data_prep.formats.nersemble_cameras import CALIBRATION, read_cameras
from data_prep.formats.obj_mesh import read_mesh
from data_prep.formats.root_pose import Joint
from data_prep.prepare.prepare import prepare
from data_prep.track.camera_rig.gha_folder import read_calibration
from data_prep.track.camera_rig.recording import COLOURS, read_colour_matrices

PROTOCOLS = Path(__file__).resolve().parents[2] / "configs" / "protocol"

DRIVE_CSV = b"""time,expression_0,smile_right,jaw_x,jaw_y,jaw_z,eyelid_left,eyelid_right,mood
0.00,0.1,-2e-1,0.1,0,0,0,1,good
0.04,0.2,+0.5,0.2,0,0,"0.5",1,bad
0.08,0.3,1,0.1,0,-0.01,0,1,good
"""
DRIVE_JSON = b"""{"names": ["jawOpen", "mouthSmileLeft"], "metadata": {"fps": 30.0, "frame_count": 2},
"frames": [{"weights": [0.1, 0.2], "time": 0.0, "rotation": []}, {"weights": [0.2, -1e-3], "time": 0.03, "rotation": []}]}
"""
LIVE_LINK_FACE = b"""\xef\xbb\xbfTimecode,BlendShapeCount,EyeBlinkLeft,EyeLookDownLeft,JawOpen,MouthSmileLeft,HeadYaw
10:31:09:58.123,61,0.1,0.2,0.3,0.4,0.5
10:31:09:59.140,61,0.1,0.2,0.3,0.4,0.5
10:31:10:00.156,61,0.1,0.2,0.3,0.4,0.5
10:31:11:00.156,61,0.1,0.2,0.3,0.4,0.5
"""


def make_targets(place: Path) -> dict[str, Target]:
    """`place` is an empty folder for the files that readers open."""
    tracked = write_tracked_folder(place / "tracked", 6, 24)
    head = load_head_assets(tracked / "head_model")
    source = Source(tracked, tracked / "head_model", frame_offset=1)
    prepared = prepare(source, head, out=place / "prepared", say=lambda _: None)
    folders = {
        "vhap": write_vhap(tracked, place / "vhap", divided=False) / "transforms.json",
        "insta": write_insta(tracked, place / "insta") / "transforms_train.json",
        "imavatar": write_imavatar(tracked, place / "imavatar") / "flame_params.json",
    }
    frame = (tracked / "checkpoint" / "00003.frame").read_bytes()
    tensors = {"model.weight": torch.arange(6.0).reshape(2, 3), "optimizer.step": torch.ones(())}
    checkpoint = save_checkpoint(place / "run" / "checkpoints", Checkpoint(7, tensors, {"data_hash": "ab"}), 1)
    write_run_info(place / "run", run_info("dssim"))
    picture = cv2.imread(str(tracked / "imgs" / "00002.jpg"))
    assert picture is not None

    def listed(folder: Path) -> object:
        source = open_tracked_folder(folder)
        return source.read(head, (24, 24), refuse)

    def first_frame(folder: Path) -> object:
        return Subject.open(folder).frame(0)

    def image(data: bytes) -> object:
        return [decode(data, Path("x.png")) for decode in (decode_image, decode_mask, decode_transparency)]

    faces, V = head.faces.numpy(), head.num_vertices
    parameters = folders["vhap"].parent / "flame_param" / "00002.npz"
    with zipfile.ZipFile(parameters) as archive:
        arrays = {name: archive.read(name) for name in archive.namelist()}
    objects = {
        "a": np.arange(6).reshape(2, 3),
        "s": sparse.csc_matrix(np.eye(3)),
        "l": [1, 2.5, "text", None, True, (1,), {"k": b"bytes"}],
    }
    model = tracked / "head_model"
    parts = {
        file.name: Target([file.read_bytes()], of_copy(place, file, model, load_head_assets), 0.25)
        for file in model.iterdir()
    }
    images = [
        _encoded(picture, ".jpg"),
        _encoded(picture, ".png"),
        _encoded(np.dstack((picture, picture[..., 0])), ".png"),
    ]
    in_torch: Reader = None, lambda data: load_torch_pickle(data, "x")
    content, npz = member(frame, "data.pkl"), parameters.read_bytes()
    run, manifest, tracks = place / "run" / "run.json", prepared / "manifest.json", prepared / "tracks.safetensors"

    def listing(name: str, weight: float) -> Target:
        return Target([folders[name].read_bytes()], of_copy(place, folders[name], folders[name].parent, listed), weight)

    def in_frame(data: bytes) -> bytes:
        return with_member(frame, "data.pkl", data)

    named = replace(head, names=ExpressionNames(("mouthSmileLeft", "smile_right")))
    write_drive(place / "drive.npz", subject_drive(Subject.open(prepared), None), head.fingerprint)
    drive = (place / "drive.npz").read_bytes()

    def driven(name: str) -> Reader:
        return on_disk(place / name, lambda path: read_drive(path, named, 24, say=lambda _: None))

    def in_drive(data: bytes) -> bytes:
        return with_member(drive, "R.npy", data)

    person = write_person(place, cameras=[TRAINED], sequences=["EXP-1-head"])
    cameras = read_cameras(person, {TRAINED: (WIDTH, HEIGHT)})
    tracked_sequence = next(person.glob("sequences/*/tracking/*.npz"))
    rotations = tracked_sequence.read_bytes()

    neck = Joint(head, NECK)

    def sequence(path: Path) -> None:
        tracking = nersemble_tracking.read_tracking(path)
        for row in range(len(tracking.pictures(6))):
            with contextlib.suppress(BadFrame):
                tracking.frame(row, tracking.shape, neck, cameras[TRAINED])

    def mesh(path: Path) -> object:
        try:
            return read_mesh(path)
        except BadFrame as error:
            raise UserError(str(error)) from None

    of_nha = write_nha(place / "nha", 6)
    nha_tracking, nha_split = next(of_nha.glob(nha.TRACKED)), of_nha / nha.SPLIT

    of_gha = next(write_plain_gha(place / "gha").rglob("camera_*.npz")).read_bytes()

    own = place / "own"
    own.mkdir()
    return {
        "pickle": Target(
            [pickle.dumps(objects, protocol=p) for p in range(6)], (None, lambda d: load_pickle(d, "x")), 3
        ),
        "torch": Target([frame, _legacy(frame)], in_torch),
        "torch, checksums right": Target([content], in_torch, 2, in_frame),
        ".frame": Target([content], on_disk(place / "0.frame", lambda p: read_tracking({0: p})), 2, in_frame),
        "npz": Target([npz], on_disk(place / "x.npz", load_npz)),
        "npz, checksums right": Target(
            [arrays["expr.npy"]], on_disk(place / "y.npz", load_npz), 2, lambda d: with_member(npz, "expr.npy", d)
        ),
        "VHAP listing": listing("vhap", 2),
        "INSTA listing": listing("insta", 1),
        "IMavatar listing": listing("imavatar", 2),
        "NeRSemble calibration": Target(
            [(person / CALIBRATION).read_bytes()],
            on_disk(person / CALIBRATION, lambda p: read_cameras(p.parents[1], {TRAINED: (WIDTH, HEIGHT)})),
        ),
        "NeRSemble colours": Target(
            [json.dumps({TRAINED: np.eye(3).tolist()}).encode()],
            on_disk(person / COLOURS, lambda p: read_colour_matrices(p.parents[1], [TRAINED])),
            0.5,
        ),
        "NeRSemble tracking": Target([rotations], on_disk(tracked_sequence, sequence), 0.5),
        "NeRSemble tracking, checksums right": Target(
            [member(rotations, "rotation_matrices.npy"), member(rotations, "frames.npy")],
            on_disk(tracked_sequence, sequence),
            1,
            lambda d: with_member(rotations, "frames.npy" if len(d) < 300 else "rotation_matrices.npy", d),
        ),
        "INSTA mesh": Target([(model / "head_template.obj").read_bytes()], on_disk(place / "m.obj", mesh), 0.25),
        "NHA tracking": Target([nha_tracking.read_bytes()], of_copy(place, nha_tracking, of_nha, listed), 0.5),
        "GaussianHeadAvatar camera": Target(
            [member(of_gha, "extrinsic.npy"), member(of_gha, "intrinsic.npy")],
            on_disk(place / "camera.npz", read_calibration),
            0.5,
            lambda d: with_member(of_gha, "intrinsic.npy" if len(d) < 210 else "extrinsic.npy", d),
        ),
        "NHA split": Target([nha_split.read_bytes()], of_copy(place, nha_split, of_nha, listed), 0.5),
        "manifest": Target([manifest.read_bytes()], of_copy(place, manifest, prepared, first_frame), 2),
        "tracks": Target([tracks.read_bytes()], of_copy(place, tracks, prepared, first_frame)),
        "checkpoint": Target([checkpoint.read_bytes()], on_disk(place / "x.safetensors", load_checkpoint)),
        "run.json": Target([run.read_bytes()], on_disk(run, lambda p: read_run_info(p.parent))),
        "UV obj": Target(
            [(model / "head_template.obj").read_bytes()],
            on_disk(place / "x.obj", lambda p: read_uv_obj(p, faces, V)),
            0.5,
        ),
        "head model": parts["generic_model.pkl"],
        "regions": parts["FLAME_masks.pkl"],
        "eyelid": parts["l_eyelid.npy"],
        "image": Target(images, (None, image), 2),
        "protocol": Target(
            [p.read_bytes() for p in PROTOCOLS.glob("*.yaml")], on_disk(place / "x.yaml", read_protocol)
        ),
        "drive .npz": Target([drive], driven("a.npz")),
        "drive .npz, checksums right": Target([member(drive, "R.npy")], driven("b.npz"), 1, in_drive),
        "drive .csv": Target([DRIVE_CSV], driven("a.csv")),
        "Live Link Face": Target([LIVE_LINK_FACE], driven("b.csv")),
        "drive .json": Target([DRIVE_JSON], driven("a.json")),
        "override": Target(
            [b"trainer.iterations=3", b"model=flashavatar", b"data.size=64", b"trainer.seed=1"],
            (None, lambda d: load_config([d.decode("utf-8", "replace")])),
            0.25,
        ),
        **make_own_targets(own),
    }


def _encoded(image: np.ndarray, suffix: str) -> bytes:
    return cv2.imencode(suffix, image)[1].tobytes()


def _legacy(frame: bytes) -> bytes:
    buffer = io.BytesIO()
    torch.save(torch.load(io.BytesIO(frame), weights_only=False), buffer, _use_new_zipfile_serialization=False)
    return buffer.getvalue()
