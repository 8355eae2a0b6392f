"""Mutations of valid files: what a bad disk, a cut download, a text editor and a person who means harm make of them."""

from __future__ import annotations

import random
import re
from collections.abc import Sequence

NUMBERS = (
    b"0",
    b"-1",
    b"1e999",
    b"-1e999",
    b"NaN",
    b"Infinity",
    b"1e-320",
    b"18446744073709551616",
    b"9" * 400,
    b"0x10",
)
TOKENS = (b"null", b"true", b"[]", b"{}", b'""', b'"../../x"', b'"/etc/passwd"', b'"\\u0000"', b'"\\ud800"')
TOKENS += (b"[" * 300, b"%s", b"\xff\xfe")
INTEGERS = (0, 1, 127, 255, 256, 65_535, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**64 - 1)
_HEADER = 512  # bytes at either end, where formats keep their structure


def mutate(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """One to four mutations of `data`; `others` are files to splice with. The same rng state gives the same bytes."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        data = rng.choice(_MUTATIONS)(rng, data, others)
    return data


def _place(rng: random.Random, data: bytes) -> int:
    if len(data) > 2 * _HEADER and rng.random() < 0.7:
        return rng.choice((rng.randrange(_HEADER), len(data) - 1 - rng.randrange(_HEADER)))
    return rng.randrange(len(data) or 1)


def _flip(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    raw = bytearray(data or b"\0")
    for _ in range(rng.choice((1, 1, 8, 64))):
        raw[_place(rng, raw)] ^= 1 << rng.randrange(8)
    return bytes(raw)


def _cut(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    return data[: _place(rng, data)]


def _remove(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    at = _place(rng, data)
    return data[:at] + data[at + rng.choice((1, 2, 8, 100)) :]


def _splice(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    other = rng.choice(others)
    start = _place(rng, other)
    piece = other[start : start + rng.choice((1, 4, 16, 200, 5000))]
    at = _place(rng, data)
    return data[:at] + piece + data[at + rng.choice((0, len(piece))) :]


def _repeat(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    at = _place(rng, data)
    piece = data[at : at + rng.choice((1, 8, 64))]
    return data[:at] + piece * rng.choice((2, 50, 2000)) + data[at:]


def _length(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """An absurd number where a length, a count or a dimension may stand."""
    width = rng.choice((1, 2, 4, 8))
    value = (rng.choice(INTEGERS) % 256**width).to_bytes(width, rng.choice(("little", "big")))
    at = _place(rng, data)
    return data[:at] + value + data[at + width :]


def _token(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Another value for one of a text's numbers or words."""
    places = list(re.finditer(rb"-?[0-9][0-9.e+-]*|\"[^\"]*\"|[a-z_]+", data[:50_000]))
    if not places:
        return _flip(rng, data, others)
    found = rng.choice(places)
    return data[: found.start()] + rng.choice(NUMBERS + TOKENS) + data[found.end() :]


_MUTATIONS = (_flip, _cut, _remove, _splice, _repeat, _length, _token, _token)
