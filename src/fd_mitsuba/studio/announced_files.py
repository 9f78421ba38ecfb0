"""What a tab is about to send: names and sizes of its files, and which of them is the mesh; or why it is not taken."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from fd_mitsuba.assets.archive import MOST_FILES, only_mesh
from fd_mitsuba.assets.broken import BrokenAsset
from fd_mitsuba.assets.readers import ARCHIVES, is_asset
from fd_mitsuba.errors import UserError
from fd_mitsuba.io.safe_text import harmless_file_name


@dataclass(frozen=True)
class AnnouncedFiles:
    """Attributes:
    sizes: name that a file will have in its folder -> bytes, in the order in which they come.
    mesh: the name of the one that refers to the others.
    """

    sizes: dict[str, int]
    mesh: str

    @classmethod
    def read(cls, message: str | bytes, most: int) -> AnnouncedFiles:
        """What the page's first message says, `{"files": [{"name": "box.obj", "size": 812}, ...]}`.

        Args:
            most: bytes of all of them.

        Raises:
            UserError: it says something else, or its files are too many, too large, or those of no mesh or several.
        """
        try:
            given = [(str(file["name"]), int(file["size"])) for file in json.loads(message)["files"]]
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
            raise UserError("the page did not say what it sends; load it again") from None
        if len(given) > MOST_FILES:
            raise UserError(f"{len(given)} files are more than {MOST_FILES}; send the mesh and its textures alone")
        sizes = {harmless_file_name(name): max(size, 0) for name, size in given}
        if not sizes:
            raise UserError("no file was chosen")
        first = next((name for name in sizes if is_asset(name)), next(iter(sizes)))
        if len({name.casefold() for name in sizes}) < len(given):
            raise UserError(f"{first}: two of the files have one name; send a ZIP of their folder")
        if (total := sum(sizes.values())) > most:
            what = f"{first}: has" if len(sizes) == 1 else f"{first}: has, with {len(sizes) - 1} more,"
            limit = f"more than {most >> 20}; reduce it, or give its path to fd_mitsuba studio"
            raise UserError(f"{what} {total >> 20} MB, {limit}")
        return cls(sizes, _mesh(list(sizes)))


def _mesh(names: list[str]) -> str:
    if len(names) == 1:
        return names[0]  # its reader knows best what is wrong with it
    archive = next((name for name in names if Path(name).suffix.lower() in ARCHIVES), None)
    if archive is not None:
        raise UserError(f"{archive}: is one of {len(names)} files; send it alone")
    try:
        return only_mesh(names)
    except BrokenAsset as error:
        raise UserError(f"what was sent {error}") from None
