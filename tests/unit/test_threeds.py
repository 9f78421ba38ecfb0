"""3DS files, put together here chunk by chunk as the format's descriptions have them."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import fd_mitsuba as fd
from fd_mitsuba.assets.asset import Asset
from fd_mitsuba.assets.images import pixels
from fd_mitsuba.assets.readers import read_asset
from fd_mitsuba.errors import UserError
from fd_mitsuba.io.srgb import linear_from_srgb
from fd_mitsuba.scene.load_scene import load_edit_scene

CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 2) for z in (0, 3)], dtype="<f4")
QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
FACES = np.array([face for a, b, c, d in QUADS for face in ((a, b, c), (a, c, d))], dtype="<u2")
UVS = CUBE[:, :2] * np.array([1.0, 0.25], dtype="<f4")  # v is 0 or a half, from below


def chunk(kind: int, *content: bytes) -> bytes:
    body = b"".join(content)
    return struct.pack("<HI", kind, 6 + len(body)) + body


def counted(table: np.ndarray) -> bytes:
    return struct.pack("<H", len(table)) + table.tobytes()


def text(words: str) -> bytes:
    return words.encode("cp1252") + b"\0"


def percent(value: int) -> bytes:
    return chunk(0x0030, struct.pack("<h", value))


def number(kind: int, value: float) -> bytes:
    return chunk(kind, struct.pack("<f", value))


def materials() -> bytes:
    tiles = chunk(
        0xA200,
        percent(100),
        chunk(0xA300, text("TILES.PNG")),
        chunk(0xA351, struct.pack("<H", 0x02)),
        *(number(kind, value) for kind, value in ((0xA354, 2.0), (0xA356, 4.0), (0xA358, 0.25), (0xA35A, 0.5))),
    )
    return b"".join(
        (
            chunk(0xAFFF, chunk(0xA000, text("Fliese")), chunk(0xA040, percent(25)), tiles, chunk(0xA230, percent(9))),
            chunk(
                0xAFFF,
                chunk(0xA000, text("Gl\xe4s")),
                chunk(0xA020, chunk(0x0011, bytes([255, 128, 0])), chunk(0x0012, bytes([9, 9, 9]))),
                chunk(0xA050, percent(40)),
                chunk(0xA081),
            ),
        )
    )


def box(faces: np.ndarray = FACES, groups: np.ndarray | None = None, *more: bytes, points: np.ndarray = CUBE) -> bytes:
    rows = np.concatenate([faces, np.full((len(faces), 1), 7, "<u2")], axis=1).astype("<u2")
    inner = [chunk(0x4130, text("Fliese"), counted(np.arange(10, dtype="<u2")))]
    inner += [chunk(0x4130, text("Gl\xe4s"), counted(np.arange(10, 12, dtype="<u2")))]
    inner += [] if groups is None else [chunk(0x4150, groups.astype("<u4").tobytes())]
    mesh = [chunk(0x4110, counted(points)), chunk(0x4140, counted(UVS)), chunk(0x4120, counted(rows), *inner), *more]
    return chunk(0x4000, text("Kiste"), chunk(0x4100, *mesh))


def write(path: Path, *editor: bytes) -> Path:
    lamp = chunk(0x4000, text("Lampe"), chunk(0x4600, struct.pack("<3f", 0, 0, 9)))
    path.write_bytes(chunk(0x4D4D, chunk(0x0002, b"\3\0\0\0"), chunk(0x3D3D, *editor, lamp), chunk(0xB000)))
    return path


@pytest.fixture
def tiles(tmp_path: Path) -> np.ndarray:
    values = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    Image.fromarray(values).save(tmp_path / "tiles.png")  # which MS-DOS would not tell from TILES.PNG
    return values


def corners(asset: Asset) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, normals and UVs (12, 3, .) at the corners of all faces, in the file's order."""
    found = []
    for mesh in asset.meshes:
        assert mesh.normals is not None
        found.append([table[mesh.faces] for table in (mesh.vertices, mesh.normals, mesh.uvs[0])])
    first, second, third = (np.concatenate(tables) for tables in zip(*found, strict=True))
    return first, second, third


def test_what_was_written_is_read(tmp_path: Path, tiles: np.ndarray) -> None:
    asset = read_asset(write(tmp_path / "box.3ds", materials(), box(groups=np.zeros(12))))
    points, normals, uvs = corners(asset)
    assert np.array_equal(points, CUBE[FACES]) and (asset.up, asset.unit) == ("+z", None)
    flat = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    assert np.allclose(normals, (flat / np.linalg.norm(flat, axis=1, keepdims=True))[:, None])  # faces of no group
    assert np.allclose(uvs, np.stack([UVS[:, 0], 1 - UVS[:, 1]], axis=1)[FACES])
    tile, glass = asset.materials
    assert [mesh.material for mesh in asset.meshes] == [0, 1] and glass.name == "Gl\xe4s"
    assert glass.base_color == pytest.approx(tuple(linear_from_srgb(np.array([255, 128, 0]) / 255)))
    assert (glass.opacity, glass.alpha_mode, glass.double_sided) == (0.6, "BLEND", True)
    assert tile.roughness == 0.75 and tile.base_texture is not None and tile.base_texture.wrap == "mirror"
    assert np.array_equal(pixels(tile.base_texture.image), tiles)
    # v upwards: (u, v) -> (2 u + .25, 4 v + .5); here v runs downwards before and after.
    assert tile.base_texture.to_uv @ [0.5, 0.75, 1] == pytest.approx([1.25, 1 - (4 * 0.25 + 0.5), 1])
    assert asset.notes == (
        "material 'Fliese': its bump map is left out",
        "has key frames, which are left out; it is taken as it stands",
    )


def test_faces_of_one_group_are_smooth_across_materials(tmp_path: Path, tiles: np.ndarray) -> None:
    groups = np.full(12, 1)
    groups[4:6] = 2  # the side at y = 0 for itself
    groups[10:] = 5  # the top is of another material, and of the first group and the third
    points, normals, _ = corners(read_asset(write(tmp_path / "box.3ds", materials(), box(groups=groups))))
    at = (points[:, :, 1] == 2) & (points[:, :, 2] == 3) & (points[:, :, 0] == 1)  # three sides meet, all smooth
    assert at.sum() >= 3 and np.ptp(normals[at], axis=0).max() < 1e-6 and (normals[at] > 0.1).all()
    assert np.allclose(normals[4:6], [0, -1, 0]) and (np.abs(normals[10:, :, 1]) < 0.95).all()


def test_a_mirrored_object_is_stored_unmirrored(tmp_path: Path, tiles: np.ndarray) -> None:
    axes = np.array([[-1, 0, 0], [0, 1, 0], [0, 0, 1], [5, 0, 0]], dtype="<f4")  # about x = 5
    points = CUBE + np.array([5, 0, 0], dtype="<f4")
    data = box(FACES, None, chunk(0x4160, axes.tobytes()), points=points)
    (mesh, _) = read_asset(write(tmp_path / "box.3ds", materials(), data)).meshes
    assert mesh.normals is None and mesh.vertices[:, 0].min() == 4 and mesh.vertices[:, 0].max() == 5


def test_it_becomes_a_scene_that_stands_upright(tmp_path: Path, tiles: np.ndarray, mi: object) -> None:
    path = write(tmp_path / "box.3ds", materials(), box())
    scene = load_edit_scene(fd.import_asset(path, tmp_path / "scene", prompt="a box with a hat").scene)
    extents = np.ptp(np.concatenate([mesh.vertices for mesh in scene.base]), axis=0)
    assert extents == pytest.approx([1, 3, 2], abs=1e-6) and {mesh.name for mesh in scene.base} == {"Fliese", "Gl\xe4s"}


BAD = FACES.copy()
BAD[3, 1] = 8
HOLED = CUBE.copy()
HOLED.view("<u4")[2, 1] = 0x7F800001  # a NaN that tells of itself when it is widened


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"", "empty|no 3DS"),
        (b"PK\3\4 not one", "is no 3DS"),
        (chunk(0x4D4D, chunk(0x3D3D, box()))[:-3], "is cut short or damaged"),
        (chunk(0x4D4D, chunk(0x3D3D, chunk(0x4000, b"endless"))), "is cut short or damaged"),
        (chunk(0x4D4D, chunk(0x3D3D, b"\x00\x40\x05\x00\x00\x00x")), "is cut short or damaged"),
        (chunk(0x4D4D, chunk(0x3D3D, chunk(0x4000, text("a"), chunk(0x4100, chunk(0x4110, b"\xff"))))), "cut short"),
        (chunk(0x4D4D, chunk(0x3D3D, chunk(0x4000, text("a"), chunk(0x4100, chunk(0x4110, b"\3\0a"))))), "cut short"),
        (chunk(0x4D4D, chunk(0x3D3D, box(BAD))), "'Kiste': face 3 names a vertex of 8 that is not there"),
        (chunk(0x4D4D, chunk(0x3D3D, box(FACES[:9]))), "material 'Fliese' is of a face that is not there"),
        (chunk(0x4D4D, chunk(0x3D3D, box(points=HOLED))), "'Kiste' has positions that are NaN or infinite"),
        (chunk(0x4D4D, chunk(0x3D3D)), "has no faces"),
    ],
)  # fmt: skip
def test_bad_files_are_refused_in_one_line(data: bytes, problem: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.3ds"
    path.write_bytes(data)
    with pytest.raises(UserError, match=problem) as found:
        read_asset(path)
    assert "\n" not in str(found.value) and "bad.3ds" in str(found.value)


def test_a_missing_image_is_told(tmp_path: Path) -> None:
    asset = read_asset(write(tmp_path / "box.3ds", materials(), box()))
    assert "material 'Fliese': its image 'TILES.PNG' is not beside the file and is left out" in asset.notes
