"""The page's server as its tabs see it, over their own protocol: two at once, files that they send, files to refuse."""

from __future__ import annotations

import base64
import json
import struct
import sys
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fd_mitsuba.studio.opening import open_target
from fd_mitsuba.studio.server import StudioServer
from fd_mitsuba.studio.session import Session
from fd_mitsuba.studio.settings import StudioSettings

viser = pytest.importorskip("viser")
import msgspec  # noqa: E402
import zstandard  # noqa: E402
from websockets.sync.client import connect  # noqa: E402

ASSETS = Path(__file__).parents[1] / "data" / "assets"
CAMERA = {"wxyz": (1.0, 0, 0, 0), "position": (0.0, 0, 3), "fov": 0.7, "near": 0.1, "far": 9.0}
CAMERA |= {"image_height": 90, "image_width": 90, "look_at": (0.0, 0, 0), "up_direction": (0.0, 1, 0)}
PART = 1 << 19


class Tab:
    """A browser's side of a connection: sends messages, remembers those that come."""

    def __init__(self, port: int) -> None:
        protocol: Any = f"viser-v{viser.__version__}"
        address = f"ws://127.0.0.1:{port}"
        self.socket = connect(address, subprotocols=[protocol], compression=None, max_size=None)
        self.seen: list[dict[str, Any]] = []
        self.send("ViewerCameraMessage", **CAMERA)

    def send(self, kind: str, **values: Any) -> None:
        self.socket.send(msgspec.msgpack.encode({"type": kind, **values}))

    def types(self, field: Any, value: str) -> None:
        self.send("GuiUpdateMessage", uuid=field._impl.uuid, updates={"value": value})

    def uploads(self, name: str, data: bytes, size: int | None = None, key: str = "one") -> None:
        common = {"source_component_uuid": "button", "transfer_uuid": key}
        parts = [data[at : at + PART] for at in range(0, len(data), PART)]
        about = {"filename": name, "mime_type": "", "part_count": len(parts), "size_bytes": size or len(data)}
        self.send("FileTransferStartUpload", **common, **about)
        for number, part in enumerate(parts):
            self.send("FileTransferPart", **common, part_index=number, content=part)

    def until(self, wanted: Callable[[dict[str, Any]], bool], seconds: float = 20) -> dict[str, Any]:
        """The first message that is wanted, waited for."""
        end = time.monotonic() + seconds
        while True:
            if (found := next((row for row in self.seen if wanted(row)), None)) is not None:
                return found
            data = self.socket.recv(timeout=max(end - time.monotonic(), 0))
            assert isinstance(data, bytes)
            size = struct.unpack_from("<Q", data, 8)[0]
            inner = zstandard.ZstdDecompressor().decompress(data[16 : 16 + size])
            self.seen += msgspec.msgpack.decode(inner)["messages"]

    def told(self) -> str:
        """The text of the next note that the page shows."""
        note = self.until(lambda row: row["type"] == "NotificationShowMessage")
        self.seen.remove(note)
        return note["props"]["body"]


@pytest.fixture
def session(make_scene: Callable[..., Path], mi: Any, tmp_path: Path) -> Iterator[Session]:
    opened = open_target(make_scene(), tmp_path / "work", {}, say=lambda line: None)
    made = Session(opened, StudioSettings("smoke"), program=(sys.executable, "-I", "-c", ""), say=lambda line: None)
    yield made
    made.close()


@pytest.fixture
def server(session: Session) -> Iterator[StudioServer]:
    made = StudioServer(session, port=0)
    yield made
    made.close()


@pytest.fixture
def tabs(server: StudioServer) -> Iterator[tuple[Tab, Tab]]:
    port = server.server.get_port()
    one, other = Tab(port), Tab(port)
    until(lambda: len(server.server.get_clients()) == 2)
    yield one, other
    for tab in (one, other):
        tab.socket.close()


def until(condition: Callable[[], bool], seconds: float = 20) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def changed_glb(change: Callable[[dict[str, Any]], None]) -> bytes:
    """`box.glb` with another JSON."""
    data = (ASSETS / "box.glb").read_bytes()
    (size,) = struct.unpack_from("<I", data, 12)
    content = json.loads(data[20 : 20 + size])
    change(content)
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + data[20 + size :]
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def image_of(uri: str) -> bytes:
    def change(content: dict[str, Any]) -> None:
        content["images"] = [{"uri": uri}]

    return changed_glb(change)


def png_bomb() -> str:
    """A PNG of some bytes that says it has 100,000 x 100,000 pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", 100_000, 100_000, 8, 2, 0, 0, 0)
    pieces = chunk(b"IHDR", head), chunk(b"IDAT", zlib.compress(bytes(9999))), chunk(b"IEND", b"")
    return "data:image/png;base64," + base64.b64encode(b"\x89PNG\r\n\x1a\n" + b"".join(pieces)).decode()


def test_two_tabs_see_and_change_the_same(session: Session, server: StudioServer, tabs: tuple[Tab, Tab]) -> None:
    one, other = tabs
    panel, state = server.view.panel, session.state
    one.types(panel.prompt, "a pig with a horn")
    other.until(
        lambda row: (
            row["type"] == "GuiUpdateMessage"
            and row["uuid"] == panel.prompt._impl.uuid
            and row["updates"].get("value") == "a pig with a horn"
        )
    )
    before = state.regions.poses["wing"]
    other.send("TransformControlsUpdateMessage", name="/gizmo", wxyz=(1.0, 0, 0, 0), position=(0.1, 0.5, 0.2))
    one.until(
        lambda row: (
            row["type"] == "SetPositionMessage"
            and row["name"] == "/regions/0"
            and np.allclose(row["position"], [0.1, 0.5, 0.2], atol=1e-6)
        )
    )
    place = state.regions.frame.to_canonical(np.array(state.regions.poses["wing"].centre))
    assert place == pytest.approx([0.1, 0.5, 0.2]) and state.prompt == "a pig with a horn"
    until(lambda: np.allclose(panel.centre.value, state.regions.poses["wing"].centre, atol=1e-3))
    one.types(panel.part, "a/b")
    assert "cannot name a file" in one.told() and not [m for m in other.seen if m["type"] == "NotificationShowMessage"]
    for tab in (one, other) * 2:  # both press the same button, at once
        tab.types(panel.place_buttons, "Add on top")
    until(lambda: len(state.regions.poses) == 5)
    assert list(state.regions.poses) == ["wing", "region", "region_2", "region_3", "region_4"]
    for _ in range(6):
        one.types(panel.change_buttons, "Undo")
    until(lambda: state.regions.poses == {"wing": before} and state.prompt == "a pig with two wings")


def test_files_that_must_not_be_opened_are_refused_in_a_line(session: Session, tabs: tuple[Tab, Tab]) -> None:
    one, other = tabs
    uploads, before = session.work.path / "uploads", session.state
    one.uploads("huge.glb", b"glTF", size=300 << 20)
    assert one.told() == "huge.glb: has 300 MB, more than 256; reduce it, or give its path to fd_mitsuba studio"
    assert not uploads.exists()
    for data, problem in (
        (image_of("../../secret.png"), r"names '../../secret.png', which lies outside its folder"),
        (image_of("file:///etc/passwd"), "lies outside its folder"),
        (image_of(png_bomb()), "has 100000 x 100000 pixels, more than 134 million; shrink it"),
        (b"glTF" + bytes(40), "is a GLB of version 0"),
        (b"", "is empty"),
    ):
        one.uploads("../../model.glb", data)
        told = one.told()
        assert problem in told and told.startswith("model.glb: ") or not data
        assert "\n" not in told and str(session.work.path) not in told
    one.uploads("thesis.tex", b"words")
    assert "thesis.tex: .tex is not read" in one.told()
    one.send("FileTransferPart", source_component_uuid="button", transfer_uuid="never", part_index=0, content=b"x")
    one.uploads("long.glb", bytes(PART + 9), size=PART)
    assert "long.glb: did not arrive as it was sent" in one.told()
    one.uploads("short.glb", b"glTF", size=9)
    assert "short.glb: did not arrive as it was sent" in one.told()
    assert not any(uploads.rglob("*.*")) and session.state is before
    assert not [row for row in other.seen if row["type"] == "NotificationShowMessage"]  # it is none of their business


def test_a_mesh_file_becomes_the_base_of_another_round(
    session: Session, server: StudioServer, tabs: tuple[Tab, Tab]
) -> None:
    one, other = tabs
    panel = server.view.panel
    small = panel.radii[0].max
    one.uploads("red box.glb", (ASSETS / "box.glb").read_bytes())
    assert one.told() == "red_box.glb is the base now; puts the region on its head; calls it 'a red box'"
    state = session.state
    assert (state.source.round, state.prompt, list(state.regions.poses)) == (2, "a red box", ["head"])
    assert np.ptp(state.scene.base[0].vertices, axis=0) == pytest.approx([2, 2, 2])
    other.until(lambda row: row["type"] == "GlbMessage" and row["name"] == "/base")
    assert panel.prompt.value == "a red box" and panel.region.value == "head"
    assert panel.radii[0].max == pytest.approx(0.6 * 2) and small < 1 and panel.radii[0].value == pytest.approx(0.3)
    kept = session.work.path / "uploads" / "001" / "red_box.glb"
    assert kept.read_bytes() == (ASSETS / "box.glb").read_bytes()
    session.set_prompt("a box with a hat")
    name = session.grow()
    assert (session.queue.runs[name].folder / "../../scene_2/run_001.xml").is_file()


def test_a_tab_that_goes_leaves_nothing_behind(session: Session, tabs: tuple[Tab, Tab]) -> None:
    one, _ = tabs
    one.uploads("half.glb", bytes(PART), size=3 * PART)
    common = {"source_component_uuid": "button", "transfer_uuid": "two", "mime_type": ""}
    one.send("FileTransferStartUpload", **common, filename="other.glb", part_count=9, size_bytes=9 * PART)
    uploads = session.work.path / "uploads"
    until(lambda: [path.name for path in uploads.rglob("*.glb")] == ["other.glb"])  # one file at a time
    one.socket.close()
    until(lambda: not any(uploads.rglob("*.glb")))
