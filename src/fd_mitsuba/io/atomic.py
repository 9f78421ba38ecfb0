"""Files that are written whole or not at all."""

from __future__ import annotations

import contextlib
import os
import threading
from pathlib import Path

from fd_mitsuba.errors import UserError

_LITTER = ".tmp"


def write_atomically(path: Path, data: bytes) -> None:
    """Write bytes to a neighbouring file, flush it to the disk, rename it; UserError where that cannot be done."""
    # By process and thread: of two threads that write the same file, one would rename what the other has open.
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}{_LITTER}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(temporary, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        reason = error.strerror or error
        raise UserError(f"{path}: cannot be written ({reason}); free space or choose another -o folder") from None


def is_litter(path: Path) -> bool:
    """Whether a file is what `write_atomically` leaves behind when it is killed."""
    return path.name.startswith(".") and path.name.endswith(_LITTER)
