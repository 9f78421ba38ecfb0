"""Who may talk to the page's server: this machine's own browser, or whoever has the token.

viser has no such thing, and takes WebSocket connections from any page that the browser shows. Both are checked before
viser sees a request: the `Host` and `Origin` headers, so that no other web page can steer the studio through the
user's browser; and for other addresses than this machine's a token, which the first visit leaves in a cookie.
"""

from __future__ import annotations

import hmac
import http
import ipaddress
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

COOKIE = "fd_mitsuba_studio"


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
    def before_server(self) -> Iterator[None]:
        """While open, a `websockets` server that is started asks this guard first; sets `installed`."""
        import websockets.asyncio.server as module
        from websockets.datastructures import Headers
        from websockets.http11 import Response

        original = module.serve

        def serve(*arguments: Any, process_request: Callable[..., Any] | None = None, **options: Any) -> Any:
            def asked(connection: Any, request: Any) -> Any:
                if (problem := self.refusal(request.path, request.headers)) is not None:
                    text = f"{problem}\n".encode()
                    plain = Headers({"Content-Type": "text/plain", "Content-Length": str(len(text))})
                    return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", plain, text)
                answer = None if process_request is None else process_request(connection, request)
                if answer is not None:
                    answer.headers["X-Frame-Options"] = "DENY"
                    answer.headers["Referrer-Policy"] = "no-referrer"
                    if self.token is not None:
                        answer.headers["Set-Cookie"] = f"{COOKIE}={self.token}; HttpOnly; SameSite=Strict; Path=/"
                return answer

            self.installed = True
            return original(*arguments, process_request=asked, **options)

        module.serve = serve
        try:
            yield
        finally:
            module.serve = original


def is_local(name: str) -> bool:
    """Whether a host's name or address is this machine's own loopback."""
    if name.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(name).is_loopback
    except ValueError:
        return False
