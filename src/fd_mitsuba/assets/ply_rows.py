"""The rows of a PLY file as columns of numbers, whatever its elements and formats."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fd_mitsuba.assets.broken import BrokenAsset
from fd_mitsuba.io.regular_file import NotReadable, read_regular
from fd_mitsuba.scene.file_headers import BrokenHeader, check_ply
from fd_mitsuba.scene.ply_header import PlyProperty, read_ply_header

_MOST_BYTES = 1 << 33
_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
_TYPES |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_TYPES |= {"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}
_REMEDY = "save the mesh anew"


@dataclass
class PlyElement:
    """One element of a PLY with all its rows.

    Attributes:
        columns: property -> (N,) numbers in the file's type.
        lists: property -> the counts (N,) of its rows' values, and the values one row after the other.
    """

    columns: dict[str, np.ndarray] = field(default_factory=dict)
    lists: dict[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)


def read_ply_rows(path: Path) -> tuple[dict[str, PlyElement], list[str]]:
    """Element -> its rows, and the comments of the header.

    Raises:
        BrokenAsset: damaged, cut short, of an unknown type.
    """
    try:
        data = read_regular(path, _MOST_BYTES)
        check_ply(path)
    except (NotReadable, BrokenHeader) as error:
        raise BrokenAsset(f"{error}; {_REMEDY}") from None
    header = read_ply_header(path)
    if header is None:
        raise BrokenAsset(f"has a damaged header, or is no PLY; {_REMEDY}")
    lines = data[: header.length].decode("latin-1").splitlines()
    comments = [line.partition(" ")[2].strip() for line in lines if line.startswith("comment")]
    for properties in header.properties.values():
        for item in properties:
            if item.type not in _TYPES or (item.is_list and item.count_type not in _TYPES):
                raise BrokenAsset(f"has values of the unknown type {item.type[:20]!r}; {_REMEDY}")
    body, elements = memoryview(data)[header.length :], {}
    text = bytes(body).splitlines() if header.format == "ascii" else None
    order = ">" if header.format == "binary_big_endian" else "<"
    place = 0
    for name, count in header.counts.items():
        properties = header.properties[name]
        try:
            if text is not None:
                elements[name] = _of_text(text[place : place + count], count, properties)
                place += count
            else:
                elements[name], place = _of_bytes(body, place, count, properties, order)
        except (ValueError, IndexError, OverflowError):
            raise BrokenAsset(f"is cut short, or damaged in its rows of {name[:20]!r}; {_REMEDY}") from None
    return elements, comments


def _of_text(lines: list[bytes], count: int, properties: tuple[PlyProperty, ...]) -> PlyElement:
    if len(lines) < count:
        raise ValueError
    element = PlyElement()
    if not any(item.is_list for item in properties):
        words = [line.split() for line in lines]
        table = np.array([row[: len(properties)] for row in words], dtype=np.bytes_).reshape(count, len(properties))
        for column, item in enumerate(properties):
            element.columns[item.name] = table[:, column].astype(np.float64).astype(_TYPES[item.type])
        return element
    numbers: dict[str, list[float]] = {item.name: [] for item in properties}
    counts: dict[str, list[int]] = {item.name: [] for item in properties if item.is_list}
    for line in lines:
        words, place = line.split(), 0
        for item in properties:
            length = 1
            if item.is_list:
                length = int(words[place])
                place += 1
                counts[item.name].append(length)
            found = words[place : place + length]
            if len(found) < length or length < 0:
                raise ValueError
            numbers[item.name] += map(float, found)
            place += length
    for item in properties:
        values = np.array(numbers[item.name]).astype(_TYPES[item.type])
        if item.is_list:
            element.lists[item.name] = np.array(counts[item.name], dtype=np.int64), values
        else:
            element.columns[item.name] = values
    return element


def _of_bytes(
    body: memoryview, place: int, count: int, properties: tuple[PlyProperty, ...], order: str
) -> tuple[PlyElement, int]:
    """The element's rows, and where the next element begins."""
    element = PlyElement()
    lists = [item for item in properties if item.is_list]
    lengths = _first_lengths(body, place, properties, order) if lists and count else {}
    row = np.dtype(
        [
            entry
            for number, item in enumerate(properties)
            for entry in ([(f"n{number}", order + _TYPES[item.count_type])] if item.is_list else [])
            + [(f"v{number}", order + _TYPES[item.type], (lengths.get(item.name, 1),))]
        ]
    )
    whole = place + count * row.itemsize
    if whole <= len(body):
        table = np.frombuffer(body, row, count, place)
        same = all(
            (table[f"n{number}"] == lengths.get(item.name, 1)).all()
            for number, item in enumerate(properties)
            if item.is_list
        )
        if same:
            for number, item in enumerate(properties):
                values = np.ascontiguousarray(table[f"v{number}"]).ravel()
                values = values.astype(values.dtype.newbyteorder("="))
                if item.is_list:
                    element.lists[item.name] = table[f"n{number}"].astype(np.int64), values
                else:
                    element.columns[item.name] = values
            return element, whole
    if not lists:
        raise ValueError
    return _row_by_row(body, place, count, properties, order)


def _first_lengths(body: memoryview, place: int, properties: tuple[PlyProperty, ...], order: str) -> dict[str, int]:
    """How many values each list has in the first row: most files have as many in all rows."""
    found = {}
    for item in properties:
        length = 1
        if item.is_list:
            kind = np.dtype(order + _TYPES[item.count_type])
            length = int(np.frombuffer(body, kind, 1, place)[0])
            if not 0 <= length <= len(body):
                raise ValueError
            found[item.name] = length
            place += kind.itemsize
        place += length * np.dtype(_TYPES[item.type]).itemsize
    return found


def _row_by_row(
    body: memoryview, place: int, count: int, properties: tuple[PlyProperty, ...], order: str
) -> tuple[PlyElement, int]:
    pieces: dict[str, list[bytes]] = {item.name: [] for item in properties}
    counts: dict[str, list[int]] = {item.name: [] for item in properties if item.is_list}
    endian = "big" if order == ">" else "little"
    kinds = [
        (item.name, item.is_list, np.dtype(_TYPES[item.count_type]).itemsize if item.is_list else 0,
         np.dtype(_TYPES[item.type]).itemsize)
        for item in properties
    ]  # fmt: skip
    for _ in range(count):
        for name, is_list, head, size in kinds:
            length = 1
            if is_list:
                length = int.from_bytes(body[place : place + head], endian)
                place += head
                counts[name].append(length)
            end = place + length * size
            if end > len(body):
                raise ValueError
            pieces[name].append(bytes(body[place:end]))
            place = end
    element = PlyElement()
    for item in properties:
        values = np.frombuffer(b"".join(pieces[item.name]), order + _TYPES[item.type])
        values = values.astype(values.dtype.newbyteorder("="))
        if item.is_list:
            element.lists[item.name] = np.array(counts[item.name], dtype=np.int64), values
        else:
            element.columns[item.name] = values
    return element, place
