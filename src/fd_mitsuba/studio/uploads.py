"""Files that a tab sends: over a connection of their own, into a folder, refused before any of their bytes are sent.

viser takes files over the socket that carries the page's clicks, which then wait, and gathers any size in memory. So
the page has a frame with a small page of our own, `upload_page.html`, whose script talks with this as follows:

    browser  {"files": [{"name": "box.obj", "size": 812}, {"name": "box.mtl", "size": 94}]}
    server   {"received": 0}, or {"problem": "..."} and the end
    browser  the files one after the other, in messages of at most `MOST_PART` bytes
    server   {"received": 812} after each message, which the next one waits for
    server   {"opened": "..."} or {"problem": "..."} when all is there and has been read
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import shutil
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from fd_mitsuba.assets.readers import ARCHIVES, READERS
from fd_mitsuba.errors import UserError
from fd_mitsuba.studio.announced_files import AnnouncedFiles
from fd_mitsuba.studio.plain_text import without_paths

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection

PATH = "/upload"
"""Of the frame's page and of its socket."""
MOST_BYTES = 256 << 20
"""Of all files that are sent together."""
MOST_PART = 1 << 20
_COMPANIONS = (".mtl", ".bin", "image/*")


class Uploads:
    """What the tabs send.

    Args:
        new_folder: makes a folder for some files; UserError where it cannot.
        opened: hears the path of the mesh when all is there, in a thread of its own: it may take a while, and others go
            on meanwhile. It says what is to be said, a line each; UserError where the mesh cannot be opened.
        plain: takes paths of this machine out of a text.
        most: bytes of files that are sent together.
    """

    def __init__(
        self,
        new_folder: Callable[[], Path],
        opened: Callable[[Path], list[str]],
        plain: Callable[[str], str],
        most: int = MOST_BYTES,
    ) -> None:
        self._new_folder, self._opened, self._plain, self._most = new_folder, opened, plain, most

    @staticmethod
    def page() -> bytes:
        """What is in the frame."""
        text = Path(__file__).with_name("upload_page.html").read_text(encoding="utf-8")
        accepted = ",".join([*READERS, *ARCHIVES, *_COMPANIONS])
        return text.replace("ACCEPTED", accepted).replace("MOST_PART", str(MOST_PART)).encode()

    async def serve(self, connection: ServerConnection) -> None:
        """Talk with a tab's frame until its files are opened or refused."""
        from websockets.exceptions import ConnectionClosed

        with contextlib.suppress(ConnectionClosed):  # the tab may be closed at any moment
            try:
                answer = {"opened": await self._taken(connection)}
            except UserError as error:
                answer = {"problem": " ".join(self._plain(str(error)).split())}
            await connection.send(json.dumps(answer))

    async def _taken(self, connection: ServerConnection) -> str:
        announced = AnnouncedFiles.read(await connection.recv(), self._most)
        folder = self._new_folder()
        try:
            await connection.send(json.dumps({"received": 0}))
            received = 0
            for name, size in announced.sizes.items():
                await self._receive(connection, folder / name, size, received)
                received += size
            said = await asyncio.to_thread(self._open, folder / announced.mesh)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        return "; ".join([f"{announced.mesh} is the base now", *said])

    @staticmethod
    async def _receive(connection: ServerConnection, path: Path, size: int, before: int) -> None:
        """One file of `size` bytes, of which `before` have been received with earlier ones."""
        try:
            with open(path, "wb") as file:
                while (there := file.tell()) < size:
                    part = await connection.recv()
                    if isinstance(part, str) or not 0 < len(part) <= min(MOST_PART, size - there):
                        raise UserError(f"{path.name}: did not arrive as it was announced; try again")
                    file.write(part)
                    await connection.send(json.dumps({"received": before + file.tell()}))
        except OSError as error:
            raise UserError(f"{path.name}: cannot be written ({error.strerror or error})") from None

    def _open(self, mesh: Path) -> list[str]:
        try:
            return self._opened(mesh)
        except UserError as error:
            raise UserError(without_paths(str(error), mesh.parent)) from None
        except Exception:
            traceback.print_exc()
            raise UserError("that went wrong; the terminal has more about it") from None
