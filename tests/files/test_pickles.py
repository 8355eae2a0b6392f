"""Pickles that hold data are read right: numpy, torch, official-FLAME-like, of every protocol and age."""

from __future__ import annotations

import io
import pickle
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse
import torch

from avatar.errors import UserError
from avatar.files import pickles
from avatar.files.pickles import load_npz, load_pickle, load_torch_pickle


def assert_same(read: object, written: object) -> None:
    if isinstance(written, dict):
        assert isinstance(read, dict) and list(read) == list(written)
        for key in written:
            assert_same(read[key], written[key])
    elif isinstance(written, np.ndarray):
        assert isinstance(read, np.ndarray)
        assert read.dtype == written.dtype.newbyteorder("=") and read.shape == written.shape
        np.testing.assert_array_equal(read, written)
    else:
        assert type(read) is type(written) and read == written


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_plain_data_round_trips(protocol: int) -> None:
    data = {
        "float64": np.arange(6.0).reshape(2, 3),
        "fortran": np.asfortranarray(np.arange(6, dtype=np.int32).reshape(2, 3)),
        "permuted": np.arange(24.0).reshape(2, 3, 4).transpose(1, 0, 2),
        "strided": np.arange(24.0).reshape(4, 6)[::2, ::3],
        "big endian": np.arange(5, dtype=">f4"),
        "bool": np.array([True, False]),
        "empty": np.zeros((0, 3), np.float32),
        "scalar array": np.array(2.5),
        "text": np.array(["a", "bc"]),
        "numpy scalar": np.float32(3.25),
        "nested": [1, (2, None, True), 1.5, {"deep": b"bytes\xff"}, "ü\n", 10**30, -5],
        "set": {1, 2, 3},
    }
    assert_same(load_pickle(pickle.dumps(data, protocol)), data)


def test_arrays_are_writable_copies() -> None:
    array = load_pickle(pickle.dumps(np.zeros(3)))
    array[0] = 1.0
    assert array.tolist() == [1.0, 0.0, 0.0]


def test_shared_references_stay_shared() -> None:
    part = np.arange(3)
    first, second = load_pickle(pickle.dumps([part, part]))
    assert first is second


def python2_array(array: np.ndarray) -> bytes:
    """What Python 2's pickle.dumps(array, 0) writes: text opcodes, bytes as an escaped literal."""
    raw = repr(array.tobytes())[1:].encode()
    shape = b"".join(b"I%d\n" % n for n in array.shape)
    return (
        b"cnumpy.core.multiarray\n_reconstruct\np1\n(cnumpy\nndarray\np2\n(I0\ntp3\nS'b'\np4\ntp5\nRp6\n"
        b"(I1\n(" + shape + b"tp7\ncnumpy\ndtype\np8\n(S'" + array.dtype.str[1:].encode() + b"'\np9\nI0\nI1\ntp10\n"
        b"Rp11\n(I3\nS'<'\np12\nNNNI-1\nI-1\nI0\ntp13\nbI00\nS" + raw + b"\np14\ntp15\nb"
    )


def test_python_2_text_pickle() -> None:
    array = np.random.default_rng(0).standard_normal((3, 2))
    data = b"(dp0\nS'v_template'\np20\n" + python2_array(array) + b"sS'name'\nS'caf\\xe9'\nsS'flag'\nI01\ns."
    read = load_pickle(data)
    np.testing.assert_array_equal(read["v_template"], array)
    assert read["name"] == "café" and read["flag"] is True


@pytest.fixture
def old_modules(monkeypatch: pytest.MonkeyPatch) -> dict[str, type]:
    """Classes of the module names in official FLAME pickles: chumpy.ch.Ch, and scipy.sparse before 1.8."""
    classes: dict[str, type] = {}
    for module_name, name in (
        ("chumpy.ch", "Ch"),
        ("chumpy.reordering", "Select"),
        ("scipy.sparse.csc", "csc_matrix"),
        ("scipy.sparse.csr", "csr_matrix"),
    ):
        module = types.ModuleType(module_name)
        cls = type(name, (), {"__module__": module_name})
        setattr(module, name, cls)
        monkeypatch.setitem(sys.modules, module_name.split(".")[0], sys.modules.get(module_name.split(".")[0], module))
        monkeypatch.setitem(sys.modules, module_name, module)
        classes[name] = cls
    return classes


def instance(cls: type, **state: object) -> object:
    made = cls()
    made.__dict__.update(state)
    return made


@pytest.mark.parametrize("protocol", [0, 1, 2, 4])
def test_official_flame_pickle(old_modules: dict[str, type], protocol: int) -> None:
    rng = np.random.default_rng(0)
    shapedirs, template = rng.standard_normal((7, 3, 4)), rng.standard_normal((7, 3))
    regressor = scipy.sparse.csc_matrix(np.where(rng.random((5, 7)) < 0.4, rng.random((5, 7)), 0.0))
    state = {"_shape": (5, 7), "maxprint": 50, "indices": regressor.indices, "indptr": regressor.indptr}
    model = {
        "shapedirs": instance(
            old_modules["Ch"], x=shapedirs, _dirty_vars={"x"}, _itr=None, _depends_on_deps={}, _status="new"
        ),
        "J_regressor": instance(old_modules["csc_matrix"], data=regressor.data, **state),
        "v_template": template,
        "bs_style": "lbs",
        "kintree_table": np.array([[2**32 - 1, 0, 1, 1, 1], [0, 1, 2, 3, 4]], np.uint32),
    }
    read = load_pickle(pickle.dumps(model, protocol))
    np.testing.assert_array_equal(read["shapedirs"], shapedirs)
    np.testing.assert_array_equal(read["J_regressor"], regressor.toarray())
    np.testing.assert_array_equal(read["v_template"], template)
    assert read["bs_style"] == "lbs" and read["kintree_table"][0, 0] == 2**32 - 1


def test_chumpy_formula_without_a_value_is_refused(old_modules: dict[str, type]) -> None:
    formula = instance(old_modules["Select"], a=np.arange(3), idxs=np.array([1]))
    with pytest.raises(UserError, match=r"chumpy\.reordering\.Select whose value is not stored; save the model as"):
        load_pickle(pickle.dumps({"posedirs": formula}, 2))


def test_a_formula_is_not_taken_for_its_argument(old_modules: dict[str, type]) -> None:
    with pytest.raises(UserError, match=r"chumpy\.reordering\.Select whose value is not stored"):
        load_pickle(pickle.dumps(instance(old_modules["Select"], x=np.arange(3)), 2))


@pytest.mark.parametrize("kind", ["csc_matrix", "csr_matrix", "coo_matrix", "csc_array", "csr_array", "coo_array"])
def test_scipy_sparse_becomes_dense(kind: str) -> None:
    matrix = getattr(scipy.sparse, kind)(np.arange(54.0).reshape(6, 9) * (np.arange(54).reshape(6, 9) % 3 == 0))
    np.testing.assert_array_equal(load_pickle(pickle.dumps(matrix, 2)), matrix.toarray())


def test_sparse_duplicates_add_up() -> None:
    matrix = scipy.sparse.coo_matrix(([1.0, 2.0], ([0, 0], [1, 1])), shape=(2, 2))
    np.testing.assert_array_equal(load_pickle(pickle.dumps(matrix)), [[0, 3], [0, 0]])


def test_sparse_arrays_may_be_longer_than_what_is_used_of_them() -> None:
    matrix = scipy.sparse.csc_matrix(np.array([[0.0, 5.0], [7.0, 0.0]]))
    matrix.indices, matrix.data = np.append(matrix.indices, 9), np.append(matrix.data, 9.0)
    np.testing.assert_array_equal(load_pickle(pickle.dumps(matrix)), [[0, 5], [7, 0]])


def test_torch_save_of_arrays_and_tensors(tmp_path: Path) -> None:
    base = torch.arange(12.0).reshape(3, 4)
    content = {
        "array": np.arange(3),
        "transposed": base.T,
        "row": base[1],
        "int": torch.tensor([[1], [2]]),
        "half": torch.ones(2, dtype=torch.float16),
        "bool": torch.tensor([True]),
        "none": torch.zeros(0, 3),
    }
    torch.save(content, tmp_path / "a.frame")
    read = load_torch_pickle(tmp_path / "a.frame")
    for name, value in content.items():
        expected = value if isinstance(value, np.ndarray) else value.numpy()
        assert_same(read[name], np.ascontiguousarray(expected))


def test_legacy_torch_save_of_arrays(tmp_path: Path) -> None:
    torch.save({"exp": np.arange(4.0)}, tmp_path / "a.frame", _use_new_zipfile_serialization=False)
    assert_same(load_torch_pickle(tmp_path / "a.frame"), {"exp": np.arange(4.0)})


def test_npz_round_trip_and_pickled_objects_inside(tmp_path: Path) -> None:
    np.savez(tmp_path / "good.npz", a=np.arange(3), b=np.eye(2))
    assert_same(load_npz(tmp_path / "good.npz"), {"a": np.arange(3), "b": np.eye(2)})
    np.savez(tmp_path / "bad.npz", a=np.array([{"x": 1}], dtype=object))
    with pytest.raises(UserError, match=r"bad\.npz holds pickled Python objects; save it again"):
        load_npz(tmp_path / "bad.npz")


@pytest.mark.shared
def test_agrees_with_pickle_on_the_development_model(shared_dir: Path) -> None:
    path = shared_dir / "subjects" / "head_model" / "generic_model.pkl"
    with path.open("rb") as file:
        assert_same(load_pickle(path), pickle.load(file))


@pytest.mark.shared
def test_agrees_with_torch_on_development_frames(shared_dir: Path, tmp_path: Path) -> None:
    frames = sorted((shared_dir / "subjects" / "carla" / "checkpoint").glob("*.frame"))
    assert len(frames) > 100
    for path in frames[::100]:
        written = torch.load(path, weights_only=False)
        torch.save(written, tmp_path / "legacy.frame", _use_new_zipfile_serialization=False)
        assert_same(load_torch_pickle(path), written)
        assert_same(load_torch_pickle(tmp_path / "legacy.frame"), written)


def test_what_a_file_calls_things_cannot_steer_the_terminal() -> None:
    with pytest.raises(UserError) as refusal:
        load_pickle(b"\x80\x04X\x06\0\0\0os\x1b[2JX\x04\0\0\0a\nb\r\x93.", "model.pkl")
    assert str(refusal.value).isprintable() and "refers to os\N{REPLACEMENT CHARACTER}[2J.a" in str(refusal.value)


def test_a_reason_does_not_quote_pages() -> None:
    with pytest.raises(UserError) as refusal:
        load_pickle(b"c" + b"long" * 10_000 + b"\nname\n.", "model.pkl")
    assert len(str(refusal.value)) < 500 and "longlong" in str(refusal.value)


def test_files_that_are_too_large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    np.savez_compressed(tmp_path / "zeros.npz", zeros=np.zeros(10_000))
    (tmp_path / "model.pkl").write_bytes(pickle.dumps(np.zeros(200)))
    monkeypatch.setattr(pickles, "MAX_FILE_BYTES", 1000)
    with pytest.raises(UserError, match=r"zeros\.npz would unpack to more than 1000 bytes"):
        load_npz(tmp_path / "zeros.npz")
    with pytest.raises(UserError, match=r"model\.pkl has 1\.8 KB; files of its kind are read up to 1\.0 KB"):
        load_pickle(tmp_path / "model.pkl")


def test_a_large_file_may_ask_for_much(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pickles, "MIN_BUDGET_BYTES", 1000)
    assert len(load_pickle(pickle.dumps(np.zeros(10_000)))) == 10_000


def _valid() -> bytes:
    return pickle.dumps({"a": np.arange(40.0), "b": [1, "x", (2.5, None)], "c": {b"k": np.int16(3)}}, 2)


def test_every_truncation_is_a_sentence() -> None:
    data = _valid()
    for length in range(1, len(data)):
        with pytest.raises(UserError, match=r"^cut\.pkl (is damaged, cut short or not a pickle|was not read)"):
            load_pickle(data[:length], "cut.pkl")


def test_every_truncation_of_a_torch_file_is_a_sentence() -> None:
    buffer = io.BytesIO()
    torch.save({"a": np.arange(40.0), "b": torch.ones(3)}, buffer)
    data = buffer.getvalue()
    for length in [0, 1, 2, 3, 30, *range(60, len(data), 37), len(data) - 1]:
        with pytest.raises(UserError, match=r"^the data (is|was)"):
            load_torch_pickle(data[:length])


@pytest.mark.filterwarnings("ignore:invalid escape sequence:DeprecationWarning")
def test_flipped_bytes_never_escape_as_other_errors() -> None:
    rng = np.random.default_rng(0)
    data = np.frombuffer(_valid(), np.uint8)
    refused = 0
    for _ in range(3000):
        damaged = data.copy()
        damaged[rng.integers(0, len(data), rng.integers(1, 4))] = rng.integers(0, 256)
        try:
            load_pickle(damaged.tobytes(), "flipped.pkl")
        except UserError as error:
            assert str(error).startswith("flipped.pkl ")
            refused += 1
    assert refused > 1000  # the rest hit numbers inside the arrays


@pytest.mark.parametrize(
    "codes", [[0x7FFFFFFF], [65, 0x110000], [0xD800]], ids=["huge", "beyond the last", "surrogate"]
)
@pytest.mark.parametrize("order", "<>")
def test_text_that_is_not_unicode_is_refused(codes: list[int], order: str, tmp_path: Path) -> None:
    """numpy makes no str of it, and says so in an error of its own, where it is used."""
    text = np.array(codes, f"{order}u4").view(f"{order}U{len(codes)}")
    np.savez(tmp_path / "text.npz", names=text)
    with pytest.raises(UserError, match="text that is not Unicode"):
        load_npz(tmp_path / "text.npz")
    with pytest.raises(UserError, match="text that is not Unicode"):
        load_pickle(pickle.dumps(text))


def test_text_comes_back(tmp_path: Path) -> None:
    names = np.array(["Zoë", "", "\N{GRINNING FACE}"])
    for array in (names, names.astype(">U3"), np.array("one"), np.array([""])):
        np.savez(tmp_path / "text.npz", names=array)
        assert load_npz(tmp_path / "text.npz")["names"].tolist() == array.tolist()
        assert load_pickle(pickle.dumps(array)).tolist() == array.tolist()
