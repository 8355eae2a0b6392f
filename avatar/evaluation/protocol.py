"""Evaluation protocols: what exactly is measured, written down, because published figures differ in every one of these.

A protocol is a small YAML file: those of configs/protocol/ go by their names, anybody's own by its path. The choices in
which protocols differ are the fields of `Protocol`; those that all of them share are in `SHARED_CHOICES`.
"""

from __future__ import annotations

import dataclasses
import difflib
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

from avatar.config_values import config_dir
from avatar.data.colours import COLOUR_WORDS, Colour, parse_colour
from avatar.data.split import Split
from avatar.errors import UserError
from avatar.files.plain_yaml import read_yaml
from avatar.losses.lpips_network import Net

Region = str  # one of REGIONS
Mask = Literal["multiply", "none", "only"]
Levels = Literal["round", "truncate", "float"]

MEASURES = ("psnr", "ssim", "lpips")
RIMS: tuple[Region, ...] = ("head_rim", "neck_rim")
REGIONS: tuple[Region, ...] = ("head", "mouth", "eyes", "rest", *RIMS)
HELD_OUT = "held-out"
NAME = re.compile(r"[A-Za-z0-9_-]+")  # of a protocol, and of its folder
MAX_BYTES = 1 << 16  # of a protocol file: those that come with the program have 2 KB

SHARED_CHOICES = {
    "truth": "image * (alpha * head mask) + background * (1 - alpha * head mask), then clamped and brought to levels as "
    "the render",
    "render": "drawn over the same background",
    "regions": "head: the data's head mask; mouth: the data's mouth mask; eyes: two boxes about the projected eyeballs of "
    "the head model, times the head mask, without the mouth; rest: the head mask without mouth and eyes; head_rim and "
    "neck_rim: the pixels within 8/256 of the longer side of the outline of alpha * head mask, on both sides, nearest to "
    "a vertex of the head or of the neck; all rounded to 8 bits and used as weights in [0, 1]",
    "psnr": "10 log10(1 / mean square error over pixels and channels) of values in [0, 1], in dB",
    "ssim": "11x11 Gaussian window, sigma 1.5, K 0.01 and 0.03, population covariance, whole windows only, mean of the "
    "channels; as scikit-image's structural_similarity with gaussian_weights=True, use_sample_covariance=False",
    "lpips": "version 0.1, images brought to [-1, 1], times the protocol's lpips_scale",
    "of_a_region": "weighted mean over the region alone of squared error and of the SSIM map; LPIPS of both images times "
    "the mask, cropped to its bounding box grown to at least 64 pixels; none of a rim",
    "jitter": "of the head, in levels of 8 bits: with e = render - truth, the mean over pixels and channels of "
    "|e(t-1) - 2 e(t) + e(t+1)|, weighted by the smallest of the three head masks; none where a neighbour is missing",
    "yaw": "degrees about the head's vertical axis from which the camera sees it, positive from the head's own left",
    "expression_distance": "root mean square distance of the vertices, in mm, neck and head at rest, from the training "
    "frame where it is smallest",
    "worst": "lowest main PSNR",
    "tracked": "the avatar driven by what the tracker left; refined: by the tracking that was then fitted to each frame's "
    "own picture, measured frames too; masks and regions are the same for both",
    "means": "over frames, of the figures of each frame; a frame without a pixel in a region has no figure there",
}


class ImageFormat(NamedTuple):
    """How render and truth become the pictures that are compared; protocols that agree in it share the pictures."""

    background: Colour
    clamp: bool
    levels: Levels


@dataclass(frozen=True)
class Protocol:
    """One way to evaluate. A file gives every field but the name, which is the file's."""

    name: str
    summary: str  # one sentence for people
    source: str  # where the choices come from; what is known of it and what is a reading
    frames: Literal["held-out"] | int  # held out in training; or those not trained on of so many last frames or times
    background: Colour  # under render and truth
    # Main figures: of images x head mask ("multiply") or as they are ("none"), both over the whole frame; or of the head
    # mask alone ("only").
    mask: Mask
    clamp: bool  # to [0, 1] before anything is measured
    levels: Levels  # 8 bits by rounding or by truncation, or floats as they are
    regions: tuple[Region, ...]  # measured each by itself, beside the main figures
    lpips_net: Net
    lpips_scale: float  # factor on LPIPS

    @property
    def image_format(self) -> ImageFormat:
        return ImageFormat(self.background, self.clamp, self.levels)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the figures of each frame: `psnr`, `ssim`, `lpips`, then each with `_REGION`, then `jitter`."""
        return (*(name for region in (None, *self.regions) for name in columns_of(region)), "jitter")

    def choices(self) -> dict[str, Any]:
        """Every choice by name, for results files."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self) if field.name != "name"}

    def select(self, times: Sequence[int], split: Split) -> tuple[int, ...]:
        """Indices of the frames evaluated, never one that was trained on.

        times  of each frame; the pictures of several cameras share them
        """
        if self.frames == HELD_OUT:
            return split.test
        last, trained = set(sorted(set(times))[-self.frames :]), set(split.train)
        return tuple(i for i, time in enumerate(times) if time in last and i not in trained)


def column(measure: str, region: Region | None) -> str:
    """The name of a figure; region None: the protocol's main figure."""
    return measure if region is None else f"{measure}_{region}"


def columns_of(region: Region | None) -> tuple[str, ...]:
    """The names of a region's figures; rims have no LPIPS, whose pictures would be black but for a line."""
    return tuple(column(measure, region) for measure in MEASURES if not (measure == "lpips" and region in RIMS))


def builtin_protocols() -> dict[str, Path]:
    """The files that come with the program, by name, in the order of the table."""
    order = ("hypergaussians", "flashavatar", "insta350", "rgbavatar", "strict")
    return {name: config_dir() / "protocol" / f"{name}.yaml" for name in order}


def choose_protocols(given: Sequence[str] | None) -> list[Protocol]:
    """Protocols by name or by path of a YAML file, each once; all that come with the program for None.

    Raises UserError for an unknown name, a file that is not a protocol, or two protocols of one name.
    """
    builtin = builtin_protocols()
    chosen: dict[str, Protocol] = {}
    for word in given or builtin:
        if word in builtin:
            protocol = read_protocol(builtin[word])
        elif word.endswith((".yaml", ".yml")):
            protocol = read_protocol(Path(word))
            if protocol.name in builtin or chosen.get(protocol.name, protocol) != protocol:
                raise UserError(
                    f"{word}: there is another protocol {protocol.name!r} already; give the file another name"
                )
        else:
            raise UserError(
                f"there is no protocol {word!r}; choose from {', '.join(builtin)}, or give the path of a .yaml file"
            )
        chosen[protocol.name] = protocol
    return list(chosen.values())


def read_protocol(path: Path) -> Protocol:
    """The protocol of a file. Raises UserError naming the file and the key for anything that is not as it should be."""
    values = read_yaml(path, MAX_BYTES)
    if not isinstance(values, dict):
        raise UserError(f"{path} is not a protocol: it has to hold lines of the form key: value")
    if not NAME.fullmatch(path.stem):
        raise UserError(f"{path}: the file's name names the protocol and a folder; use letters, digits, - and _ only")
    for key in values:
        if key not in EXPECTED:
            near = difflib.get_close_matches(str(key), EXPECTED, n=1)
            raise UserError(f"{path}: there is no key {key!r}" + (f"; the nearest is {near[0]!r}" if near else ""))
    missing = [key for key in EXPECTED if key not in values]
    if missing:
        raise UserError(f"{path}: {', '.join(missing)} missing; a protocol names every choice")
    checked = {}
    for key, (read, expected) in EXPECTED.items():
        try:
            checked[key] = read(values[key])
        except (ValueError, OverflowError):
            shown = repr(values[key])
            shown = f"{shown[:60]}{'...' if len(shown) > 60 else ''}"
            raise UserError(f"{path}: {key} is {shown}, and has to be {expected}") from None
    protocol = Protocol(name=path.stem, **checked)
    if not protocol.clamp and protocol.levels != "float":
        raise UserError(f"{path}: clamp: false needs levels: float, because 8 bits hold nothing outside [0, 1]")
    return protocol


def _if(is_right: bool, value: Any) -> Any:
    """The value. Raises ValueError where it is wrong."""
    if not is_right:
        raise ValueError
    return value


def _text(value: Any) -> str:
    return _if(isinstance(value, str) and bool(value.strip()), value).strip()


def _frames(value: Any) -> str | int:
    return _if(value == HELD_OUT or (isinstance(value, int) and not isinstance(value, bool) and value > 0), value)


def _flag(value: Any) -> bool:
    return _if(isinstance(value, bool), value)


def _regions(value: Any) -> tuple[Region, ...]:
    is_list = isinstance(value, list) and len(set(map(str, value))) == len(value)
    _if(is_list and all(one in REGIONS for one in value), value)
    return tuple(region for region in REGIONS if region in value)


def _scale(value: Any) -> float:
    return float(_if(isinstance(value, int | float) and not isinstance(value, bool) and 0 < value <= 1, value))


def _choice(*choices: str) -> tuple[Callable[[Any], str], str]:
    return lambda value: _if(value in choices, value), f"one of {', '.join(choices)}"


# Every key of a file: what reads its value, and what that has to be.
EXPECTED: dict[str, tuple[Callable[[Any], Any], str]] = {
    "summary": (_text, "a sentence"),
    "source": (_text, "a sentence"),
    "frames": (_frames, f"{HELD_OUT}, or how many frames at the end of the video"),
    "background": (parse_colour, COLOUR_WORDS.replace("#rrggbb", '"#rrggbb"')),  # without quotes it is a comment
    "mask": _choice(*get_args(Mask)),
    "clamp": (_flag, "true or false"),
    "levels": _choice(*get_args(Levels)),
    "regions": (_regions, f"a list of some of {', '.join(REGIONS)}, each once"),
    "lpips_net": _choice(*get_args(Net)),
    "lpips_scale": (_scale, "a number above 0, at most 1"),
}
