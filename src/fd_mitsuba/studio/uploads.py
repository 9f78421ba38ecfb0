"""Files that a tab sends: put into a folder part by part, refused before their bytes are kept where they are too large.

viser gathers uploads of any size in memory, and tells every tab of them. This takes the place of its handlers.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from fd_mitsuba.errors import UserError
from fd_mitsuba.io.safe_text import safe_file_name

if TYPE_CHECKING:
    import viser

MOST_BYTES = 256 << 20
"""Of one file."""


@dataclass
class _Transfer:
    """One file on its way: what the tab announced, and how much of it is there."""

    client: Any
    name: str
    size: int
    parts: int
    path: Path
    stream: BinaryIO
    next_part: int = 0
    received: int = 0


class Uploads:
    """What the tabs of a server send; each tab sends one file at a time.

    Args:
        new_folder: makes a folder for a file; UserError where it cannot.
        taken: hears the tab and the path of a file that is there as a whole, from the server's own thread.
        refused: hears the tab and why its file is not taken.
        most: bytes of a file.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        new_folder: Callable[[], Path],
        taken: Callable[[Any, Path], None],
        refused: Callable[[Any, str], None],
        most: int = MOST_BYTES,
    ) -> None:
        from viser import _messages as messages

        self._messages, self._server = messages, server
        self._new_folder, self._taken, self._refused, self._most = new_folder, taken, refused, most
        self._transfers: dict[str, _Transfer] = {}
        interface = server._websock_server
        for kind, handler in (
            (messages.FileTransferStartUpload, self._begin),
            (messages.FileTransferPart, self._part),
        ):
            interface.unregister_handler(kind)
            interface.register_handler(kind, handler)

        async def gone(client: Any) -> None:  # `async`: in the thread of the handlers
            self._gone(client)

        server.on_client_disconnect(gone)

    def _begin(self, client_id: int, message: Any) -> None:
        client = self._server.get_clients().get(client_id)
        if client is None:
            return
        self._gone(client)
        if problem := self._problem(message):
            self._refuse(client, message, problem)
            return
        try:
            path = self._new_folder() / safe_file_name(Path(message.filename).name)
            stream = open(path, "wb")
        except (OSError, UserError) as error:
            self._refuse(client, message, str(error))
            return
        self._transfers[message.transfer_uuid] = _Transfer(
            client, message.filename, message.size_bytes, message.part_count, path, stream
        )

    def _problem(self, message: Any) -> str:
        shown = message.filename[:80]
        if message.size_bytes > self._most:
            size, most = message.size_bytes >> 20, self._most >> 20
            return f"{shown}: has {size} MB, more than {most}; reduce it, or give its path to fd_mitsuba studio"
        if message.size_bytes <= 0 or message.part_count <= 0:
            return f"{shown}: is empty; export the model anew"
        return ""

    def _part(self, client_id: int, message: Any) -> None:
        transfer = self._transfers.get(message.transfer_uuid)
        if transfer is None or transfer.client.client_id != client_id or message.part_index < transfer.next_part:
            return
        transfer.received += len(message.content)
        if message.part_index > transfer.next_part or transfer.received > transfer.size:
            self._drop(message.transfer_uuid)
            self._refuse(transfer.client, message, f"{transfer.name[:80]}: did not arrive as it was sent; try again")
            return
        try:
            transfer.stream.write(message.content)
        except OSError as error:
            self._drop(message.transfer_uuid)
            self._refuse(transfer.client, message, f"{transfer.path}: cannot be written ({error.strerror})")
            return
        transfer.next_part += 1
        if transfer.next_part < transfer.parts:
            self._told(transfer.client, message, transfer.received, transfer.size)
            return
        whole = transfer.received == transfer.size
        if whole:
            del self._transfers[message.transfer_uuid]
            transfer.stream.close()
            self._told(transfer.client, message, transfer.size, transfer.size)
            self._taken(transfer.client, transfer.path)
        else:
            self._drop(message.transfer_uuid)
            self._refuse(transfer.client, message, f"{transfer.name[:80]}: did not arrive as it was sent; try again")

    def _told(self, client: Any, message: Any, received: int, size: int) -> None:
        """Let the tab show how far its file is."""
        client._websock_connection.queue_message(
            self._messages.FileTransferPartAck(message.source_component_uuid, message.transfer_uuid, received, size)
        )

    def _refuse(self, client: Any, message: Any, problem: str) -> None:
        """End the tab's own display of its upload, and say why."""
        self._told(client, message, 1, 1)
        client._websock_connection.queue_message(
            self._messages.RemoveNotificationMessage(f"upload-{message.transfer_uuid}")
        )
        self._refused(client, problem)

    def _gone(self, client: Any) -> None:
        """Forget what a tab has begun to send."""
        for key in [key for key, transfer in self._transfers.items() if transfer.client is client]:
            self._drop(key)

    def _drop(self, key: str) -> None:
        transfer = self._transfers.pop(key)
        with contextlib.suppress(OSError):
            transfer.stream.close()
        shutil.rmtree(transfer.path.parent, ignore_errors=True)
