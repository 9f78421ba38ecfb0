"""Which reader takes which file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from fd_mitsuba.assets.asset import Asset
from fd_mitsuba.assets.broken import BrokenAsset
from fd_mitsuba.assets.gltf import read_gltf
from fd_mitsuba.assets.obj import read_obj
from fd_mitsuba.assets.plain_meshes import read_off, read_stl
from fd_mitsuba.assets.ply import read_ply_asset
from fd_mitsuba.errors import UserError, first_line

READERS: dict[str, Callable[[Path], Asset]] = {
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".obj": read_obj,
    ".ply": read_ply_asset,
    ".stl": read_stl,
    ".off": read_off,
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
