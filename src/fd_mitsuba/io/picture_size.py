"""Width and height of an image file, read from its first bytes without decoding any of it."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import BinaryIO

_HEAD = 1 << 20


def picture_size(path: Path) -> tuple[int, int] | None:
    """Pixels across and down of a PNG, JPEG, EXR, HDR, PFM, PPM, BMP or TGA; None for any other file.

    Of an EXR with several parts, the largest. (0, 0) where the header cannot be understood.

    Raises:
        OSError: the file cannot be read.
    """
    with open(path, "rb") as file:
        return size_in(file)


def size_in(file: BinaryIO) -> tuple[int, int] | None:
    """As `picture_size`, of a file that is open at its start."""
    head = file.read(_HEAD)
    try:
        return _size(head, file)
    except (struct.error, ValueError, IndexError):
        return 0, 0


def _size(head: bytes, file: BinaryIO) -> tuple[int, int] | None:
    if head.startswith(b"\x89PNG\r\n\x1a\n"):
        return struct.unpack(">II", head[16:24])
    if head.startswith(b"\xff\xd8"):
        return _jpeg(file)
    if head.startswith(b"\x76\x2f\x31\x01"):
        return _exr(head)
    if head.startswith(b"#?"):
        found = re.search(rb"\n\s*([+-][XY]) +(\d{1,10}) +([+-][XY]) +(\d{1,10})\s*\n", head)
        if not found:
            return 0, 0
        first, second = int(found.group(2)), int(found.group(4))
        return (second, first) if found.group(1)[1:] == b"Y" else (first, second)
    if head[:2] in (b"PF", b"Pf", b"P6"):
        numbers = re.sub(rb"#[^\n]*", b"", head[2:4096]).split()
        return int(numbers[0].decode("ascii")), int(numbers[1].decode("ascii"))
    if head.startswith(b"BM"):
        width, height = struct.unpack("<ii", head[18:26])
        return abs(width), abs(height)
    file.seek(0, 2)
    if file.tell() < 18:
        return None
    file.seek(-18, 2)
    if file.read(17) == b"TRUEVISION-XFILE.":
        return struct.unpack("<HH", head[12:16])
    return None


def _jpeg(file: BinaryIO) -> tuple[int, int]:
    file.seek(2)
    for _ in range(1000):
        marker = file.read(2)
        while len(marker) == 2 and marker[1] == 0xFF:
            marker = marker[1:] + file.read(1)
        if len(marker) < 2 or marker[0] != 0xFF:
            return 0, 0
        length = struct.unpack(">H", file.read(2))[0]
        if 0xC0 <= marker[1] <= 0xCF and marker[1] not in (0xC4, 0xC8, 0xCC):
            _, height, width = struct.unpack(">BHH", file.read(5))
            return width, height
        file.seek(length - 2, 1)
    return 0, 0


def _exr(head: bytes) -> tuple[int, int]:
    """The largest of the windows of data; a header is a list of named attributes and ends with an empty name."""
    sizes = []
    several = bool(struct.unpack("<I", head[4:8])[0] & 0x1000)
    place = 8
    while place < len(head):
        if head[place] == 0:
            place += 1
            if not several or (place < len(head) and head[place] == 0):
                break
            continue
        name_end = head.index(b"\0", place)
        kind_end = head.index(b"\0", name_end + 1)
        (length,) = struct.unpack("<i", head[kind_end + 1 : kind_end + 5])
        if length < 0:
            break
        value = kind_end + 5
        if head[place:name_end] == b"dataWindow":
            left, top, right, bottom = struct.unpack("<iiii", head[value : value + 16])
            sizes.append((right - left + 1, bottom - top + 1))
        place = value + length
    return max(sizes, key=lambda size: size[0] * size[1], default=(0, 0))
