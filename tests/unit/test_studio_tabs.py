"""The page's server as its tabs see it, over their own protocol: two at once, files that they send, files to refuse."""

from __future__ import annotations

import base64
import io
import json
import re
import struct
import sys
import time
import zipfile
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
PART = 1 << 20


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


class Frame:
    """The script of the page's frame for files: what is sent, and what comes back."""

    def __init__(self, port: int, **files: int) -> None:
        self.socket = connect(f"ws://127.0.0.1:{port}/upload", compression=None)
        self.socket.send(json.dumps({"files": [{"name": name, "size": size} for name, size in files.items()]}))

    def answer(self) -> dict[str, Any]:
        return json.loads(self.socket.recv(timeout=60))

    def sends(self, data: bytes) -> int:
        """The bytes that have arrived with these."""
        self.socket.send(data)
        return self.answer()["received"]


def sent(server: StudioServer, files: dict[str, bytes]) -> dict[str, Any]:
    """What the page says in the end when files are sent to it."""
    frame = Frame(server.server.get_port(), **{name: len(data) for name, data in files.items()})
    answer = frame.answer()
    if "problem" in answer:
        return answer
    arrived = 0
    for data in files.values():
        for at in range(0, len(data), PART):
            assert answer == {"received": arrived}
            frame.socket.send(data[at : at + PART])
            answer = frame.answer()
            arrived += len(data[at : at + PART])
    return frame.answer()


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


def zipped(files: dict[str, bytes]) -> bytes:
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return memory.getvalue()


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


def test_files_that_must_not_be_opened_are_refused_in_a_line(session: Session, server: StudioServer) -> None:
    uploads, before, box = session.work.path / "uploads", session.state, (ASSETS / "box.glb").read_bytes()
    stray = {"model.glb": image_of("../../secret.png"), "secret.png": b"mine"}
    bomb = bytearray(zipped({"a.obj": bytes(99)}))
    struct.pack_into("<I", bomb, bomb.rfind(b"PK\1\2") + 24, 3 << 30)
    cases: list[tuple[dict[str, bytes], str]] = [
        (stray, "model.glb: names '../../secret.png', which lies outside its folder"),
        ({"../../model.glb": image_of("file:///etc/passwd")}, "model.glb: .*lies outside its folder"),
        ({"model.glb": image_of(png_bomb())}, "model.glb: .*has 100000 x 100000 pixels, more than 134 million; shrink"),
        ({"model.glb": b"glTF" + bytes(40)}, "model.glb: is a GLB of version 0"),
        ({"model.glb": b""}, "model.glb: is empty"),
        ({"thesis.tex": b"words"}, "thesis.tex: .tex is not read"),
        ({}, "no file was chosen"),
        ({"a.mtl": b"", "b.png": b""}, "what was sent holds no mesh"),
        ({"a.glb": box, "b.obj": b""}, "what was sent holds 2 meshes"),
        ({"a/x.glb": box, "b/X.GLB": box}, "x.glb: two of the files have one name; send a ZIP of their folder"),
        ({"a.zip": b"PK", "b.obj": b""}, "a.zip: is one of 2 files; send it alone"),
        ({"bomb.zip": bytes(bomb)}, "bomb.zip: holds 3072 MB when unpacked, more than 1024"),
    ]
    for files, problem in cases:
        told = sent(server, files)["problem"]
        assert re.match(problem, told) and "\n" not in told and str(session.work.path) not in told
    assert not any(uploads.rglob("*")) and session.state is before


def test_too_much_is_refused_before_it_is_sent(session: Session, server: StudioServer, tabs: tuple[Tab, Tab]) -> None:
    port = server.server.get_port()
    frame = Frame(port, **{"huge.glb": 300 << 20})
    assert frame.answer() == {
        "problem": "huge.glb: has 300 MB, more than 256; reduce it, or give its path to fd_mitsuba studio"
    }
    frame = Frame(port, **{"a.png": 200 << 20, "a.obj": 100 << 20})
    assert "a.obj: has, with 1 more, 300 MB" in frame.answer()["problem"]
    frame = Frame(port, **{f"{number}.png": 1 for number in range(1001)})
    assert "1001 files are more than 1000" in frame.answer()["problem"]
    frame = Frame(port, **{"model.glb": 9})
    assert frame.answer() == {"received": 0}
    assert not (server.server.gui._current_file_upload_states)
    frame.socket.send(b"ten bytes.")
    assert frame.answer() == {"problem": "model.glb: did not arrive as it was announced; try again"}
    frame = Frame(port, **{"model.glb": 4 * PART})
    assert frame.answer() == {"received": 0}
    frame.socket.send(bytes(PART + 1))
    assert "did not arrive" in frame.answer()["problem"]
    for nonsense in ("", "[]", '{"files": 3}', '{"files": [{"name": "a.glb"}]}', "[" * 100_000):
        frame = Frame.__new__(Frame)
        frame.socket = connect(f"ws://127.0.0.1:{port}/upload", compression=None)
        frame.socket.send(nonsense)
        assert frame.answer() == {"problem": "the page did not say what it sends; load it again"}
    assert not any((session.work.path / "uploads").rglob("*"))
    one, _ = tabs  # viser's own way is closed: it would gather any size in memory
    common = {"source_component_uuid": "button", "transfer_uuid": "one"}
    one.send("FileTransferStartUpload", **common, filename="a.glb", mime_type="", part_count=2, size_bytes=300 << 20)
    one.send("FileTransferPart", **common, part_index=0, content=b"glTF")
    one.types(server.view.panel.prompt, "a pig with a horn")
    until(lambda: session.state.prompt == "a pig with a horn")
    assert not server.server.gui._current_file_upload_states


def test_a_tab_can_be_used_while_it_sends(session: Session, server: StudioServer, tabs: tuple[Tab, Tab]) -> None:
    one, _ = tabs
    frame = Frame(server.server.get_port(), **{"model.glb": 200 << 20})
    assert frame.answer() == {"received": 0} and frame.sends(bytes(PART)) == PART
    one.types(server.view.panel.prompt, "a pig with a horn")
    until(lambda: session.state.prompt == "a pig with a horn")
    assert frame.sends(bytes(9)) == PART + 9
    frame.socket.close()


def test_a_mesh_file_becomes_the_base_of_another_round(
    session: Session, server: StudioServer, tabs: tuple[Tab, Tab]
) -> None:
    _, other = tabs
    panel = server.view.panel
    small = panel.radii[0].max
    said = sent(server, {"red box.glb": (ASSETS / "box.glb").read_bytes()})
    assert said == {"opened": "red box.glb is the base now; puts the region on its head; calls it 'a red box'"}
    state = session.state
    assert (state.source.round, state.prompt, list(state.regions.poses)) == (2, "a red box", ["head"])
    assert np.ptp(state.scene.base[0].vertices, axis=0) == pytest.approx([2, 2, 2])
    other.until(lambda row: row["type"] == "GlbMessage" and row["name"] == "/base")
    assert "write what to add, as in 'a red box with a hat'" in str(session.checks.now().refusal)
    assert panel.prompt.value == "a red box" and panel.region.value == "head"
    assert panel.radii[0].max == pytest.approx(0.6 * 2) and small < 1 and panel.radii[0].value == pytest.approx(0.3)
    kept = session.work.path / "uploads" / "001" / "red box.glb"
    assert kept.read_bytes() == (ASSETS / "box.glb").read_bytes()
    session.edits.set_prompt("a box with a hat")
    name = session.grow()
    assert (session.queue.runs[name].folder / "../../scene_2/run_001.xml").is_file()


@pytest.mark.parametrize("as_zip", [False, True])
def test_an_obj_comes_with_its_materials_and_images(as_zip: bool, session: Session, server: StudioServer) -> None:
    names = ("box_picture.png", "box materials.mtl", "box.obj")
    files = {name: (ASSETS / name).read_bytes() for name in names}
    if as_zip:
        files = {"box.zip": zipped({f"box/{name}": data for name, data in files.items()})}
    told = sent(server, files)["opened"]
    assert told.startswith(f"{'box.zip' if as_zip else 'box.obj'} is the base now; ") and "material file" not in told
    textures = [path.read_bytes() for path in session.state.source.copy.parent.rglob("*.png")]
    assert (ASSETS / "box_picture.png").read_bytes() in textures


def test_an_obj_alone_says_what_is_missing(session: Session, server: StudioServer) -> None:
    told = sent(server, {"box.obj": (ASSETS / "box.obj").read_bytes()})["opened"]
    assert "its material file 'box materials.mtl' not found, so that the mesh is grey" in told and "\n" not in told
    files = {name: (ASSETS / name).read_bytes() for name in ("box.obj", "box materials.mtl")}
    assert re.search(
        r"its image 'C:.*box_picture.png' is not beside the OBJ and is left out", sent(server, files)["opened"]
    )


def test_a_tab_that_goes_leaves_nothing_behind(session: Session, server: StudioServer) -> None:
    frame = Frame(server.server.get_port(), **{"half.glb": 3 * PART})
    assert frame.answer() == {"received": 0} and frame.sends(bytes(PART)) == PART
    uploads = session.work.path / "uploads"
    assert [path.stat().st_size for path in uploads.rglob("*.glb")] == [PART]
    frame.socket.close()
    until(lambda: not any(uploads.rglob("*")))
