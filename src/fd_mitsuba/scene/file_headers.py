"""What the headers of meshes, volumes and measured materials announce, held against the size of the file."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from math import prod
from pathlib import Path

import numpy as np

_HEAD = 1 << 16
_SCALARS = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16", "float16"), 2),
    **dict.fromkeys(("int", "uint", "int32", "uint32", "float", "float32"), 4),
    **dict.fromkeys(("double", "float64", "int64", "uint64"), 8),
}
_TENSOR_BYTES = (0, 1, 1, 2, 2, 4, 4, 8, 8, 2, 4, 8)
"""By Mitsuba's number of the type, from 1: int8, uint8, ..., uint64, float16, float32, float64."""


class BrokenHeader(Exception):
    """The header announces what the file does not hold; the text says what."""


def check_ply(path: Path, _: int = 0) -> None:
    """Raise BrokenHeader if the rows that the header announces do not fit the file, or Mitsuba's counters.

    Whatever else is wrong with the header, Mitsuba says.
    """
    size = path.stat().st_size
    with open(path, "rb") as file:
        head = file.read(_HEAD)
    if not head.startswith(b"ply"):
        return
    lines = head.partition(b"end_header")[0].decode("latin-1").splitlines()
    ascii_rows = any(line.split()[:2] == ["format", "ascii"] for line in lines)
    needed, count, name = 0, 0, ""
    for line in lines:
        words = line.split()
        if len(words) == 3 and words[0] == "element":
            name = words[1]
            if not words[2].isascii() or not words[2].isdigit() or len(words[2]) > 10:
                raise BrokenHeader(f"its header announces {words[2][:30]!r} of {name!r}")
            count = int(words[2])
            if count >= 1 << 32 or count > size:
                raise BrokenHeader(f"its header announces {count} of {name!r}, and the file has {size} bytes")
        elif len(words) >= 3 and words[0] == "property":
            # In a list, at least the count is there; in text, a digit and a blank.
            needed += count * (2 if ascii_rows else _SCALARS.get(words[2] if words[1] == "list" else words[1], 1))
        if needed > size:
            raise BrokenHeader(f"its header announces {count} of {name!r}, and the file has {size} bytes")


def check_serialized(path: Path, index: int = 0) -> None:
    """Raise BrokenHeader if the counts of the mesh number `index` cannot come out of a file of that size."""
    size = path.stat().st_size
    with open(path, "rb") as file:
        try:
            _, version = struct.unpack("<HH", file.read(4))
            start = 0
            if index:
                file.seek(-4, 2)
                (count,) = struct.unpack("<I", file.read(4))
                width = 8 if version == 4 else 4
                if not 0 <= index < count or size < width * count + 4:
                    raise BrokenHeader(f"holds {count} meshes, and shape_index is {index}")
                file.seek(size - width * (count - index) - 4)
                start = int.from_bytes(file.read(width), "little")
            if start > size - 4:
                raise BrokenHeader("its table of meshes points behind the end of the file")
            file.seek(start + 4)
            data = zlib.decompressobj().decompress(file.read(_HEAD), _HEAD)
        except (struct.error, OSError, zlib.error):
            return  # Mitsuba says what it is not
    name_end = data.find(b"\0", 4) + 1 if version == 4 else 4
    if len(data) < name_end + 16 or name_end == 0:
        raise BrokenHeader("its header is cut short")
    vertices, faces = struct.unpack("<QQ", data[name_end : name_end + 16])
    # zlib makes at most 1032 bytes of one.
    if max(vertices, faces) * 12 > 1032 * size or max(vertices, faces) >= 1 << 32:
        raise BrokenHeader(f"its header announces {vertices} vertices and {faces} faces, and the file has {size} bytes")


def check_volume(path: Path, _: int = 0) -> None:
    """Raise BrokenHeader if a grid's cells do not fit the file, or a value is not finite."""
    size = path.stat().st_size
    with open(path, "rb") as file:
        head = file.read(48)
    if len(head) < 48 or head[:3] != b"VOL":
        return
    x, y, z, channels = struct.unpack("<iiii", head[8:24])
    if min(x, y, z, channels) < 1 or prod((x, y, z, channels)) * 4 + 48 > size:
        raise BrokenHeader(
            f"its header announces {x} x {y} x {z} cells of {channels} channels, and it has {size} bytes"
        )
    values = np.memmap(path, np.dtype("<f4"), "r", 48, (prod((x, y, z, channels)),))
    broken = sum(int(np.sum(~np.isfinite(part))) for part in np.array_split(values, 1 + len(values) // (1 << 22)))
    if broken:
        raise BrokenHeader(f"{broken} of {len(values)} values are NaN or infinite")


def check_tensors(path: Path, _: int = 0) -> None:
    """Raise BrokenHeader if an array that a tensor file lists does not lie within it."""
    data = path.read_bytes()
    if not data.startswith(b"tensor_file\0") or len(data) < 18:
        return
    place = 18
    try:
        for _field in range(struct.unpack("<I", data[14:18])[0]):
            (length,) = struct.unpack_from("<H", data, place)
            name = data[place + 2 : place + 2 + length].decode("latin-1")
            place += 2 + length
            dimensions, kind, offset = struct.unpack_from("<HBQ", data, place)
            place += 11
            shape = struct.unpack_from(f"<{dimensions}Q", data, place)
            place += 8 * dimensions
            if not 1 <= kind < len(_TENSOR_BYTES) or offset + prod(shape) * _TENSOR_BYTES[kind] > len(data):
                raise BrokenHeader(f"its array {name[:30]!r} does not lie within the file")
    except struct.error:
        raise BrokenHeader("its header is cut short") from None


HEADERS: dict[str, Callable[[Path, int], None]] = {
    "ply": check_ply,
    "ellipsoids": check_ply,
    "ellipsoidsmesh": check_ply,
    "serialized": check_serialized,
    "gridvolume": check_volume,
    "sdfgrid": check_volume,
    "measured": check_tensors,
    "measured_polarized": check_tensors,
}
"""Plugin -> the check of the files that it reads; the second argument is its `shape_index`."""
