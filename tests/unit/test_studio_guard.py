"""Who may use the page: this machine's own browser, or whoever has the token; no other web page."""

from __future__ import annotations

import urllib.error
import urllib.request
from collections.abc import Iterator
from typing import Any

import pytest

from fd_mitsuba.errors import UserError
from fd_mitsuba.studio.guard import COOKIE, Frame, Guard, is_local

LOCAL = {"Host": "127.0.0.1:8080"}
AWAY = {"Host": "10.0.0.7:8080"}


@pytest.mark.parametrize(
    ("token", "path", "headers", "fine"),
    [
        (None, "/", LOCAL, True),
        (None, "/", {"Host": "localhost:1"}, True),
        (None, "/", {"Host": "[::1]:8080"}, True),
        (None, "/", {"Host": "evil.org:8080"}, False),  # a name that was bent to this machine's address
        (None, "/", {}, False),
        (None, "/", {**LOCAL, "Origin": "http://127.0.0.1:8080"}, True),
        (None, "/", {**LOCAL, "Origin": "https://evil.org"}, False),
        (None, "/", {**LOCAL, "Origin": "http://127.0.0.1:9999"}, False),
        (None, "/", {**LOCAL, "Origin": "null"}, False),
        ("secret", "/", AWAY, False),
        ("secret", "/?token=secret", AWAY, True),
        ("secret", "/?token=secre", AWAY, False),
        ("secret", "/a.js", {**AWAY, "Cookie": f"x=1; {COOKIE}=secret"}, True),
        ("secret", "/a.js", {**AWAY, "Cookie": f"{COOKIE}=no"}, False),
        ("secret", "/?token=secret", {**AWAY, "Origin": "https://evil.org"}, False),
        ("secret", "/?token=", {**AWAY, "Cookie": ";;=;"}, False),
    ],
)
def test_refusals(token: str | None, path: str, headers: dict[str, str], fine: bool) -> None:
    assert (Guard(token).refusal(path, headers) is None) == fine


def test_loopback_names() -> None:
    assert is_local("127.9.9.9") and is_local("LOCALHOST") and is_local("::1")
    assert not is_local("0.0.0.0") and not is_local("") and not is_local("127.0.0.1.evil.org")


@pytest.fixture(scope="module")
def page() -> Iterator[tuple[Guard, int]]:
    viser = pytest.importorskip("viser")
    guard = Guard("secret")

    async def talk(connection: Any) -> None:
        await connection.send("hello")

    with guard.before_server({"/frame": Frame(b"<p>mine", talk)}):
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield guard, server.get_port()
    server.stop()


def ask(port: int, path: str = "/", **headers: str) -> tuple[int, str]:
    request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=20) as answer:
            return answer.status, answer.headers.get("Set-Cookie", "")
    except urllib.error.HTTPError as error:
        return error.code, ""


def test_viser_is_behind_the_guard(page: tuple[Guard, int]) -> None:
    guard, port = page
    assert guard.installed and ask(port) == (403, "")
    status, cookie = ask(port, "/?token=secret")
    assert status == 200 and cookie.startswith(f"{COOKIE}=secret; HttpOnly; SameSite=Strict")
    assert ask(port, Cookie=f"{COOKIE}=secret")[0] == 200
    websocket = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
    assert ask(port, **websocket, **{"Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ=="})[0] == 403


def test_a_frame_is_behind_the_guard_and_within_our_pages_alone(page: tuple[Guard, int]) -> None:
    port = page[1]
    assert ask(port, "/frame")[0] == 403
    for path, body, framing in (("/frame", b"<p>mine", "SAMEORIGIN"), ("/", b"<!doctype html>", "DENY")):
        request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", headers={"Cookie": f"{COOKIE}=secret"})
        with urllib.request.urlopen(request, timeout=20) as answer:
            assert answer.read()[: len(body)].lower() == body and answer.headers["X-Frame-Options"] == framing
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    address = f"ws://127.0.0.1:{port}/frame"
    with pytest.raises(InvalidStatus, match="403"):
        connect(address)
    with pytest.raises(InvalidStatus, match="403"):
        connect(f"{address}?token=secret", origin="https://evil.org")  # type: ignore[arg-type]
    with connect(f"{address}?token=secret") as socket:
        assert socket.recv(timeout=20) == "hello"


def test_taken_port_is_refused(page: tuple[Guard, int]) -> None:
    from fd_mitsuba.studio.server import _refuse_taken

    with pytest.raises(UserError, match="cannot be used .*; give another --port"):
        _refuse_taken("127.0.0.1", page[1])
    with pytest.raises(UserError, match="give another --port"):
        _refuse_taken("127.0.0.1", 70000)
