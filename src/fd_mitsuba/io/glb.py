"""Whether a GLB is whole, before anything is made of it."""

from __future__ import annotations

import json
import struct

_JSON = 0x4E4F534A


def glb_content(data: bytes) -> dict | None:
    """The JSON part of a binary glTF 2; None where the file is cut short or is none at all."""
    try:
        magic, version, length = struct.unpack_from("<4sII", data)
        place, chunks = 12, []
        while place < len(data):
            size, kind = struct.unpack_from("<II", data, place)
            chunks.append((kind, data[place + 8 : place + 8 + size]))
            place += 8 + size
        content = json.loads(chunks[0][1])
        held = len(chunks[1][1]) if len(chunks) > 1 else 0
        wanted = [buffer["byteLength"] for buffer in content.get("buffers", []) if "uri" not in buffer]
        fits = all(isinstance(size, int) and size <= held for size in wanted)
    except (struct.error, ValueError, RecursionError, IndexError, TypeError, KeyError, AttributeError):
        return None
    sound = (magic, version, chunks[0][0]) == (b"glTF", 2, _JSON) and length == len(data) == place
    return content if sound and fits else None
