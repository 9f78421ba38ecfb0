"""A ZIP of a mesh and its textures: read as what it holds, and refused where it would fill the disk or leave it."""

from __future__ import annotations

import io
import stat
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

import fd_mitsuba as fd
from fd_mitsuba.assets import archive
from fd_mitsuba.assets.readers import read_asset
from fd_mitsuba.errors import UserError

ASSETS = Path(__file__).parents[1] / "data" / "assets"
OBJ = ("box.obj", "box materials.mtl", "box_picture.png")


def packed(files: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w", method) as made:
        for name, data in files.items():
            made.writestr(name, data)
    return memory.getvalue()


def files_of(*names: str) -> dict[str, bytes]:
    return {name: (ASSETS / name).read_bytes() for name in names}


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_zip_is_what_it_holds(method: int, tmp_path: Path) -> None:
    files = {f"model/{name}": data for name, data in files_of(*OBJ).items()}
    (tmp_path / "box.zip").write_bytes(packed({"__MACOSX/model/._box.obj": b"\0", **files}, method))
    found, expected = read_asset(tmp_path / "box.zip"), read_asset(ASSETS / "box.obj")
    assert found.packed == "model/box.obj" and found.notes == expected.notes
    for one, other in zip(found.meshes, expected.meshes, strict=True):
        assert np.array_equal(one.vertices, other.vertices) and np.array_equal(one.uvs[0], other.uvs[0])
    images = [material.base_texture.image.data for material in found.materials if material.base_texture]
    assert images == [(ASSETS / "box_picture.png").read_bytes()]


def test_a_zip_is_imported_under_its_own_name_with_the_customs_of_its_mesh(tmp_path: Path) -> None:
    (tmp_path / "rubber duck.zip").write_bytes(packed(files_of("duck.stl")))
    made = fd.import_asset(tmp_path / "rubber duck.zip", tmp_path / "out")
    plain = fd.import_asset(ASSETS / "duck.stl", tmp_path / "plain")
    assert [line for line in made.remarks if "up" in line] == [line for line in plain.remarks if "up" in line]
    assert any("'a rubber duck'" in line for line in made.remarks)


def test_files_without_their_folders_are_found(tmp_path: Path) -> None:
    """A browser sends `textures/wood.png` as `wood.png`."""
    mtl = (ASSETS / "box materials.mtl").read_bytes().replace(b"box_picture.png", b"textures/box_picture.png")
    obj = (ASSETS / "box.obj").read_bytes().replace(b"mtllib ", b"mtllib materials/")
    for name, data in {**files_of(*OBJ), "box materials.mtl": mtl, "box.obj": obj}.items():
        (tmp_path / name).write_bytes(data)
    found = read_asset(tmp_path / "box.obj")
    assert found.notes == read_asset(ASSETS / "box.obj").notes and found.materials[0].base_texture is not None
    gltf = (ASSETS / "apart.gltf").read_text()
    for name in ("apart picture.png", "apart.bin"):
        (tmp_path / name).write_bytes((ASSETS / name).read_bytes())
    moved = gltf.replace('"apart.bin"', '"data/apart.bin"').replace(
        '"apart%20picture.png"', '"data/apart%20picture.png"'
    )
    assert moved.count("data/apart") == 2
    (tmp_path / "apart.gltf").write_text(moved)
    assert read_asset(tmp_path / "apart.gltf").materials


def link() -> bytes:
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w") as made:
        entry = zipfile.ZipInfo("box.obj")
        entry.create_system, entry.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
        made.writestr(entry, "/etc/passwd")
    return memory.getvalue()


def announcing(size: int) -> bytes:
    """A ZIP whose list says that its file has so many bytes."""
    data = bytearray(packed({"box.glb": bytes(1000)}))
    struct.pack_into("<I", data, data.rfind(b"PK\1\2") + 24, size)
    return bytes(data)


def encrypted() -> bytes:
    data = bytearray(packed({"box.glb": b"glTF"}))
    data[data.rfind(b"PK\1\2") + 8] |= 1
    return bytes(data)


BOX = (ASSETS / "box.glb").read_bytes()
REFUSED = {
    "no ZIP": (b"hello", "is no ZIP"),
    "empty": (b"", "is empty"),
    "cut short": (packed({"box.glb": BOX})[:-40], "is no ZIP|cannot be unpacked"),
    "nothing in it": (packed({}), "holds no mesh"),
    "no mesh": (packed({"readme.txt": b"hello"}), "holds no mesh .*GLB"),
    "a ZIP in it": (packed({"more.zip": packed({"box.glb": BOX})}), "holds no mesh"),
    "two meshes": (packed({"a.glb": BOX, "b/c.obj": b""}), r"holds 2 meshes \(a.glb, b/c.obj\); give one"),
    "a name that leads out": (packed({"../box.glb": BOX}), "'../box.glb', which leads out"),
    "a full name": (packed({"/tmp/box.glb": BOX}), "leads out"),
    "a drive": (packed({"c:/box.glb": BOX}), "leads out"),
    "a link": (link(), "leads out"),
    "the same name twice": (packed({"box.glb": BOX, "BOX.glb.txt": b"", "box.GLB.TXT": b""}), "twice"),
    "gigabytes": (announcing(3 << 30), "holds 3072 MB when unpacked, more than 1024"),
    "more than announced": (announcing(10), "cannot be unpacked"),
    "encrypted": (encrypted(), "is encrypted"),
    "many files": (packed({"box.glb": BOX, **{f"{n}.txt": b"" for n in range(1001)}}), "holds 1002 files, more than"),
    "a mesh with a fault": (packed({"in/bad.glb": b"glTF"}), "in/bad.glb in it "),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_zip_that_is_not_bearable_is_refused_in_one_line(case: str, tmp_path: Path) -> None:
    data, words = REFUSED[case]
    (tmp_path / "a.zip").write_bytes(data)
    with pytest.raises(UserError, match=f"a.zip: .*({words})") as refused:
        fd.import_asset(tmp_path / "a.zip", tmp_path / "out")
    assert "\n" not in str(refused.value) and sorted(tmp_path.iterdir()) == [tmp_path / "a.zip"]


def test_a_list_of_millions_of_files_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.zip").write_bytes(packed({"box.glb": BOX, "b.txt": b""}))
    monkeypatch.setattr(archive, "_MOST_DIRECTORY", 100)
    monkeypatch.setattr(zipfile, "ZipFile", None)
    with pytest.raises(UserError, match="lists more than 1000 files"):
        read_asset(tmp_path / "a.zip")
