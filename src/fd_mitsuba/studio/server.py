"""Starts the studio: session, viser's server behind its guard, the page. Imports viser, which is an extra."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import platform
import secrets
import socket
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

from fd_mitsuba.errors import UserError
from fd_mitsuba.studio.guard import Frame, Guard, is_local
from fd_mitsuba.studio.session import Session

if TYPE_CHECKING:
    import viser

HOST = "127.0.0.1"


def require_viser() -> None:
    """UserError that says how to install the page's library where it is missing."""
    if importlib.util.find_spec("viser") is None:
        raise UserError("studio: needs viser, which is an extra; install it by: pip install 'fd_mitsuba[studio]'")


class StudioServer:
    """The page of a session at an address, from its making until `close`.

    Args:
        host: 127.0.0.1, where this machine alone sees it; for any other address the URL has a token.
        port: 0: any that is free.

    Attributes:
        url: to open in a browser.

    Raises:
        UserError: the address cannot be had, or this viser has no place for the guard.
    """

    def __init__(self, session: Session, host: str = HOST, port: int = 8080) -> None:
        require_viser()
        import viser

        from fd_mitsuba.studio.uploads import PATH, Uploads
        from fd_mitsuba.studio.view import View

        _refuse_taken(host, port)
        local = is_local(host)
        guard = Guard(None if local else secrets.token_urlsafe(18))
        uploads = Uploads(session.work.next_upload, session.open_mesh, session.plain)
        frames = {PATH: Frame(uploads.page(), uploads.serve)}
        # viser prints a table of its own, and would ask the whole network in.
        with guard.before_server(frames), contextlib.redirect_stdout(io.StringIO()):
            self.server = viser.ViserServer(host=host, port=port, verbose=False)
        if not guard.installed:
            self.server.stop()
            raise UserError("studio: this version of viser cannot be guarded; install fd_mitsuba[studio] again")
        # Any client could ask for a tunnel to the internet.
        self.server.request_share_url = lambda verbose=True: None  # type: ignore[method-assign]
        _refuse_files(self.server)
        self.session = session
        self.view = View(self.server, session)
        named = platform.node() if host in ("0.0.0.0", "::") else host  # all addresses is none to open
        shown = f"[{named}]" if ":" in named else named
        query = "" if guard.token is None else f"/?token={guard.token}"
        self.url = f"http://{shown}:{self.server.get_port()}{query}"

    def close(self) -> None:
        """End the page; the session is the caller's."""
        self.view.close()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()


def serve(session: Session, host: str, port: int, say: Callable[[str], None], ended: threading.Event) -> None:
    """Show a session until `ended` is set; then the present run saves its state.

    Args:
        say: hears the address.
    """
    server = StudioServer(session, host, port)
    session.start()
    say(f"studio at {server.url}, Ctrl-C ends it; everything is kept in {session.work.path}")
    try:
        ended.wait()
    finally:
        if session.queue.current is not None:
            say("stopping: the run saves its state")
        server.close()
        session.close()


def _refuse_taken(host: str, port: int) -> None:
    """viser would quietly take another port, and `--port` would not mean what it says."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise UserError(f"--host {host} --port {port}: cannot be used ({reason}); give another --port") from None


def _refuse_files(server: viser.ViserServer) -> None:
    """Any client could send files of any size over viser's own socket, which gathers them in memory."""
    from viser import _messages as messages

    for kind in (messages.FileTransferStartUpload, messages.FileTransferPart):
        server._websock_server.unregister_handler(kind)
