"""Spectrum files, read here and not by Mitsuba, which would wait for ever at a pipe and take a NaN for a number."""

from __future__ import annotations

import math
import re
from pathlib import Path

from fd_mitsuba.io.regular_file import NotReadable, read_regular
from fd_mitsuba.scene.xml_element import XmlElement

MAX_BYTES = 1 << 20

_NUMBER = re.compile(
    r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?|[+-]?(?:nan|inf(?:inity)?))(?![\w.])", re.IGNORECASE | re.ASCII
)


def spectrum_value(element: XmlElement, path: Path) -> str:
    """What `<spectrum filename>` says, as its `value`: "400:0.1, 410:0.2, ...".

    A line holds a wavelength in nanometres and a value; lines that start with # are comments.

    Raises:
        UserError: not a regular file, larger than `MAX_BYTES`, not such lines, fewer than two, wavelengths that do not
            increase, a number that is not finite.
    """
    name = element.attributes["filename"]
    try:
        data = read_regular(path, MAX_BYTES)
    except NotReadable as error:
        raise element.error(f"file {name!r} {error}; correct the file name") from None
    pairs: list[tuple[float, float]] = []
    for number, line in enumerate(data.decode("latin-1").split("\n"), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        first = _NUMBER.match(line)
        second = first and _NUMBER.match(line, first.end())
        if not first or not second:
            raise element.error(f"{name}, line {number}: not a wavelength and a value; correct the file")
        pair = float(first.group(1)), float(second.group(1))
        if not all(map(math.isfinite, pair)):
            raise element.error(f"{name}, line {number}: a number is not finite; correct the file")
        if pairs and pair[0] <= pairs[-1][0]:
            raise element.error(f"{name}, line {number}: the wavelengths do not increase; sort the lines")
        pairs.append(pair)
    if len(pairs) < 2:
        raise element.error(f"{name} holds {len(pairs)} values; give at least two wavelengths")
    return ", ".join(f"{wavelength!r}:{value!r}" for wavelength, value in pairs)
