"""Pickles that want to run something: each would leave a marker file behind, and none may."""

from __future__ import annotations

import copyreg
import io
import pickle
import re
import struct
import sys
import types
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pickle_parts import stack_global, text

from avatar.files import data_unpickler
from avatar.files.data_unpickler import DataUnpickler
from avatar.files.pickled_data import Budget
from avatar.files.pickles import UnsafeFileError, load_pickle, load_torch_pickle

EXTENSION_CODE = 240


def touch(marker: Path) -> str:
    return f"open({str(marker)!r}, 'w').close()"


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
    "extension registry, 16 bits": (lambda m: b"\x80\x02\x83" + struct.pack("<H", EXTENSION_CODE) + b"(" + text(touch(m))
                                    + b"tR.", "instruction EXT2"),
    "extension registry, 32 bits": (lambda m: b"\x80\x02\x84" + struct.pack("<i", EXTENSION_CODE) + b"(" + text(touch(m))
                                    + b"tR.", "instruction EXT4"),
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
    "a class by its attribute": (
        lambda m: stack_global("builtins", "object.__subclasses__") + b")R0cbuiltins\nopen\n(" + text(str(m)) + text("w")
        + b"tR.",
        "builtins.object.__subclasses__",
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
    assert str(refusal.value).isprintable()

    # The bait is real: Python's own reader runs it.
    try:
        pickle.loads(data)
    except Exception as error:
        print(error)
    assert marker.exists() or marker.with_suffix(".npy").exists()


def test_an_extension_that_python_has_looked_up_before_is_not_handed_out(marker: Path) -> None:
    data = b"\x80\x02\x82" + bytes([EXTENSION_CODE]) + b"(" + text(touch(marker)) + b"tR."
    assert pickle.loads(data[:4] + b".") is eval  # from now on Python's readers ask nobody for this code
    with pytest.raises(UnsafeFileError, match="instruction EXT1"):
        load_pickle(data)
    assert not marker.exists()


def test_any_name_of_chumpy_is_known_and_none_is_called(marker: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chumpy = types.ModuleType("chumpy")
    chumpy.__dict__["io"] = io
    monkeypatch.setitem(sys.modules, "chumpy", chumpy)
    data = stack_global("chumpy", "io.FileIO") + text(str(marker)) + text("w") + b"\x86R."
    with pytest.raises(UnsafeFileError, match=r"it calls chumpy\.io\.FileIO in a way that data does not need"):
        load_pickle(data)
    assert not marker.exists()
    pickle.loads(data).close()
    assert marker.exists()


def test_names_on_the_stack_cannot_be_called() -> None:
    known = [*data_unpickler._NAMES.split(), *data_unpickler._STORAGES, "chumpy.ch.Ch", "scipy.sparse.csc.csc_matrix"]
    assert len(known) > 20
    for name in known:
        machine = DataUnpickler(io.BytesIO(), Budget(0), None)
        stand_in = machine.find_class(*name.rsplit(".", 1))
        assert not callable(stand_in) and not isinstance(stand_in, type)
        with pytest.raises(UnsafeFileError, match=f"a reference to {re.escape(name)} where data is expected"):
            load_pickle(stack_global(*name.rsplit(".", 1)) + b".")
