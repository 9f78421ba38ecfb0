"""The header of a PLY file: what its elements hold, without reading them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

_LONGEST = 1 << 16


@dataclass(frozen=True)
class PlyProperty:
    """One property of an element.

    Attributes:
        name: as in the file.
        type: of its values, as in the file, such as "uchar" or "float32".
        count_type: of the count before its values where it is a list, else "".
    """

    name: str
    type: str
    count_type: str = ""

    @property
    def is_list(self) -> bool:
        """Whether each element has several, with their count before them."""
        return bool(self.count_type)


@dataclass(frozen=True)
class PlyHeader:
    """What comes before the data.

    Attributes:
        format: "ascii", "binary_little_endian" or "binary_big_endian".
        counts: element -> how many, in file order.
        properties: element -> its properties, in file order.
        length: bytes of the header, "end_header" and its line break included.
    """

    format: str
    counts: dict[str, int]
    properties: dict[str, tuple[PlyProperty, ...]]
    length: int


def read_ply_header(path: Path) -> PlyHeader | None:
    """The header of a PLY file; None for anything else, a damaged header too."""
    try:
        with open(path, "rb") as file:
            head = file.read(_LONGEST)
    except OSError:
        return None
    end = head.find(b"end_header")
    line_end = head.find(b"\n", end)
    if not head.startswith(b"ply") or end < 0 or line_end < 0:
        return None
    form, counts, properties, element = "", {}, {}, ""
    for line in head[:end].decode("latin-1").splitlines():
        words = line.split()
        try:
            if words[:1] == ["format"]:
                form = words[1]
            elif words[:1] == ["element"]:
                element = words[1]
                counts[element], properties[element] = int(words[2]), []
            elif words[:2] == ["property", "list"]:
                properties[element].append(PlyProperty(words[4], words[3], words[2]))
            elif words[:1] == ["property"]:
                properties[element].append(PlyProperty(words[2], words[1]))
        except (IndexError, KeyError, ValueError):
            return None
    return PlyHeader(form, counts, {name: tuple(found) for name, found in properties.items()}, line_end + 1)
