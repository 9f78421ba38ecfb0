"""The container of a 3DS file: nested chunks of a two-byte kind and a four-byte length, little-endian."""

from __future__ import annotations

import struct
from collections.abc import Iterator

import numpy as np

from fd_mitsuba.assets.broken import BrokenAsset

_HEAD = struct.Struct("<HI")
CUT_SHORT = "is cut short or damaged; export the model anew"


def chunks(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Kind and content of the chunks that stand one behind the other; bytes at the end that hold none are passed over.

    Raises:
        BrokenAsset: a chunk that is longer than what is there.
    """
    place = 0
    while place + _HEAD.size <= len(data):
        kind, length = _HEAD.unpack_from(data, place)
        if length < _HEAD.size or place + length > len(data):
            raise BrokenAsset(CUT_SHORT)
        yield kind, data[place + _HEAD.size : place + length]
        place += length


def text_of(data: memoryview) -> tuple[str, memoryview]:
    """The zero-ended text that a chunk begins with, and what stands behind it."""
    whole = bytes(data[:4096])
    end = whole.find(b"\0")
    if end < 0:
        raise BrokenAsset(CUT_SHORT)
    return whole[:end].decode("cp1252", errors="replace"), data[end + 1 :]


def rows_of(data: memoryview, kind: str, width: int = 1) -> tuple[np.ndarray, memoryview]:
    """The table (rows, width), float64 or int64, that a chunk begins with behind the two-byte number of its rows, and
    what stands behind it.

    Args:
        kind: of its numbers, such as "<f4".
        width: numbers in a row.
    """
    (count,) = _numbers(data, "<H")
    size = 2 + count * width * np.dtype(kind).itemsize
    if size > len(data):
        raise BrokenAsset(CUT_SHORT)
    table = np.frombuffer(data[2:size], kind).reshape(count, width)
    with np.errstate(invalid="ignore"):  # some NaNs of 32 bits are told of when they get 64
        wide = table.astype(np.float64 if table.dtype.kind == "f" else np.int64)
    return wide, data[size:]


def number_of(data: memoryview, kind: str) -> float:
    """The single number that a chunk holds, such as "<f"."""
    (value,) = _numbers(data, kind)
    return float(value)


def _numbers(data: memoryview, kind: str) -> tuple:
    if struct.calcsize(kind) > len(data):
        raise BrokenAsset(CUT_SHORT)
    return struct.unpack_from(kind, data)
