"""avatar export: an avatar to take away."""

from __future__ import annotations

import hashlib
from argparse import Namespace
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from tqdm import tqdm

from avatar.commands.outputs import check_file, check_outputs
from avatar.errors import UserError
from avatar.export.glb import encode_glb
from avatar.export.licence import MESH, NOTHING, SKINNING, WHOLE, licence_of
from avatar.export.mediapipe_pack import NOTICE, PACK, make_pack
from avatar.export.movie import write_movie
from avatar.export.ply import encode_ply
from avatar.export.web_page import write_page, write_web_avatar
from avatar.files.atomic import write_atomically
from avatar.files.names import typed
from avatar.files.numbered import numbered, remove_longer
from avatar.files.video import ALPHA_SUFFIXES, VIDEO_SUFFIXES
from avatar.pipeline import OK
from avatar.pipeline.backdrop import TRANSPARENT, parse_backdrop
from avatar.pipeline.open_inputs import DRIVE_SUFFIXES, open_drive_file
from avatar.runs.avatar_file import read_avatar_file, write_avatar_file
from avatar.runs.model_registry import refuse_features
from avatar.runs.motion_clip import OWN, Clip, driven_clip, own_clip
from avatar.runs.run import open_trained
from avatar.runs.trained_avatar import TrainedAvatar
from avatar.types import Camera, HeadParams

MIB = 2**20
TEXTURE, MAX_SIZE = 1024, 4096  # pixels


def run_export(arguments: Namespace) -> int:
    format = chosen_format(arguments.format, arguments.out)
    check_options(arguments, format)
    trained = open_trained(arguments.run, arguments.head)
    is_transparent = arguments.background == TRANSPARENT
    suffixes = ALPHA_SUFFIXES if is_transparent else SUFFIXES[format]
    out: Path = arguments.out or Path(f"{trained.name}{suffixes[0]}")
    check_file(out, suffixes, "a transparent video" if is_transparent else f"--format {format}")
    motion, behind = (Path(name) if name else None for name in (arguments.motion, arguments.background))
    written = [out, out.with_name(PACK)] if arguments.webcam else [out]
    check_outputs(written, [arguments.run, trained.source, arguments.head, motion, behind])
    WRITERS[format](trained, out, arguments)
    return OK


def chosen_format(format: str | None, out: Path | None) -> str:
    """What --format says, else what the suffix of --out does, else the page that any browser opens."""
    if format is not None:
        return format
    if out is None:
        return "web"
    found = next((name for name, suffixes in SUFFIXES.items() if out.suffix.lower() in suffixes), None)
    if found is None:
        known = ", ".join(suffixes[0] for suffixes in SUFFIXES.values())
        raise UserError(f"{out.name} does not say what to write: end it in {known}, or give --format")
    return found


def check_options(arguments: Namespace, format: str) -> None:
    """Raise UserError for an option that another format has."""
    for option, formats in OPTIONS.items():
        value = getattr(arguments, option)
        if value is not None and value is not False and format not in formats:
            name = option.replace("_", "-")
            raise UserError(f"--{name} belongs to --format {' or '.join(formats)}; this writes {format}")
    if arguments.texture is not None and not 64 <= arguments.texture <= MAX_SIZE:
        raise UserError(f"--texture must be from 64 to {MAX_SIZE}, not {arguments.texture}")


def write_web(trained: TrainedAvatar, out: Path, arguments: Namespace) -> None:
    pack = make_pack() if arguments.webcam else None
    page = write_page(trained, out, arguments.precision or "small", webcam=arguments.webcam)
    print(f"Page     {out} ({page.bytes / MIB:.1f} MiB): opens in any browser, without a network")
    if page.note:
        print(f"Note     {page.note}")
    print(f"Licence  {licence_of(SKINNING)}")
    if pack is not None:
        write_mediapipe_pack(pack, out)


def write_mediapipe_pack(pack: bytes, out: Path) -> None:
    """Write the face landmarker beside a page or an avatar."""
    path = out.with_name(PACK)
    write_atomically(path, pack)
    digest = hashlib.sha256(pack).hexdigest()
    print(f"Camera   {path} ({len(pack) / MIB:.1f} MiB, SHA-256 {digest}): beside {out.name}, a camera drives it")
    print(f"Licence  {NOTICE}")


def write_web_file(trained: TrainedAvatar, out: Path, arguments: Namespace) -> None:
    pack = make_pack() if arguments.webcam else None
    size = write_web_avatar(trained, out, arguments.precision or "small")
    print(f'Avatar   {out} ({size / MIB:.1f} MiB), for <avatar-view src="{out.name}">')
    print(f"Licence  {licence_of(SKINNING)}")
    if pack is not None:
        write_mediapipe_pack(pack, out)


def write_splats(trained: TrainedAvatar, out: Path, arguments: Namespace) -> None:
    refuse_features(trained.config.model, "--format ply")
    licence = licence_of(NOTHING)

    def encode(params: HeadParams, camera: Camera) -> bytes:
        return encode_ply(trained.gaussians(params, camera), licence, arguments.up or "-y")

    if not arguments.motion:
        write_atomically(out, encode(*chosen_pose(trained, arguments)))
        print(f"Splats   {out} ({out.stat().st_size / MIB:.1f} MiB)")
    else:
        clip = chosen_clip(trained, arguments, arguments.motion)
        for number, (params, camera) in enumerate(tqdm(clip.frames, desc="splats", unit="frame", dynamic_ncols=True)):
            write_atomically(numbered(out, number), encode(params, camera))
        remove_longer(out, len(clip), print)
        print(f"Splats   {numbered(out, 0)} to {numbered(out, len(clip) - 1).name}, {clip.fps:g} a second")
    print(f"Licence  {licence}")


def write_mesh(trained: TrainedAvatar, out: Path, arguments: Namespace) -> None:
    refuse_features(trained.config.model, "--format glb")
    licence = licence_of(MESH)
    data, targets = encode_glb(trained, chosen_pose(trained, arguments)[0], arguments.texture or TEXTURE, licence)
    write_atomically(out, data)
    print(f"Mesh     {out} ({len(data) / MIB:.1f} MiB) with {len(targets)} morph targets: {', '.join(targets)}")
    print(f"Licence  {licence}")


def write_clip(trained: TrainedAvatar, out: Path, arguments: Namespace) -> None:
    clip = chosen_clip(trained, arguments, arguments.motion or "test")
    path = arguments.camera or "recorded"
    backdrop = None if arguments.background is None else parse_backdrop(arguments.background)
    write_movie(trained, clip, out, path, arguments.size, backdrop)
    print(f"Video    {out}: {len(clip)} frames, camera {path}")


def chosen_pose(trained: TrainedAvatar, arguments: Namespace) -> tuple[HeadParams, Camera]:
    """The frame of --frame, else the neutral face, and the camera that sees it."""
    if arguments.frame is None:
        return trained.rest_params(), trained.rest_camera()
    count = len(trained.recording)
    if not 0 <= arguments.frame < count:
        raise UserError(f"--frame must be from 0 to {count - 1}, not {arguments.frame}")
    return trained.recording.params(arguments.frame), trained.recording.camera(arguments.frame)


def chosen_clip(trained: TrainedAvatar, arguments: Namespace, motion: str) -> Clip:
    """What --motion names: frames of the avatar's own video, or a drive file."""
    if arguments.frame is not None:
        raise UserError("--frame is one frame and --motion are many: give one of the two")
    if (size := arguments.size) is not None and not 16 <= size <= MAX_SIZE:
        raise UserError(f"--size must be from 16 to {MAX_SIZE}, not {size}")
    width = size or trained.config.data.size
    if motion in OWN:
        return own_clip(trained, motion, width)
    if Path(motion).suffix.lower() not in DRIVE_SUFFIXES:
        raise UserError(f"--motion must be {', '.join(OWN)}, or a drive file (.npz, .csv, .json), not {motion}")
    return driven_clip(trained, open_drive_file(Path(motion), trained), width)


def write_avatar_format(trained: TrainedAvatar, out: Path, arguments: Namespace) -> None:
    content = read_avatar_file(trained.source)
    head = trained.assets if arguments.with_head else None
    licence = licence_of(WHOLE) if arguments.with_head else None
    write_avatar_file(out, replace(content, head=head), licence)
    print(f"Avatar   {out} ({out.stat().st_size / MIB:.1f} MiB)")
    if licence:
        print(f"Licence  {licence}")
    else:
        print(f"Next     avatar reenact {typed(out)} DRIVER --head HEAD; it needs the head model it was trained with")


SUFFIXES = {
    "web": (".html",),
    "web-avatar": (".avatar",),
    "avatar": (".safetensors",),
    "ply": (".ply",),
    "glb": (".glb",),
    "video": VIDEO_SUFFIXES,
}
WRITERS: dict[str, Callable[[TrainedAvatar, Path, Namespace], None]] = {
    "web": write_web,
    "web-avatar": write_web_file,
    "avatar": write_avatar_format,
    "ply": write_splats,
    "glb": write_mesh,
    "video": write_clip,
}
OPTIONS = {
    "precision": ("web", "web-avatar"),
    "webcam": ("web", "web-avatar"),
    "with_head": ("avatar",),
    "frame": ("ply", "glb"),
    "motion": ("ply", "video"),
    "up": ("ply",),
    "texture": ("glb",),
    "camera": ("video",),
    "size": ("video",),
    "background": ("video",),
}
