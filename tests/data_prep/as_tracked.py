"""A tracked folder as `avatar track` writes it, with the content of a metrical-tracker folder but for two frames."""

from __future__ import annotations

import shutil
from pathlib import Path

from avatar.head.assets import load_head_assets
from data_prep.formats import avatar_track
from data_prep.formats.avatar_track import TrackingInfo, write_tracking
from data_prep.formats.metrical_tracker import read_tracking

LOST = {5: "no face was found", 6: "no face was found"}


def write_as_tracked(original: Path, out: Path) -> Path:
    """`original` is a folder of `write_tracked_folder` whose pictures are PNG; returns `out`."""
    head = load_head_assets(original / "head_model")
    files = {int(path.stem): path for path in sorted((original / "checkpoint").iterdir())}
    tracks = read_tracking(files).frames
    first = tracks[0]
    for kind in (avatar_track.FRAMES, avatar_track.MATTE, avatar_track.HEAD, avatar_track.MOUTH):
        (out / kind).mkdir(parents=True)
    for number in tracks.keys() - LOST.keys():
        name = f"{number + 1:05d}"  # its pictures are numbered from 1
        shutil.copy(original / "imgs" / f"{name}.png", out / avatar_track.FRAMES / f"{number:05d}.png")
        shutil.copy(original / "alpha" / f"{name}.png", out / avatar_track.MATTE / f"{number:05d}.png")
        for kind, tag in ((avatar_track.HEAD, "neckhead"), (avatar_track.MOUTH, "mouth")):
            shutil.copy(original / "parsing" / f"{name}_{tag}.png", out / kind / f"{number:05d}.png")
    info = TrackingInfo(
        fps=29.97,
        width=first.size[0],
        height=first.size[1],
        intrinsics=tuple(first.intrinsics.tolist()),
        focal="assumed: a lens of 28 mm equivalent",
        focal_is_assumed=True,
        head_path=str(original / "head_model"),
        head_fingerprint=head.fingerprint,
        source={"video": "me.mp4"},
        left_out=LOST,
    )
    write_tracking(out, info, {n: track for n, track in tracks.items() if n not in LOST})
    return out
