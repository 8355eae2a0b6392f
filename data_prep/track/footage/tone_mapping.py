"""ffmpeg's filters that bring a video's colours to sRGB: high dynamic range is mapped to that of a usual screen."""

from __future__ import annotations

import functools
import subprocess

from data_prep.ffmpeg import STALL_SECONDS, executable

HDR_TRANSFERS = {"smpte2084": "PQ", "arib-std-b67": "HLG"}
_NOMINAL_PEAK = 100  # candela per square metre that become white before the shoulder of the curve


def assumed_matrix(colour: tuple[str, ...], pixel_format: str, height: int) -> list[str]:
    """Before the scaling, which makes RGB; `colour` is ffmpeg's (range, matrix, primaries, transfer)."""
    if colour[1] == "unknown" and height >= 720 and not pixel_format.startswith(("rgb", "bgr", "gbr", "pal", "gray")):
        return ["setparams=colorspace=bt709"]  # what players take for untagged high definition
    return []


def tone_filters(colour: tuple[str, ...]) -> list[str]:
    """After the scaling, before the last `format`.

    PQ (SMPTE ST 2084) and HLG (ITU-R BT.2100) are made linear, brought to BT.709's primaries and compressed by Hable's
    curve with zimg. An ffmpeg without zimg gives the picture as if it were not HDR: right in shape, flat in colour.
    """
    matrix, transfer = colour[1], colour[3]
    if transfer in HDR_TRANSFERS and has_zimg():
        known = f"tin={transfer}:pin=bt2020:min={'bt2020nc' if matrix == 'unknown' else matrix}"
        return [
            f"zscale={known}:t=linear:npl={_NOMINAL_PEAK}",
            "format=gbrpf32le",
            "zscale=p=bt709",
            "tonemap=tonemap=hable:desat=0",
            "zscale=t=bt709:m=bt709:r=tv",
            "format=yuv444p",
        ]
    return []


@functools.cache
def has_zimg() -> bool:
    done = subprocess.run(
        [executable(), "-hide_banner", "-filters"], capture_output=True, timeout=STALL_SECONDS, check=False
    )
    return b" zscale " in done.stdout
