"""Which reader takes which file."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from fd_mitsuba.errors import UserError, first_line

if TYPE_CHECKING:
    from fd_mitsuba.assets.asset import Asset


def _reader(module: str, name: str) -> Callable[[Path], Asset]:
    """That function of a module of this package, loaded at its first call: every command asks what is an asset."""

    def read(path: Path) -> Asset:
        return getattr(import_module(f"fd_mitsuba.assets.{module}"), name)(path)

    return read


READERS: dict[str, Callable[[Path], Asset]] = {
    ".glb": _reader("gltf", "read_gltf"),
    ".gltf": _reader("gltf", "read_gltf"),
    ".obj": _reader("obj", "read_obj"),
    ".dae": _reader("dae", "read_dae"),
    ".3ds": _reader("threeds", "read_3ds"),
    ".ply": _reader("ply", "read_ply_asset"),
    ".stl": _reader("plain_meshes", "read_stl"),
    ".off": _reader("plain_meshes", "read_off"),
}
"""Suffix -> reader of a mesh."""
ARCHIVES: dict[str, Callable[[Path], Asset]] = {".zip": _reader("archive", "read_zip")}
"""Suffix -> reader of a file that holds a mesh with what it refers to."""


def formats_in_words(suffixes: Iterable[str]) -> str:
    """Such as "GLB, OBJ"."""
    return ", ".join(name.removeprefix(".").upper() for name in suffixes)


def is_asset(path: Path | str) -> bool:
    """Whether a file's name says that it is a mesh to import, and no scene."""
    return Path(path).suffix.lower() in READERS | ARCHIVES


def read_asset(path: Path) -> Asset:
    """What a mesh file holds, with all that it refers to.

    Raises:
        UserError: an unknown format, or whatever keeps it from being read, in one line that names the file.
    """
    from fd_mitsuba.assets.broken import BrokenAsset

    try:
        return read_named(path)
    except BrokenAsset as error:
        raise UserError(f"{path}: {error}") from None


def read_named(path: Path) -> Asset:
    """As `read_asset`; BrokenAsset for what is wrong, without the file's name."""
    from fd_mitsuba.assets.broken import BrokenAsset

    suffix = path.suffix.lower()
    reader = (READERS | ARCHIVES).get(suffix)
    if reader is None:
        known = formats_in_words((*READERS, *ARCHIVES))
        shown = suffix or "a name without a suffix"
        raise BrokenAsset(f"{shown} is not read ({known} are); export it as GLB, as from Blender")
    if path.is_file() and path.stat().st_size == 0:
        raise BrokenAsset("is empty; export the model anew")
    try:
        return reader(path)
    except (ValueError, IndexError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise BrokenAsset(f"is damaged ({first_line(error)}); export the model anew") from None
