"""Damaged and hostile files: every reader answers with the data or with one sentence, soon, in bounded memory.

AVATAR_FUZZ_CASES sets the number of mutated files of all readers together; the default is a short run for every day. A case
is found again by the reader's name and its number, which a failure prints. AVATAR_FUZZ_TABLE names a file for the table
of all readers (`make fuzz`: docs/bench/fuzz.md).
"""

from __future__ import annotations

import io
import json
import os
import pickletools
import random
import re
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mutate import mutate
from special_files import SPECIAL
from target import Target
from targets import make_targets
from watch import Forbidden, memory_cap, watched

from avatar.data.read_image import MAX_PIXELS, decode_image, decode_mask
from avatar.errors import UserError
from avatar.files.pickles import load_npy, load_npz, load_pickle

pytestmark = pytest.mark.slow

CASES = int(os.environ.get("AVATAR_FUZZ_CASES", "600"))
SECONDS = 5.0  # for one file of a few kilobytes, on a busy machine
NAMES = (
    "pickle", "torch", "torch, checksums right", ".frame", "npz", "npz, checksums right", "VHAP listing",
    "INSTA listing", "IMavatar listing", "NeRSemble calibration", "NeRSemble colours", "NeRSemble tracking",
    "NeRSemble tracking, checksums right", "INSTA mesh", "NHA tracking", "GaussianHeadAvatar camera",
    "NHA split",
    "manifest", "tracks", "checkpoint", "run.json", "UV obj", "head model",
    "regions", "eyelid", "image", "protocol", "drive .npz", "drive .npz, checksums right",
    "drive .csv", "Live Link Face", "drive .json", "override", "avatar file", "avatar file, its text",
    "avatar file with its head",
    "tracked folder", "its tracking", "its tracking, checksums right", "refined folder", "landmarks", "embedding", "sweep",
)  # fmt: skip

# These read no file by themselves, or go on without the frame.
FROM_MEMORY = {"pickle", "torch", "torch, checksums right", "image", "override", ".frame"}


@pytest.fixture(scope="module")
def targets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Target]:
    return make_targets(tmp_path_factory.mktemp("fuzz"))


def test_all_readers_are_fuzzed(targets: dict[str, Target]) -> None:
    assert tuple(targets) == NAMES


@pytest.fixture(scope="module")
def rows() -> Iterator[list[str]]:
    """Of the table: one for each reader that has passed."""
    rows: list[str] = []
    yield rows
    if (table := os.environ.get("AVATAR_FUZZ_TABLE")) and len(rows) == len(NAMES):
        head = ["# `make fuzz`", "", f"{CASES:,} damaged files; none did anything but be read or be refused.", ""]
        head += ["| reader | files | read | refused | slowest, ms |", "|---|---|---|---|---|"]
        Path(table).parent.mkdir(parents=True, exist_ok=True)
        Path(table).write_text("\n".join([*head, *rows, ""]), encoding="utf-8")


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("name", NAMES)
def test_reader(name: str, targets: dict[str, Target], rows: list[str]) -> None:
    target = targets[name]
    for seed in target.seeds:
        assert is_read(target, target.wrap(seed), name), "the starting points themselves are good"
    cases = max(5, round(CASES * target.weight / sum(t.weight for t in targets.values())))
    accepted, slowest = 0, 0.0
    for case in range(cases):
        rng = random.Random(f"{name} {case}")
        data = target.wrap(mutate(rng, rng.choice(target.seeds), target.seeds))
        begin = time.monotonic()
        accepted += is_read(target, data, f"{name}, case {case}")
        slowest = max(slowest, time.monotonic() - begin)
        assert slowest < SECONDS, f"{name}, case {case} took {slowest:.1f} s"
    rows.append(f"| {name} | {cases:,} | {accepted:,} | {cases - accepted:,} | {1000 * slowest:.0f} |")
    print(f"{name}: {cases} files, {accepted} read, {cases - accepted} refused, slowest {1000 * slowest:.0f} ms")


def is_read(target: Target, data: bytes, where: str) -> bool:
    """Whether the file was read; anything but data or a UserError is a failure, as is anything done on the side."""
    file, read = target.reader
    if file is not None:
        file.write_bytes(data)
    try:
        with memory_cap(), watched() as events:
            read(data)
    except UserError as error:
        assert not events and 0 < len(str(error)) < 4000, where
        return False
    except Exception as error:
        raise AssertionError(f"{where}: {type(error).__name__}: {error}") from error
    assert not events, where
    return True


@pytest.mark.timeout(20, func_only=True)
@pytest.mark.parametrize("kind", SPECIAL)
@pytest.mark.parametrize("name", [name for name in NAMES if name not in FROM_MEMORY])
def test_what_is_no_file_is_refused_at_once(name: str, kind: str, targets: dict[str, Target]) -> None:
    """In its place lies a FIFO, a device, a file larger than memory: none is waited for or read to its end."""
    target, (make, word) = targets[name], SPECIAL[kind]
    file, read = target.reader
    assert file is not None
    file.unlink(missing_ok=True)
    make(file)
    try:
        with memory_cap(), pytest.raises(UserError, match=re.escape(word)) as refusal:
            read(b"")
        assert file.name in str(refusal.value)
    finally:
        file.rmdir() if file.is_dir() else file.unlink()
        file.write_bytes(target.wrap(target.seeds[0]))


@pytest.mark.parametrize(
    ("name", "goes_on"),
    [("drive .npz, checksums right", False), ("its tracking, checksums right", True)],  # which leaves the frame out
)
def test_a_signalling_nan_makes_no_warning(name: str, goes_on: bool, targets: dict[str, Target]) -> None:
    target = targets[name]
    damaged = target.seeds[0][:-4] + b"\0\0\xa0\x7f"
    assert is_read(target, target.wrap(damaged), "an array that ends in a signalling NaN") == goes_on


def test_the_watch_sees_what_it_forbids(tmp_path: Path) -> None:
    deeds: list[Callable[[], object]] = [
        lambda: os.system("true"),
        lambda: subprocess.run(["true"]),
        lambda: (tmp_path / "marker").write_text(""),
        lambda: tmp_path.rmdir(),
    ]
    for deed in deeds:
        with watched() as events, pytest.raises(Forbidden):
            deed()
        assert events
    with memory_cap(), pytest.raises(MemoryError):
        np.ones(2**28)
    assert list(tmp_path.iterdir()) == []


VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=5)
    | st.sampled_from(["images/a.png", ".."]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=2),
    max_leaves=8,
)
KEYS = [
    "file_path",
    "flame_param_path",
    "fg_mask_path",
    "camera_id",
    "transform_matrix",
    "fl_x",
    "fl_y",
    "cx",
    "cy",
    "w",
]
KEYS += [
    "h",
    "camera_angle_x",
    "seg_mask_path",
    "expression",
    "pose",
    "world_mat",
    "intrinsics",
    "shape_params",
    "frames",
]


@pytest.mark.parametrize("name", ["VHAP listing", "INSTA listing", "IMavatar listing"])
def test_listings_with_any_value_for_any_key(name: str, targets: dict[str, Target]) -> None:
    target, read = targets[name], set()
    good = json.loads(target.seeds[0])

    @settings(
        max_examples=max(20, CASES // 60), deadline=None, derandomize=True, suppress_health_check=list(HealthCheck)
    )
    @given(st.dictionaries(st.sampled_from(KEYS), VALUES, max_size=3), st.dictionaries(st.sampled_from(KEYS), VALUES))
    def check(of_frame: dict, shared: dict) -> None:
        frames = [entry | of_frame if i == 1 else entry for i, entry in enumerate(good["frames"])]
        read.add(is_read(target, json.dumps({**good, "frames": frames, **shared}).encode(), name))

    check()
    assert read == {True, False}


ARGUMENTS = st.sampled_from(
    [b"", b"\0", b"\1", b"\xff", b"\0\0\0\0", b"\1\0\0\0", b"\xff\xff\xff\x7f", b"os\nsystem\n", b"12\n"]
)
CODES = st.sampled_from([opcode.code.encode("latin1") for opcode in pickletools.opcodes])


@settings(max_examples=max(200, CASES // 3), deadline=None, derandomize=True)
@given(st.lists(st.tuples(CODES, ARGUMENTS), max_size=30))
def test_any_sequence_of_instructions(program: list[tuple[bytes, bytes]]) -> None:
    data = b"".join(code + argument for code, argument in program) + b"."
    try:
        with memory_cap(), watched() as events:
            load_pickle(data, "x")
    except UserError:
        pass
    assert not events


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_header_cannot_make_us_allocate(suffix: str) -> None:
    data = bytearray(cv2.imencode(suffix, np.zeros((8, 8, 3), np.uint8))[1].tobytes())
    if suffix == ".png":
        data[16:24] = (30_000).to_bytes(4, "big") * 2
    else:
        start = data.index(b"\xff\xc0")
        data[start + 5 : start + 9] = (30_000).to_bytes(2, "big") * 2
    for decode in (decode_image, decode_mask):
        with pytest.raises(
            UserError, match=f"claims to have 30000x30000 pixels; images of more than {MAX_PIXELS} are not"
        ):
            decode(bytes(data), Path("huge"))


def test_an_array_header_cannot_make_us_allocate(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, {"descr": "<f8", "fortran_order": False, "shape": (2**40,)})
    (tmp_path / "huge.npy").write_bytes(buffer.getvalue() + b"\0" * 64)
    with pytest.raises(UserError, match=r"an array of shape \[1099511627776\] needs 8796093022208 bytes, it has 64"):
        load_npy(tmp_path / "huge.npy")
    np.savez(tmp_path / "small.npz", a=np.arange(3), b=np.asfortranarray(np.eye(3)))
    read = load_npz(tmp_path / "small.npz")
    assert read["a"].tolist() == [0, 1, 2] and np.array_equal(read["b"], np.eye(3))
