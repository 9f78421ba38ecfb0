"""Which reader takes which file."""

from __future__ import annotations

from collections.abc import Callable
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
"""Suffix -> reader."""


def is_asset(path: Path | str) -> bool:
    """Whether a file's name says that it is a mesh to import, and no scene."""
    return Path(path).suffix.lower() in READERS


def read_asset(path: Path) -> Asset:
    """What a mesh file holds, with all that it refers to.

    Raises:
        UserError: an unknown format, or whatever keeps it from being read, in one line that names the file.
    """
    from fd_mitsuba.assets.broken import BrokenAsset

    suffix = path.suffix.lower()
    if suffix not in READERS:
        known = ", ".join(name.removeprefix(".").upper() for name in READERS)
        raise UserError(f"{path}: {suffix or 'no suffix'} is not read ({known} are); export it as GLB, as from Blender")
    try:
        return READERS[suffix](path)
    except BrokenAsset as error:
        raise UserError(f"{path}: {error}") from None
    except (MemoryError, UserError):
        raise
    except (ValueError, IndexError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise UserError(f"{path}: is damaged ({first_line(error)}); export the model anew") from None
