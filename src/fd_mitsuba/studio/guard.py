"""Who may talk to the page's server: this machine's own browser, or whoever has the token.

viser has no such thing, and takes WebSocket connections from any page that the browser shows. Both are checked before
viser sees a request: the `Host` and `Origin` headers, so that no other web page can steer the studio through the
user's browser; and for other addresses than this machine's a token, which the first visit leaves in a cookie.
"""

from __future__ import annotations

import hmac
import http
import ipaddress
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

COOKIE = "fd_mitsuba_studio"


@dataclass(frozen=True)
class Frame:
    """A page of our own within the server's, and the socket of its script.

    Attributes:
        page: HTML, served to the server's own pages alone.
        talk: takes the connection of a WebSocket at the same path.
    """

    page: bytes
    talk: Callable[[Any], Awaitable[None]]


@dataclass
class Guard:
    """Attributes:
    token: to be in the URL as `?token=...`, or in the cookie; None: not needed.
    installed: whether the server asks this guard.
    """

    token: str | None = None
    installed: bool = False

    def refusal(self, path: str, headers: Any) -> str | None:
        """Why a request is refused; None where it is not.

        Args:
            path: with its query.
            headers: a mapping with `get`.
        """
        host = headers.get("Host") or ""
        origin = headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return "a page of another origin cannot use the studio"
        if self.token is None:
            return (
                None if is_local(urlsplit(f"//{host}").hostname or "") else "only this machine's own names are served"
            )
        given = [*parse_qs(urlsplit(path).query).get("token", []), self._cookie(headers)]
        known = any(hmac.compare_digest(text.encode(), self.token.encode()) for text in given if text)
        return None if known else "open the address with the token that the terminal shows"

    def _cookie(self, headers: Any) -> str:
        try:
            cookie = SimpleCookie(headers.get("Cookie") or "")
        except CookieError:
            return ""
        return cookie[COOKIE].value if COOKIE in cookie else ""

    @contextmanager
    def before_server(self, frames: Mapping[str, Frame] | None = None) -> Iterator[None]:
        """While open, a `websockets` server that is started asks this guard first; sets `installed`.

        Args:
            frames: path -> what the server has there besides its own.
        """
        import websockets.asyncio.server as module

        original = module.serve

        def serve(handler: Any, *arguments: Any, process_request: Any = None, **options: Any) -> Any:
            def answer(connection: Any, request: Any) -> Any:
                if (problem := self.refusal(request.path, request.headers)) is not None:
                    return _response(http.HTTPStatus.FORBIDDEN, "text/plain", f"{problem}\n".encode())
                frame = self._frame(frames, request)
                if frame is not None and request.headers.get("Upgrade") != "websocket":
                    return self._marked(_response(http.HTTPStatus.OK, "text/html", frame.page), "SAMEORIGIN")
                found = None if frame or process_request is None else process_request(connection, request)
                return None if found is None else self._marked(found, "DENY")

            async def talk(connection: Any) -> None:
                frame = self._frame(frames, connection.request)
                await (handler if frame is None else frame.talk)(connection)

            self.installed = True
            return original(talk, *arguments, process_request=answer, **options)

        module.serve = serve
        try:
            yield
        finally:
            module.serve = original

    @staticmethod
    def _frame(frames: Mapping[str, Frame] | None, request: Any) -> Frame | None:
        return (frames or {}).get(urlsplit(request.path).path)

    def _marked(self, answer: Any, framing: str) -> Any:
        """The answer, with who may put it into a frame, and the token for the next visit."""
        answer.headers["X-Frame-Options"] = framing
        answer.headers["Referrer-Policy"] = "no-referrer"
        if self.token is not None:
            answer.headers["Set-Cookie"] = f"{COOKIE}={self.token}; HttpOnly; SameSite=Strict; Path=/"
        return answer


def _response(status: http.HTTPStatus, kind: str, body: bytes) -> Any:
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    headers = Headers({"Content-Type": f"{kind}; charset=utf-8", "Content-Length": str(len(body))})
    return Response(status, status.phrase, headers, body)


def is_local(name: str) -> bool:
    """Whether a host's name or address is this machine's own loopback."""
    if name.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(name).is_loopback
    except ValueError:
        return False
