"""Pickles that want to run something: each would leave a marker file behind, and none may."""

from __future__ import annotations

import copyreg
import io
import pickle
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from avatar.errors import UserError
from avatar.files.pickles import UnsafeFileError, load_pickle, load_torch_pickle

EXTENSION_CODE = 240


def text(value: str) -> bytes:
    """BINUNICODE."""
    raw = value.encode()
    return b"X" + struct.pack("<I", len(raw)) + raw


def touch(marker: Path) -> str:
    return f"open({str(marker)!r}, 'w').close()"


def stack_global(module: str, name: str) -> bytes:
    return b"\x80\x04" + text(module) + text(name) + b"\x93"


# Each makes the marker when Python's own pickle reads it (checked below), and the name that the refusal must contain.
LIVE: dict[str, tuple[Callable[[Path], bytes], str]] = {
    "os.system": (lambda m: b"cos\nsystem\n(" + text(f"touch '{m}'") + b"tR.", "os.system"),
    "posix.system": (lambda m: b"cposix\nsystem\n(" + text(f"touch '{m}'") + b"tR.", "posix.system"),
    "builtins.eval": (lambda m: b"cbuiltins\neval\n(" + text(touch(m)) + b"tR.", "builtins.eval"),
    "Python 2 eval": (lambda m: b"c__builtin__\neval\n(" + text(touch(m)) + b"tR.", "__builtin__.eval"),
    "exec, protocol 4": (lambda m: stack_global("builtins", "exec") + text(touch(m)) + b"\x85R.", "builtins.exec"),
    "open": (lambda m: b"cbuiltins\nopen\n(" + text(str(m)) + text("w") + b"tR.", "builtins.open"),
    "getattr chain": (
        lambda m: b"cbuiltins\ngetattr\n(cimportlib\nimport_module\n(" + text("os") + b"tR" + text("system") + b"tR("
        + text(f"touch '{m}'") + b"tR.",
        "builtins.getattr",
    ),
    "INST": (lambda m: b"(" + text(f"touch '{m}'") + b"ios\nsystem\n.", "instruction INST"),
    "OBJ": (lambda m: b"(cbuiltins\neval\n" + text(touch(m)) + b"o.", "builtins.eval"),
    "NEWOBJ": (lambda m: b"\x80\x02cpathlib\nPath\n)\x81cos\nsystem\n(" + text(f"touch '{m}'") + b"tR.", "pathlib.Path"),
    "NEWOBJ_EX": (
        lambda m: b"\x80\x04cio\nFileIO\n(" + text(str(m)) + text("w") + b"t}\x92cbuiltins\nopen\n("
        + text(str(m)) + text("w") + b"tR.",
        "io.FileIO",
    ),
    "extension registry": (lambda m: b"\x80\x02\x82" + bytes([EXTENSION_CODE]) + b"(" + text(touch(m)) + b"tR.",
                           "instruction EXT1"),
    "nested pickle": (
        lambda m: b"c_pickle\nloads\n(B" + struct.pack("<I", len(p := b"cbuiltins\neval\n(" + text(touch(m)) + b"tR."))
        + p + b"tR.",
        "_pickle.loads",
    ),
    "torch nested load": (
        lambda m: b"cfunctools\npartial\n(cbuiltins\neval\n" + text(touch(m)) + b"tR)R.",
        "functools.partial",
    ),
    "operator.methodcaller": (
        lambda m: b"coperator\nmethodcaller\n(" + text("__call__") + text(touch(m)) + b"tR(cbuiltins\neval\ntR.",
        "operator.methodcaller",
    ),
    "method of a known class": (
        lambda m: stack_global("numpy", "ndarray.tofile") + b"(" + pickle.dumps(np.zeros(2), 2)[2:-1] + text(str(m))
        + b"tR.",
        "numpy.ndarray.tofile",
    ),
    "numpy.f2py": (
        lambda m: stack_global("numpy.f2py.crackfortran", "myeval") + text(touch(m)) + b"\x85R.",
        "numpy.f2py.crackfortran.myeval",
    ),
    "numpy.save": (
        lambda m: b"cnumpy\nsave\n(" + text(f"{m}") + pickle.dumps(np.zeros(2), 2)[2:-1] + b"tR.",
        "numpy.save",
    ),
    "attributes of a class by BUILD": (
        lambda m: b"ccodecs\nStreamWriter\n(cbuiltins\nopen\n(" + text(str(m)) + text("w") + b"tRtR(d"
        + text("x") + b"I1\nsb.",
        "codecs.StreamWriter",
    ),
    "inside an object array": (
        lambda m: pickle.dumps(np.array([Touch(m)], dtype=object), 2),
        "array of dtype 'O8'",
    ),
    "as a dictionary value": (lambda m: pickle.dumps({"v_template": np.zeros(2), "f": Touch(m)}, 4), "io.open"),
}  # fmt: skip


class Touch:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple:
        return open, (str(self.marker), "w")


@pytest.fixture
def marker(tmp_path: Path) -> Path:
    return tmp_path / "marker"


@pytest.fixture(autouse=True)
def _extension():
    copyreg.add_extension("builtins", "eval", EXTENSION_CODE)
    yield
    copyreg.remove_extension("builtins", "eval", EXTENSION_CODE)


@pytest.mark.parametrize("name", LIVE)
def test_live_pickles_run_nothing(name: str, marker: Path) -> None:
    make, named = LIVE[name]
    data = make(marker)
    for load in (load_pickle, load_torch_pickle):
        with pytest.raises(UnsafeFileError) as refusal:
            load(data, "model.pkl")
        assert str(refusal.value).startswith("model.pkl was not read: it") and named in str(refusal.value)
    torch_file = io.BytesIO()
    with zipfile.ZipFile(torch_file, "w") as archive:
        archive.writestr("archive/data.pkl", data)
    with pytest.raises(UnsafeFileError, match=r"^00001\.frame was not read: it "):
        load_torch_pickle(torch_file.getvalue(), "00001.frame")
    assert not marker.exists() and not marker.with_suffix(".npy").exists()

    # The bait is real: Python's own reader runs it.
    try:
        pickle.loads(data)
    except Exception as error:
        print(error)
    assert marker.exists() or marker.with_suffix(".npy").exists()


def array_state(shape: bytes, dtype: str, raw: bytes) -> bytes:
    """An ndarray with this state, whatever it says."""
    return (
        b"\x80\x02cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85C\x01b\x87R(K\x01" + shape
        + b"cnumpy\ndtype\n" + text(dtype) + b"\x89\x88\x87R\x89" + raw + b"tb."
    )  # fmt: skip


def sparse(**state: object) -> bytes:
    attributes = pickle.dumps(state, 2)[2:-1]
    return b"\x80\x02cscipy.sparse.csc\ncsc_matrix\n)\x81" + attributes + b"b."


def laughs() -> bytes:
    """Lists of ten references to lists of ten references ... around one array: 10^9 arrays when copied out."""
    data = pickle.dumps(np.zeros(1000), 2)[:-1]
    for level in range(9):
        slot = bytes([200 + level])
        data += b"q" + slot + b"0](" + (b"h" + slot) * 10 + b"e"
    return data + b"."


I = np.arange  # noqa: E741
MISUSED: dict[str, tuple[bytes, str]] = {
    "_reconstruct of another class": (
        b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\ndtype\n(I0\ntC\x01btR.", "calls numpy.core.multiarray._reconstruct"
    ),
    "encode with another codec": (b"c_codecs\nencode\n(" + text("x") + text("rot13") + b"tR.", "calls _codecs.encode"),
    "encode of a number": (b"c_codecs\nencode\n(I5\n" + text("latin1") + b"tR.", "int where a str must be"),
    "ndarray called": (b"cnumpy\nndarray\n(I5\ntR.", "calls numpy.ndarray"),
    "_reconstructor of another base": (
        b"ccopy_reg\n_reconstructor\n(cchumpy.ch\nCh\nc__builtin__\nset\nNtR.", "calls copyreg._reconstructor"
    ),
    "_reconstructor of set": (
        b"ccopy_reg\n_reconstructor\n(c__builtin__\nset\nc__builtin__\nobject\nNtR.", "makes an object of builtins.set"
    ),
    "chumpy called": (b"cchumpy.ch\nCh\n(I5\ntR.", "calls chumpy.ch.Ch"),
    "chumpy made with arguments": (b"\x80\x02cchumpy.ch\nCh\nI5\n\x85\x81.", "makes an object of chumpy.ch.Ch"),
    "a bare class": (b"(lcnumpy\nndarray\na.", "reference to numpy.ndarray where data is expected"),
    "state on a dictionary": (b"(d(dS'a'\nI1\nsb.", "sets the state of a dict"),
    "state on a class": (b"cchumpy.ch\nCh\n(d" + text("x") + b"I1\nsb.", "sets the state of a Global"),
    "state on a function": (b"c_codecs\nencode\n(dS'a'\nI1\nsb.", "sets the state of a Global"),
    "state twice": (array_state(b"K\x01\x85", "u1", b"C\x01x")[:-1] + b"(NNNNtb.", "sets the state of a ArrayValue"),
    "persistent id, text": (b"Pstorage\n.", "instruction PERSID"),
    "persistent id": (b"\x80\x02" + text("storage") + b"Q.", "instruction BINPERSID"),
    "out-of-band buffer": (b"\x80\x05\x97.", "instruction NEXT_BUFFER"),
    "object dtype": (array_state(b"K\x01\x85", "O8", b"]N\x61"), "dtype 'O8'"),
    "structured dtype": (
        b"\x80\x02cnumpy\ndtype\n" + text("V8") + b"\x89\x88\x87R.", "dtype 'V8'"
    ),
    "dtype that is not text": (b"cnumpy\ndtype\n(]I0\nI1\ntR.", "dtype that is not text"),
    "dtype with fields": (
        b"\x80\x02cnumpy\ndtype\n" + text("f8") + b"\x89\x88\x87R(K\x03" + text("<") + b"N)}tb.", "structured array"
    ),
    "array without data": (b"\x80\x02cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85C\x01b\x87R.",
                           "without giving its data"),
    "array of absurd size": (array_state(b"\x8a\x05\x00\x00\x00\x00\x10\x85", "f8", b"C\x01x"), "but has 1"),
    "array of negative size": (array_state(b"J\xff\xff\xff\xff\x85", "f8", b"C\x00"), "malformed shape or dtype"),
    "array whose bytes do not fit": (array_state(b"K\x03\x85", "f8", b"C\x01x"), "needs 24 bytes but has 1"),
    "array of a list": (array_state(b"K\x01\x85", "f8", b"]"), "array of Python objects"),
    "sparse of absurd size": (
        sparse(_shape=(2**20, 2**20), data=np.ones(1), indices=I(1), indptr=np.r_[0, np.ones(2**20, int)]), "MiB of arrays"
    ),
    "sparse index outside": (
        sparse(_shape=(2, 1), data=np.ones(1), indices=np.array([5]), indptr=np.array([0, 1])), "index outside its shape"
    ),
    "sparse indptr too long": (
        sparse(_shape=(2, 1), data=np.ones(1), indices=I(1), indptr=np.array([0, 9])), "indptr does not fit"
    ),
    "sparse without data": (sparse(_shape=(2, 1)), "data is not a vector"),
    "sparse without shape": (sparse(data=np.ones(1)), "without a two-dimensional shape"),
    "nesting": (b"(l" * 10_000 + b"a" * 9_999 + b".", "nested more than"),
    "tuple as a key": (b"}" + b")" + b"\x85" * 100_000 + b"Ns.", "a tuple as a key"),
    "a list that holds itself": (b"]q\x00h\x00a.", "contains itself"),
    "a dictionary that holds itself": (b"}q\x00" + text("a") + b"h\x00s.", "contains itself"),
    "text encoded again and again": (
        text("x" * 2**20) + b"q\x010]" + (b"c_codecs\nencode\nh\x01" + text("latin1") + b"\x86Ra") * 200 + b".",
        "MiB of arrays",
    ),
    "endless instructions": (b"NNN" * 1_100_000, "more than 3000000 instructions"),
}  # fmt: skip


@pytest.mark.parametrize("name", MISUSED)
def test_misused_instructions_are_refused(name: str) -> None:
    data, reason = MISUSED[name]
    with pytest.raises(UnsafeFileError) as refusal:
        load_pickle(data, "model.pkl")
    assert str(refusal.value).startswith("model.pkl was not read: it") and reason in str(refusal.value)


def test_shared_references_are_not_multiplied() -> None:
    value = load_pickle(laughs())
    for _ in range(9):
        assert len(value) == 10 and all(item is value[0] for item in value)
        value = value[0]
    assert value.shape == (1000,)


DAMAGED: dict[str, bytes] = {
    "text": b"this is not a pickle at all\n",
    "an unknown instruction": b"\x80\x02\xfe.",
    "stop on an empty stack": b".",
    "two values at the end": b"NN.",
    "a memo slot never filled": b"\x80\x02h\x05.",
    "no mark": b"\x80\x02t.",
    "a length beyond the file": b"\x80\x04\x8e" + struct.pack("<Q", 2**60) + b"x.",
    "a negative length": b"T\xff\xff\xff\xffx.",
    "text without quotes": b"Sabc\n.",
    "text that is not UTF-8": b"X\x02\x00\x00\x00\xff\xfe.",
    "an odd number of items": b"}(Nu.",
    "a number that is none": b"Iabc\n.",
    "digits without end": b"L" + b"9" * 100_000 + b"L\n.",
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_pickles_say_so(name: str) -> None:
    with pytest.raises(UserError, match=r"^model\.pkl is damaged, cut short or not a pickle \("):
        load_pickle(DAMAGED[name], "model.pkl")


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
    "a storage that is not there": (torch_zip(storage("7"), EIGHT_BYTES), "damaged"),
    "a storage of another length": (torch_zip(storage(count=9), EIGHT_BYTES), "needs 36 bytes but has 8"),
    "a tensor beyond its storage": (torch_zip(storage(count=1), {"archive/data/0": b"abcd"}), "outside its storage"),
    "an id that is not a storage": (torch_zip(text("module") + b"Q", {}), "not a torch storage"),
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


def test_missing_file_and_folder(tmp_path: Path) -> None:
    for path, reason in ((tmp_path / "none.pkl", "No such file"), (tmp_path, "Is a directory")):
        with pytest.raises(UserError, match=f"cannot be read: {reason}"):
            load_pickle(path)
    assert list(tmp_path.iterdir()) == []
