"""Faults in files of other programs, which `import` reads: bytes, values of glTF, archives."""

from __future__ import annotations

import io
import struct
import warnings
import zipfile
from pathlib import Path
from random import Random

import numpy as np
from fuzz.json_values import changed
from fuzz.mutators import SPECIALS, spoiled

SEEDS = Path(__file__).resolve().parents[1] / "data" / "assets"
_ENTRIES = (
    "../out.obj", "/etc/out.obj", "a/../../b.glb", "C:\\x.obj", "con", "x" * 300 + ".obj", "box.obj/", ".",
    "é\u202e.glb", "nested.zip", "scene.xml",
)  # fmt: skip


def assets(rng: Random, folder: Path) -> list[str]:
    """A spoiled asset, with all the others beside it, and a command that reads it."""
    place = folder / "assets"
    place.mkdir()
    for path in SEEDS.iterdir():
        (place / path.name).write_bytes(path.read_bytes())
    path = rng.choice([_bytes, _bytes, _gltf, _gltf, _archive])(rng, place)
    if rng.random() < 0.2:
        return ["check", str(path), "--at", "top", "--prompt", "a horse with a hat"]
    options = [["--up", "z"], ["--units", "mm"], ["--at", "head"], ["--prompt", "a cat with a crown"], []]
    return ["import", str(path), "-o", str(folder / "imported"), *rng.choice(options)]


def _meshes(place: Path, *suffixes: str) -> list[Path]:
    return sorted(path for path in place.iterdir() if path.suffix in suffixes)


def _bytes(rng: Random, place: Path) -> Path:
    files = _meshes(place, ".3ds", ".dae", ".glb", ".gltf", ".obj", ".off", ".ply", ".stl")
    path = rng.choice(files)
    beside = {".obj": ".mtl", ".gltf": ".bin"}.get(path.suffix, "")
    others = _meshes(place, beside, ".png") if beside else []
    target = rng.choice(others) if others and rng.random() < 0.4 else path
    target.write_bytes(spoiled(rng, target.read_bytes()))
    return path


def _gltf(rng: Random, place: Path) -> Path:
    """Sound containers: values of the JSON are others, or numbers of the buffer are, or lengths do not fit."""
    path = rng.choice(_meshes(place, ".glb", ".gltf"))
    if path.suffix == ".gltf":
        path.write_text(_changed(rng, path.read_text()), errors="surrogatepass")
        return path
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    text, buffer = data[20 : 20 + length].decode(), bytearray(data[28 + length :])
    if rng.random() < 0.7:
        text = _changed(rng, text)
    if rng.random() < 0.5:
        at = rng.randrange(len(buffer) // 4) * 4
        struct.pack_into("<f", buffer, at, np.float32(rng.choice(SPECIALS)))
    content = text.encode("utf-8", "surrogatepass")
    content += b" " * (-len(content) % 4)
    chunks = struct.pack("<II", len(content), 0x4E4F534A) + content
    chunks += struct.pack("<II", len(buffer), 0x004E4942) + bytes(buffer)
    if rng.random() < 0.1:
        chunks = spoiled(rng, chunks)
    path.write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks)
    return path


def _changed(rng: Random, text: str) -> str:
    for _ in range(rng.randint(1, 3)):
        text = changed(rng, text)
    return text


def _archive(rng: Random, place: Path) -> Path:
    """A ZIP of one asset and what it names, with odd names, entries without sense, or faults in its bytes."""
    chosen = rng.choice([["box.obj", "box materials.mtl", "box_picture.png"], ["apart.gltf", "apart.bin"], ["box.glb"]])
    memory = io.BytesIO()
    method = rng.choice([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
    with warnings.catch_warnings(action="ignore"), zipfile.ZipFile(memory, "w", method) as archive:
        for name in chosen:
            kept = rng.choice([name, name, name, f"deep/{name}", name.upper(), rng.choice(_ENTRIES)])
            archive.writestr(kept, (place / name).read_bytes())
        for _ in range(rng.randint(0, 2)):
            entry = zipfile.ZipInfo(rng.choice([*_ENTRIES, *chosen, "second.obj"]))
            if rng.random() < 0.3:
                entry.external_attr = 0o120777 << 16  # a symbolic link
            archive.writestr(entry, rng.choice([b"", b"../..", bytes(100_000), (place / "box.obj").read_bytes()]))
    data = memory.getvalue()
    path = place / "asset.zip"
    path.write_bytes(spoiled(rng, data) if rng.random() < 0.7 else data)
    return path
