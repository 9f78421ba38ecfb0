"""Reading only what is a regular file of a bearable size: a pipe would hang, a device would never end."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import BinaryIO

_KINDS = (
    (stat.S_ISDIR, "is a folder"),
    (stat.S_ISFIFO, "is a named pipe, not a regular file"),
    (stat.S_ISSOCK, "is a socket, not a regular file"),
    (stat.S_ISCHR, "is a device, not a regular file"),
    (stat.S_ISBLK, "is a device, not a regular file"),
)
_PIECE = 1 << 24


class NotReadable(Exception):
    """A file that cannot or must not be read; the text says why, without the file's name."""


def refuse_unreadable(path: Path, limit: int) -> os.stat_result:
    """The file's status, if it is a regular file of at most `limit` bytes that this process may read.

    Nothing is opened, so that a named pipe does not wait for a writer.

    Raises:
        NotReadable: otherwise, and where there is no such file.
    """
    try:
        status = os.stat(path)
        _refuse_kind_and_size(status, limit)
        if not os.access(path, os.R_OK):
            raise NotReadable("cannot be read (Permission denied)")
    except OSError as error:
        raise NotReadable(_reason(error)) from None
    except ValueError as error:  # a NUL in the name
        raise NotReadable(f"is no file name ({error})") from None
    return status


def read_regular(path: Path, limit: int) -> bytes:
    """The bytes of a regular file of at most `limit` bytes.

    Raises:
        NotReadable: see `refuse_unreadable`.
    """
    refuse_unreadable(path, limit)
    try:
        # Without O_NONBLOCK, a pipe that was put there since would hang.
        number = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        with open(number, "rb") as file:
            _refuse_kind_and_size(os.fstat(number), limit)
            data = _at_most(file, limit + 1)
    except OSError as error:
        raise NotReadable(_reason(error)) from None
    if len(data) > limit:
        raise NotReadable(f"is larger than {_size(limit)}")
    return data


def _at_most(file: BinaryIO, count: int) -> bytes:
    """What `file.read(count)` gives, which would set aside `count` bytes first, however small the file is."""
    pieces = []
    while count and (piece := file.read(min(count, _PIECE))):
        pieces.append(piece)
        count -= len(piece)
    return b"".join(pieces)


def _refuse_kind_and_size(status: os.stat_result, limit: int) -> None:
    for is_kind, problem in _KINDS:
        if is_kind(status.st_mode):
            raise NotReadable(problem)
    if not stat.S_ISREG(status.st_mode):
        raise NotReadable("is not a regular file")
    if status.st_size > limit:
        raise NotReadable(f"has {_size(status.st_size)}, more than {_size(limit)}")


def _reason(error: OSError) -> str:
    if isinstance(error, FileNotFoundError | NotADirectoryError):
        return "not found"
    return f"cannot be read ({error.strerror or error})"


def _size(count: int) -> str:
    return f"{count / (1 << 30):.1f} GB" if count >= 1 << 30 else f"{count / (1 << 20):.1f} MB"
