"""Images of a high dynamic range as a JPEG with a gain map, which browsers decode by themselves.

Two JPEGs, one behind the other: the image up to white, and by how many powers of two it is brighter. A programme that
does not know of the second shows the first. Source: Adobe's gain map specification 1.0, and CIPA DC-007 for the list of
images in one file.
"""

from __future__ import annotations

import io
import struct

import numpy as np
from PIL import Image

from fd_mitsuba.io.srgb import srgb_from_linear

_OFFSET = 1 / 64
"""Keeps black from being divided by."""
_QUALITY = 92
_XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description rdf:about="" xmlns:hdrgm="http://ns.adobe.com/hdr-gain-map/1.0/" hdrgm:Version="1.0"{more}"""
_END = "</rdf:RDF></x:xmpmeta>"
_NUMBERS = """ hdrgm:GainMapMin="0" hdrgm:GainMapMax="{stops:.9g}" hdrgm:Gamma="1" hdrgm:OffsetSDR="{offset}"
hdrgm:OffsetHDR="{offset}" hdrgm:HDRCapacityMin="0" hdrgm:HDRCapacityMax="{stops:.9g}"
hdrgm:BaseRenditionIsHDR="False"/>"""
_PARTS = """ xmlns:Container="http://ns.google.com/photos/1.0/container/"
xmlns:Item="http://ns.google.com/photos/1.0/container/item/"><Container:Directory><rdf:Seq>
<rdf:li rdf:parseType="Resource"><Container:Item Item:Semantic="Primary" Item:Mime="image/jpeg"/></rdf:li>
<rdf:li rdf:parseType="Resource"><Container:Item Item:Semantic="GainMap" Item:Mime="image/jpeg" Item:Length="{size}"/>
</rdf:li></rdf:Seq></Container:Directory></rdf:Description>"""


def gain_map_jpeg(values: np.ndarray) -> bytes:
    """A JPEG of linear values (H, W, 3), finite and not negative; 1 is white.

    What it is decoded to is values = (shown + o) 2^(s g) - o, with `shown` the linear values of the first image, g the
    second in [0, 1], s its number of stops and o = 1/64. Errors are those of 8 bits and of JPEG.
    """
    values = np.asarray(values, dtype=np.float64)
    shown = np.clip(values, 0.0, 1.0)
    gain = np.log2((values + _OFFSET) / (shown + _OFFSET))
    stops = max(float(gain.max()), 1e-3)
    numbers = _NUMBERS.format(stops=stops, offset=_OFFSET)
    second = _with_xmp(_jpeg(gain / stops), _XMP.format(more=numbers) + _END)
    parts = _PARTS.format(size=len(second))
    first = _with_xmp(_jpeg(srgb_from_linear(shown)), _XMP.format(more=parts) + _END)
    at = 4 + struct.unpack_from(">H", first, 4)[0]  # behind the description
    size = len(first) + 4 + 4 + 82
    listed = _list_of_images(size, len(second), at + 8)
    return first[:at] + listed + first[at:] + second


def _jpeg(values: np.ndarray) -> bytes:
    stream = io.BytesIO()
    image = Image.fromarray((np.clip(values, 0, 1) * 255 + 0.5).astype(np.uint8))
    image.save(stream, format="JPEG", quality=_QUALITY, subsampling=0)
    return stream.getvalue()


def _with_xmp(jpeg: bytes, text: str) -> bytes:
    body = b"http://ns.adobe.com/xap/1.0/\0" + text.encode()
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", 2 + len(body)) + body + jpeg[2:]


def _list_of_images(first: int, second: int, at: int) -> bytes:
    """The segment that lists both images.

    Args:
        first, second: their bytes.
        at: where this segment's numbers begin in the file, from which the place of the second image is counted.
    """
    head = b"MM\0*" + struct.pack(">IH", 8, 3)
    entries = struct.pack(">HHI4s", 0xB000, 7, 4, b"0100") + struct.pack(">HHII", 0xB001, 4, 1, 2)
    entries += struct.pack(">HHII", 0xB002, 7, 32, 50) + struct.pack(">I", 0)
    images = struct.pack(">IIIHH", 0x20000000, first, 0, 0, 0) + struct.pack(">IIIHH", 0, second, first - at, 0, 0)
    body = b"MPF\0" + head + entries + images
    return b"\xff\xe2" + struct.pack(">H", 2 + len(body)) + body
