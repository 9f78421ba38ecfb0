"""Text from outside, made fit for where it goes: a file's name, a link. For a terminal there is `errors.printable`."""

from __future__ import annotations

import itertools
import os
import re
import unicodedata
from collections.abc import Collection
from pathlib import PurePath
from urllib.parse import quote

_LONGEST = 100
_RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)


def is_text(name: str) -> bool:
    """Whether a name from the system is text in UTF-8: Python marks bytes that are not with surrogates.

    >>> is_text("schneemann/hut.ply"), is_text("h\\udcfct.ply")
    (True, False)
    """
    return not any("\ud800" <= letter <= "\udfff" for letter in name)


def safe_name(text: str, taken: Collection[str] = (), suffix: str = "") -> str:
    """A name of letters, digits, `_`, `.` and `-` for a file, a group or a material, close to `text`.

    It has no folder in it, does not start with a dot or a dash, is of at most 100 characters, and none of those that
    Windows keeps for itself.

    Args:
        text: such as the id of a shape.
        taken: names that it must differ from, also where A and a are the same.
        suffix: ends the name and is not counted on when it must differ, such as ".png"; made safe, too.

    Example:
        `safe_name("Foot/left 1", {"foot_left_1"})` is "Foot_left_1_2".
    """
    ending = re.sub(r"[^\w.]", "_", unicodedata.normalize("NFC", suffix))
    name = re.sub(r"[^\w.-]", "_", unicodedata.normalize("NFC", text))[:_LONGEST]
    name = re.sub(r"^[.-]+", "_", name) or "_"
    while len(os.fsencode(name)) > 200:
        name = name[:-1]
    if _RESERVED.fullmatch(name):
        name = f"_{name}"
    low = {_folded(other) for other in taken}
    names = itertools.chain([name], (f"{name}_{number}" for number in itertools.count(2)))
    return next(f"{one}{ending}" for one in names if _folded(f"{one}{ending}") not in low)


def safe_file_name(name: str, taken: Collection[str] = ()) -> str:
    """`safe_name` of a whole file name: it keeps its suffix, and a number that makes it differ goes before that."""
    path = PurePath(name.replace("/", "_"))
    return safe_name(path.stem, taken, path.suffix)


def harmless_file_name(name: str) -> str:
    """The last part of a path from outside, as it is where it does no harm as the name of a file, and else made safe.

    Other files may refer to it: blanks and letters of all scripts stay, which `safe_file_name` would replace.

    Example:
        "C:/models/oak wood.png" is "oak wood.png", and ".profile" is "_profile".
    """
    last = re.split(r"[/\\]", name)[-1]
    odd = not last.isprintable() or set(last) & set('<>:"|?*') or last[:1] in (".", "-", " ") or last[-1:] in (".", " ")
    harmless = last and not odd and len(os.fsencode(last)) <= 200 and not _RESERVED.fullmatch(last)
    return last if harmless else safe_file_name(last)


def quoted_link(path: PurePath | str) -> str:
    """A relative path as `href`: with `/`, and everything quoted that could end it or make it a script's address."""
    text = path.as_posix() if isinstance(path, PurePath) else path
    return quote(os.fsencode(text), safe="/")


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()
