"""Small pickles that ask for much memory or time: they get neither."""

from __future__ import annotations

import io
import pickle
import struct
import time
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from avatar.errors import UserError
from avatar.files.pickles import MIN_BUDGET_BYTES, load_npz, load_pickle, load_torch_pickle

HUGE = 2**28


def claim(code: bytes, form: str, length: int = HUGE) -> bytes:
    return b"\x80\x05" + code + struct.pack(form, length) + b"x."


CLAIMS: dict[str, bytes] = {
    "BINBYTES": claim(b"B", "<I"),
    "BINBYTES8": claim(b"\x8e", "<Q"),
    "BINBYTES8 beyond any memory": claim(b"\x8e", "<Q", 2**63 + 1),
    "BYTEARRAY8": claim(b"\x96", "<Q"),
    "BYTEARRAY8 beyond any memory": claim(b"\x96", "<Q", 2**64 - 1),
    "BINUNICODE": claim(b"X", "<I"),
    "BINUNICODE8": claim(b"\x8d", "<Q"),
    "BINSTRING": claim(b"T", "<i"),
    "LONG4": claim(b"\x8b", "<i"),
    "FRAME": claim(b"\x95", "<Q"),
    "FRAME beyond any memory": claim(b"\x95", "<Q", 2**60),
    "LONG_BINPUT": claim(b"Nr", "<I"),
    "PUT": b"Np1000000000000\nX.",
}


def peak(data: bytes) -> tuple[int, Exception | None]:
    """The most bytes that reading takes, and how it was refused."""
    tracemalloc.start()
    refusal = None
    try:
        load_pickle(data, "model.pkl")
    except UserError as error:
        refusal = error
    finally:
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    return most, refusal


@pytest.mark.parametrize("name", CLAIMS)
def test_what_a_length_claims_is_not_allocated(name: str) -> None:
    most, refusal = peak(CLAIMS[name])
    assert most < 2**20
    assert str(refusal).startswith("model.pkl is damaged, cut short or not a pickle (")


def test_a_far_memo_slot_is_one_slot() -> None:
    for put, get in ((b"r\xff\xff\xff\x0f", b"j\xff\xff\xff\x0f"), (b"p1000000000000\n", b"g1000000000000\n")):
        data = b"K\x07" + put + b"0" + get + b"."
        assert load_pickle(data) == 7 and peak(data)[0] < 2**20


def again(made_once: bytes, made_each_time: bytes, times: int = 3000) -> bytes:
    """A list of what the second part makes `times` times; the first part leaves something in memo slots."""
    return b"\x80\x04" + made_once + b"0](" + made_each_time * times + b"e."


BYTES = b"B" + struct.pack("<I", 2**18) + b"a" * 2**18 + b"q\x01"
VECTOR = pickle.dumps(np.zeros(2**15, np.int64), 2)[2:-1].replace(b"q\x01", b"q\xf1") + b"q\x01"
NUMBERS = b"](" + b"".join(b"M" + struct.pack("<H", k) for k in range(2**15)) + b"eq\x01"
PAIRS = b"](" + b"".join(b"M" + struct.pack("<H", k) + b"N\x86" for k in range(2**15)) + b"eq\x01"
GREEDY: dict[str, bytes] = {
    "a set of one list": again(NUMBERS, b"cbuiltins\nset\nh\x01\x85R"),
    "a dictionary of one list": again(PAIRS, b"ccollections\nOrderedDict\nh\x01\x85R"),
    "an array of bytes": again(BYTES, b"cbuiltins\nbytearray\nh\x01\x85R"),
    "an array of the same bytes": again(
        BYTES + b"0cnumpy\ndtype\nX\x02\0\0\0u1\x85Rq\x020J\x00\x00\x04\x00\x85q\x03",
        b"cnumpy.core.numeric\n_frombuffer\n(h\x01h\x02h\x03X\x01\0\0\0CtR",
    ),
    "a matrix of one vector": again(
        VECTOR + b"0(K\x01K\x01tq\x02",
        b"cscipy.sparse.coo\ncoo_matrix\n)\x81}(X\x05\0\0\0shapeh\x02X\x04\0\0\0datah\x01X\x03\0\0\0rowh\x01X\x03\0\0\0colh\x01ub",
    ),
}


@pytest.mark.parametrize("name", GREEDY)
def test_what_is_made_again_and_again_counts_each_time(name: str) -> None:
    begin = time.monotonic()
    most, refusal = peak(GREEDY[name])
    assert "model.pkl was not read: it would unpack to more than 64 MiB of arrays" in str(refusal)
    assert most < 2 * MIN_BUDGET_BYTES and time.monotonic() - begin < 20


def test_objects_share_the_attributes_that_the_file_gives_them_together() -> None:
    entries = b"}(" + b"".join(b"M" + struct.pack("<H", k) + b"N" for k in range(2**15)) + b"X\x01\0\0\0x"
    entries += pickle.dumps(np.arange(3), 2)[2:-1].replace(b"q\x01", b"q\xf1") + b"uq\x01"
    data = again(entries, b"cchumpy.ch\nCh\n)\x81h\x01b")
    most, refusal = peak(data)
    assert refusal is None and most < 2**25
    assert all(value.tolist() == [0, 1, 2] for value in load_pickle(data))


def test_one_storage_named_often_counts_each_time() -> None:
    storage = b"X\x07\0\0\0storagectorch\nFloatStorage\nX\x01\0\0\0" + b"0X\x03\0\0\0cpuJ\x00\x00\x04\x00tQ"
    tensor = b"ctorch._utils\n_rebuild_tensor_v2\n((" + storage + b"K\x00K\x02\x85K\x01\x85\x89NtR"
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("archive/data.pkl", b"\x80\x02](" + tensor * 1000 + b"e.")
        archive.writestr("archive/data/0", bytes(2**20))
    with pytest.raises(UserError, match=r"it would unpack to more than 64 MiB of arrays"):
        load_torch_pickle(file.getvalue())


@pytest.mark.slow
def test_a_deep_nest_is_made_and_thrown_away() -> None:
    assert load_pickle(b")" + b"\x85" * 2_000_000 + b"0N.") is None


def test_a_device_without_end_is_not_read() -> None:
    with pytest.raises(UserError, match=r"^/dev/zero is a device"):
        load_pickle("/dev/zero")


def test_a_damaged_lzma_member_of_an_npz_is_refused(tmp_path: Path) -> None:
    path, values = tmp_path / "a.npz", np.arange(1000)
    np.save(tmp_path / "a.npy", values)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as archive:
        archive.write(tmp_path / "a.npy", "a.npy")
    data = bytearray(path.read_bytes())
    np.testing.assert_array_equal(load_npz(path)["a"], values)
    refused = 0
    for place in range(60, 260):
        path.write_bytes(bytes([*data[:place], data[place] ^ 0xFF, *data[place + 1 :]]))
        try:
            np.testing.assert_array_equal(load_npz(path)["a"], values)
        except UserError:
            refused += 1
    assert refused == 200
