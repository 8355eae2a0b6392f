"""Pickles that are not data, ask for more than they hold or are damaged: each is refused with its reason."""

from __future__ import annotations

import pickle
import struct
from pathlib import Path

import numpy as np
import pytest
from pickle_parts import array, array_state, buffer, nested_key, sparse, tensor, text

from avatar.errors import UserError
from avatar.files.pickles import UnsafeFileError, load_pickle

FOUR = buffer(np.arange(4, dtype=np.float32).tobytes(), 4)


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
    "encode of a number": (b"c_codecs\nencode\n(I5\n" + text("latin1") + b"tR.", "calls _codecs.encode"),
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
    "state on a class": (b"cchumpy.ch\nCh\n(d" + text("x") + b"I1\nsb.", "sets the state of chumpy.ch.Ch"),
    "state on a function": (b"c_codecs\nencode\n(dS'a'\nI1\nsb.", "sets the state of _codecs.encode"),
    "whole state twice": (
        array_state(b"K\x01\x85", "u1", b"C\x01x")[:-1] + array_state(b"K\x01\x85", "u1", b"C\x01x").partition(b"\x87R")[2],
        "sets the state of a numpy.ndarray",
    ),
    "OBJ of a known class": (b"(cchumpy.ch\nCh\no.", "instruction OBJ"),
    "NEWOBJ_EX of a known class": (b"\x80\x04cchumpy.ch\nCh\n)}\x92.", "instruction NEWOBJ_EX"),
    "state twice": (array_state(b"K\x01\x85", "u1", b"C\x01x")[:-1] + b"(NNNNtb.", "sets the state of a numpy.ndarray"),
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
    "array of too many bytes": (array_state(b"K\x01\x85", "f8", b"C\x09" + b"x" * 9), "needs 8 bytes but has 9"),
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
    "tuple as one of several keys": nested_key(b"}(", b"Nu"),
    "tuple as the key of a new dictionary": nested_key(b"(", b"Nd"),
    "tuple as the key of an ordered dictionary": nested_key(b"ccollections\nOrderedDict\n](", b"N\x86e\x85R"),
    "tuple in a set": nested_key(b"\x8f(", b"\x90"),
    "tuple in a called set": nested_key(b"cbuiltins\nset\n((", b"ltR"),
    "frozen set": (b"\x80\x04()" + b"\x85" * 100_000 + b"\x91.", "instruction FROZENSET"),
    "keys that share a hash": (
        b"}(" + b"".join(b"\x8a\x0b" + (k * (2**61 - 1)).to_bytes(11, "little") + b"N" for k in range(2, 100_000)) + b"u.",
        "an integer of more than 60 bits as a key",
    ),
    "a tuple in a list that holds itself": (b"]q\x00h\x00\x85a.", "contains itself"),
    "many lists that hold themselves": (b"]q\x00(" + b"h\x00" * 1000 + b"e.", "contains itself"),
    "a list that is called": (b"])R.", "calls a list"),
    "an array that is called": (array(np.zeros(3)) + b")R.", "calls a numpy.ndarray"),
    "an object of a list": (b"\x80\x02])\x81.", "makes an object of a list"),
    "an object that is made an object of": (b"\x80\x02cchumpy.ch\nCh\n)\x81)\x81.", "makes an object of a chumpy.ch.Ch"),
    "attributes by slots": (
        b"\x80\x02cchumpy.ch\nCh\n)\x81N}" + text("cls") + text("numpy.dtype") + b"s\x86b.",
        "sets the state of a chumpy.ch.Ch",
    ),
    "attributes of an array": (array(np.zeros(3)) + b"}" + text("value") + b"Nsb.", "sets the state of a numpy.ndarray"),
    "attributes of a torch storage type": (b"ctorch\nFloatStorage\n}b.", "sets the state of torch.FloatStorage"),
    "text as a dtype": (
        b"cnumpy.core.multiarray\nscalar\n" + text("f8") + b"C\x08" + b"\0" * 8 + b"\x86R.", "malformed shape or dtype"
    ),
    "an array as a dtype": (b"cnumpy.core.multiarray\nscalar\n" + array(np.zeros(1)) + b"C\x08" + b"\0" * 8 + b"\x86R.",
                            "malformed shape or dtype"),
    "too many dimensions": (array_state(b"(" + b"K\x01" * 9 + b"t", "u1", b"C\x01x"), "malformed shape or dtype"),
    "text without width": (array_state(b"K\x01\x85", "S", b"C\x00"), "dtype 'S'"),
    "a tensor of rows without elements": (tensor(buffer(b"", 2**30, 0)), "outside its storage"),
    "a tensor of a matrix": (tensor(buffer(bytes(16), 2, 2)), "outside its storage"),
    "a tensor of an array from elsewhere": (tensor(array(np.zeros(4))), "outside its storage"),
    "a tensor before its storage": (tensor(FOUR, offset=b"J\xff\xff\xff\xff"), "outside its storage"),
    "a tensor that steps backwards": (tensor(FOUR, stride=b"J\xff\xff\xff\xff\x85"), "outside its storage"),
    "a tensor that reaches too far": (tensor(FOUR, stride=b"K\x04\x85"), "outside its storage"),
    "a tensor that repeats one element": (
        tensor(FOUR, b"J\0\0\0\x20\x85", b"K\x00\x85"), "MiB of arrays"
    ),
    "a tensor of absurd stride": (
        tensor(FOUR, b"K\x01\x85", b"\x8a\x09" + (2**65).to_bytes(9, "little") + b"\x85"),
        "outside its storage",
    ),
    "sparse indptr that wraps round": (
        sparse(_shape=(1, 2), data=np.ones(1), indices=I(1), indptr=np.array([0, 2**32 - 1, 1], np.uint32)),
        "indptr does not fit",
    ),
    "sparse indptr that wraps round twice": (
        sparse(_shape=(1, 3), data=np.ones(1), indices=I(1), indptr=np.array([0, 2**63 - 1, -2, 1])), "indptr does not fit"
    ),
    **{
        f"sparse indptr that {what}": (
            sparse(_shape=(2, 2), data=np.ones(2), indices=I(2), indptr=np.array(indptr, np.uint32)), "indptr does not fit"
        )
        for what, indptr in (("falls", [0, 2, 1]), ("is short", [0, 2]), ("begins late", [1, 2, 2]), ("is empty", []))
    },
    "sparse index below zero": (
        sparse(_shape=(2, 1), data=np.ones(1), indices=np.array([-1]), indptr=np.array([0, 1])), "index outside its shape"
    ),
    "sparse column below zero": (
        sparse(_shape=(2, 1), data=np.ones(1), row=I(1), col=np.array([-1])).replace(b"csc\ncsc", b"coo\ncoo"),
        "index outside its shape",
    ),
    "sparse rows of decimals": (
        sparse(_shape=(2, 1), data=np.ones(1), indices=np.array([0.5]), indptr=np.array([0, 1])), "indices is not a vector"
    ),
    "sparse of fewer values than indices": (
        sparse(_shape=(2, 1), data=np.ones(1), indices=I(2), indptr=np.array([0, 2])), "1 values for 2 rows"
    ),
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


def test_the_tensor_bait_is_well_formed() -> None:
    read = load_pickle(tensor(FOUR, offset=b"K\x01", stride=b"K\x02\x85"))
    np.testing.assert_array_equal(read, np.array([1, 3], np.float32))


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
    "a tensor of more strides than sides": tensor(FOUR, stride=b"K\x00K\x01\x86"),
    "a mark that is left": b"(N(N.",
    "items for a dictionary": b"}(Ne.",
    "an item for a number": b"K\x01Na.",
    "entries for a list": b"](NNu.",
    "an entry for a set": b"\x80\x04\x8fNNs.",
    "elements for a dictionary": b"\x80\x04}(N\x90.",
    "a protocol of the future": b"\x80\x06N.",
    "a name that is no text": b"\x80\x04K\x01K\x02\x93.",
    "a number that is none": b"Iabc\n.",
    "digits without end": b"L" + b"9" * 100_000 + b"L\n.",
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_pickles_say_so(name: str) -> None:
    with pytest.raises(UserError, match=r"^model\.pkl is damaged, cut short or not a pickle \("):
        load_pickle(DAMAGED[name], "model.pkl")


def test_missing_file_and_folder(tmp_path: Path) -> None:
    for path, reason in ((tmp_path / "none.pkl", "does not exist"), (tmp_path, "is a folder")):
        with pytest.raises(UserError, match=reason):
            load_pickle(path)
    assert list(tmp_path.iterdir()) == []
