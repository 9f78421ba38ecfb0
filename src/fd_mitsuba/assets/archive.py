"""Assets of several files: a ZIP as model sites hand it out, and which of some files is the mesh."""

from __future__ import annotations

import lzma
import re
import shutil
import stat
import tempfile
import zipfile
import zlib
from collections.abc import Collection, Iterable
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from fd_mitsuba.assets.broken import BrokenAsset
from fd_mitsuba.io.regular_file import NotReadable, refuse_unreadable

if TYPE_CHECKING:
    from fd_mitsuba.assets.asset import Asset

MOST_BYTES = 1 << 30
"""Of a ZIP, and of all that it holds."""
MOST_FILES = 1000
_MOST_DIRECTORY = 1 << 20
"""Bytes of a ZIP's list of its files: some millions of empty ones would take gigabytes to list."""
_UNREADABLE = (NotImplementedError, EOFError, ValueError, zlib.error, lzma.LZMAError)
"""What `zipfile` raises besides its own error: damaged data, or a method that it does not know."""
_LONGEST_END = 22 + (1 << 16)
_END, _END_64 = b"PK\5\6", b"PK\6\7"  # the latter leads to lists of more than 65,535 files


def read_zip(path: Path) -> Asset:
    """The one asset in a ZIP, with what it refers to.

    Raises:
        BrokenAsset: no ZIP, more than is bearable, names that lead out of it, no mesh, several, or one with a fault.
    """
    from fd_mitsuba.assets.readers import read_named

    with tempfile.TemporaryDirectory(prefix="fd_mitsuba_") as folder:
        mesh = unpack(path, Path(folder))
        try:
            return replace(read_named(Path(folder) / mesh), packed=mesh)
        except BrokenAsset as error:
            raise BrokenAsset(f"{mesh} in it {error}") from None


def unpack(path: Path, folder: Path) -> str:
    """Write all that a ZIP holds into a folder; which file is the mesh, relative to it. BrokenAsset as `read_zip`."""
    try:
        refuse_unreadable(path, MOST_BYTES)
        _refuse_long_directory(path)
        with zipfile.ZipFile(path) as archive:
            files = [entry for entry in archive.infolist() if not _left_out(entry)]
            _refuse(files)
            mesh = only_mesh([entry.filename for entry in files])
            for entry in files:
                target = folder / entry.filename
                target.parent.mkdir(parents=True, exist_ok=True)
                with archive.open(entry) as source, open(target, "wb") as file:
                    shutil.copyfileobj(source, file)  # no more than the entry announces
    except NotReadable as error:
        raise BrokenAsset(str(error)) from None
    except (zipfile.BadZipFile, *_UNREADABLE, OSError) as error:
        reason = getattr(error, "strerror", None) or error
        words = " ".join(str(reason).split())[:80] or "cut short"
        raise BrokenAsset(f"cannot be unpacked ({words}); pack it anew") from None
    return mesh


def only_mesh(names: Iterable[str]) -> str:
    """The one file among those of an asset that is a mesh.

    Raises:
        BrokenAsset: there is none, or more than one.
    """
    from fd_mitsuba.assets.readers import READERS, formats_in_words

    meshes = [name for name in names if PurePosixPath(name).suffix.lower() in READERS]
    if not meshes:
        raise BrokenAsset(f"holds no mesh ({formats_in_words(READERS)} are read); export the model as GLB")
    if len(meshes) > 1:
        shown = ", ".join(name[:60] for name in meshes[:3]) + (", ..." if len(meshes) > 3 else "")
        raise BrokenAsset(f"holds {len(meshes)} meshes ({shown}); give one of them, with the files it refers to")
    return meshes[0]


def _left_out(entry: zipfile.ZipInfo) -> bool:
    """Folders, and what macOS adds to every file."""
    return entry.is_dir() or entry.filename.startswith("__MACOSX/")


def _refuse(files: Collection[zipfile.ZipInfo]) -> None:
    if len(files) > MOST_FILES:
        raise BrokenAsset(f"holds {len(files)} files, more than {MOST_FILES}; pack the mesh and its textures alone")
    size = sum(entry.file_size for entry in files)
    if size > MOST_BYTES:
        most = MOST_BYTES >> 20
        raise BrokenAsset(f"holds {size >> 20} MB when unpacked, more than {most}; shrink the model or its textures")
    seen: set[str] = set()
    for entry in files:
        name, place = entry.filename, PurePosixPath(entry.filename)
        drive = "\\" in name or ":" in name or not name.isprintable()
        if drive or place.is_absolute() or ".." in place.parts or stat.S_ISLNK(entry.external_attr >> 16):
            raise BrokenAsset(f"holds {name[:60]!r}, which leads out of it; pack it anew")
        if entry.flag_bits & 1:
            raise BrokenAsset("is encrypted; unpack it and give the mesh in it")
        if name.casefold() in seen:
            raise BrokenAsset(f"holds {name[:60]!r} twice; pack it anew")
        seen.add(name.casefold())


def _refuse_long_directory(path: Path) -> None:
    """Look at what the end of the file says before `zipfile` lists all of it."""
    with open(path, "rb") as file:
        file.seek(max(path.stat().st_size - _LONGEST_END, 0))
        end = file.read()
    # All that could be the end of its list: which of them `zipfile` takes is its own affair.
    sizes = [int.from_bytes(end[at.start() + 12 : at.start() + 16], "little") for at in re.finditer(_END, end)]
    if not sizes:
        raise BrokenAsset("is no ZIP, or is cut short; pack it anew")
    if max(sizes) > _MOST_DIRECTORY or _END_64 in end:
        raise BrokenAsset(f"lists more than {MOST_FILES} files; pack the mesh and its textures alone")
