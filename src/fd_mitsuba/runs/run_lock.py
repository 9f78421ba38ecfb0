"""One process at a time writes into a run folder: a lock that ends with its process, however that ends."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import platform
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from fd_mitsuba.errors import UserError
from fd_mitsuba.io.json_object import read_json_object

LOCK_NAME = ".lock"
_UNSUPPORTED = {errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL}
_held: dict[Path, int] = {}
"""Folders that this process has locked, and in which thread; `flock` would let a thread wait for itself."""


@contextmanager
def run_lock(folder: Path, say: Callable[[str], None] = print) -> Iterator[None]:
    """While open, no other process gets the folder; it is made if it is missing, and goes again if it stays empty.

    The system frees the lock of a process that was killed, so the file that such a process leaves behind counts for
    nothing. A thread that has the folder already may take it again.

    Args:
        say: hears of a file system that has no locks, where nobody is kept out.

    Raises:
        UserError: another process has the folder; the message says which. Or the folder cannot be written.
    """
    key, thread = folder.resolve(), threading.get_ident()
    if _held.get(key) == thread:
        yield
        return
    if key in _held:
        raise UserError(f"{folder}: is used by another run of this process; wait for its end, or choose another -o")
    try:
        made = _make(folder)
        was_empty = all(path.name == LOCK_NAME for path in folder.iterdir())
        descriptor = _locked(folder, say)
    except OSError as error:
        reason = error.strerror or error
        raise UserError(f"{folder}: cannot be written ({reason}); choose another -o folder") from None
    _held[key] = thread
    try:
        yield
    finally:
        del _held[key]
        # The file goes while it is locked: whoever opens it now notices afterwards that it is another one.
        with suppress(OSError):
            (folder / LOCK_NAME).unlink()
        os.close(descriptor)
        with suppress(OSError):
            for place in made or ([] if was_empty else [folder]):
                place.rmdir()


def _make(folder: Path) -> list[Path]:
    """Make the folder; those that had to be made, the innermost first."""
    missing = [place for place in (folder, *folder.parents) if not place.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    return missing


def _locked(folder: Path, say: Callable[[str], None]) -> int:
    """The descriptor of the locked file."""
    path = folder / LOCK_NAME
    while True:
        folder.mkdir(parents=True, exist_ok=True)  # its last user may just have removed it
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        except FileNotFoundError:
            continue
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in _UNSUPPORTED:
                say(f"{folder}: its file system has no locks ({error.strerror}); start no second run in this folder")
                return descriptor
            os.close(descriptor)
            if not isinstance(error, BlockingIOError):
                raise
            raise UserError(
                f"{folder}: is used by {_holder(path)}; wait for its end, or choose another -o folder"
            ) from None
        if _is_still(path, descriptor):
            about = {"process": os.getpid(), "host": platform.node(), "since": time.strftime("%Y-%m-%d %H:%M:%S")}
            os.ftruncate(descriptor, 0)
            os.write(descriptor, json.dumps(about).encode())
            return descriptor
        os.close(descriptor)


def _is_still(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(os.stat(path), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _holder(path: Path) -> str:
    """Who wrote the lock, in words. The holder of a lock that was taken over may not have written itself down yet."""
    about: dict = {}
    for _ in range(20):
        about = read_json_object(path) or {}
        if _lives(about.get("process"), about.get("host")):
            break
        time.sleep(0.05)
    if not {"process", "host", "since"} <= set(about):
        return "another process"
    return f"process {about['process']} on {about['host']} since {about['since']}"


def _lives(process: object, host: object) -> bool:
    if host != platform.node() or not isinstance(process, int):
        return host is not None
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
