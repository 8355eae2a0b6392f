"""Files that torch.save might have written, but did not."""

from __future__ import annotations

import io
import pickle
import zipfile

import numpy as np
import pytest
from pickle_parts import text

from avatar.errors import UserError
from avatar.files.pickles import load_torch_pickle


def torch_zip(persistent: bytes, members: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    buffer = io.BytesIO()
    tensor = (
        b"ctorch._utils\n_rebuild_tensor_v2\n("
        + persistent
        + b"K\x00K\x02\x85K\x01\x85\x89ccollections\nOrderedDict\n)RtR."
    )
    with zipfile.ZipFile(buffer, "w", compression) as archive:
        archive.writestr("archive/data.pkl", b"\x80\x02" + tensor)
        for member, data in members.items():
            archive.writestr(member, data)
    return buffer.getvalue()


def storage(key: str = "0", kind: bytes = b"ctorch\nFloatStorage\n", count: int = 2) -> bytes:
    return b"(" + text("storage") + kind + text(key) + text("cpu") + b"K" + bytes([count]) + b"tQ"


EIGHT_BYTES = {"archive/data/0": np.array([1.0, 2.0], np.float32).tobytes()}
TORCH: dict[str, tuple[bytes, str]] = {
    "a key that leaves the archive": (torch_zip(storage("../0"), EIGHT_BYTES), "storage of an unknown type"),
    "a storage type that is a function": (torch_zip(storage(kind=b"cos\nsystem\n"), EIGHT_BYTES), "os.system"),
    "a storage type that is another known name": (
        torch_zip(storage(kind=b"cnumpy\ndtype\n"), EIGHT_BYTES),
        "storage of an unknown type",
    ),
    "two pickles": (torch_zip(storage(), EIGHT_BYTES | {"other/data.pkl": b"N."}), "it has 2 data.pkl"),
    "a storage that is not there": (torch_zip(storage("7"), EIGHT_BYTES), "damaged"),
    "a storage of another length": (torch_zip(storage(count=9), EIGHT_BYTES), "needs 36 bytes but has 8"),
    "a tensor beyond its storage": (torch_zip(storage(count=1), {"archive/data/0": b"abcd"}), "outside its storage"),
    "an id that is not a storage": (torch_zip(text("module") + b"Q", {}), "not a torch storage"),
    "a storage of names": (torch_zip(b"(" + text("storage") + b"(ltQ", EIGHT_BYTES), "storage of an unknown type"),
    "compressed members": (torch_zip(storage(), EIGHT_BYTES, zipfile.ZIP_DEFLATED), "compressed members"),
    "a zip of something else": (b"PK\x05\x06" + b"\0" * 18, "a zip file that torch.save did not write"),
    "half a zip": (torch_zip(storage(), EIGHT_BYTES)[:-30], "damaged or cut short"),
    "a plain pickle": (pickle.dumps({"flame": 1}), "was not written by torch.save"),
    "nothing": (b"", "is empty"),
}


@pytest.mark.parametrize("name", TORCH)
def test_hostile_torch_files(name: str) -> None:
    data, reason = TORCH[name]
    with pytest.raises(UserError) as refusal:
        load_torch_pickle(data, "00003.frame")
    assert str(refusal.value).startswith("00003.frame ") and reason in str(refusal.value)


def test_the_torch_bait_is_well_formed() -> None:
    np.testing.assert_array_equal(load_torch_pickle(torch_zip(storage(), EIGHT_BYTES)), np.array([1, 2], np.float32))
