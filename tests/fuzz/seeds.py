"""The sound inputs that the fuzzer starts from: small, and with as many kinds of element and file as fit into one."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
from PIL import Image

from fd_mitsuba.scene.tessellate import unit_sphere

SCENE = """<?xml version="1.0" encoding="utf-8"?>
<!-- every kind of element -->
<scene version="3.0.0">
  <default name="words" value="a pig with two wings"/>
  <default name="size" value="0.4"/>
  <path value="more"/>
  <integrator type="dual_path">
    <string name="prompt" value="$words"/>
    <string name="base_prompt" value="a pig"/>
  </integrator>
  <emitter type="envmap" id="sky"><string name="filename" value="sky.exr"/><float name="scale" value="1.5"/>
    <transform name="to_world"><rotate x="0" y="1" z="0" angle="30"/></transform></emitter>
  <emitter type="point" id="spark"><point name="position" x="0" y="3" z="1"/>
    <rgb name="intensity" value="2, 2, 2"/></emitter>
  <shape type="ply" id="lamp"><string name="filename" value="lamp.ply"/>
    <transform name="to_world"><scale value="0.1"/><translate x="3" y="3"/></transform>
    <emitter type="area"><spectrum name="radiance" filename="lamp.spd"/></emitter></shape>
  <bsdf type="twosided" id="paint"><bsdf type="principled">
    <texture type="bitmap" name="base_color"><string name="filename" value="paint.png"/>
      <transform name="to_uv"><scale x="2" y="1"/></transform></texture>
    <float name="roughness" value="0.35"/></bsdf></bsdf>
  <shape type="ply" id="body"><string name="filename" value="body.ply"/><ref id="paint"/>
    <transform name="to_world"><scale x="1" y="0.9" z="1.2"/><rotate y="1" angle="20"/></transform></shape>
  <shape type="obj" id="head"><string name="filename" value="head.obj"/><bsdf type="roughplastic">
    <rgb name="diffuse_reflectance" value="0.8, 0.3, 0.2"/><float name="alpha" value="0.2"/></bsdf>
    <transform name="to_world"><translate x="0" y="0.3" z="1.3"/></transform></shape>
  <include filename="part.xml"/>
  <shape type="focal_region" id="wing"><transform name="to_world">
    <scale value="$size"/><translate x="0" y="0.9" z="0"/></transform></shape>
</scene>
"""
PART = """<scene version="3.0.0">
  <bsdf type="principled" id="part"><rgb name="base_color" value="0.5"/><float name="metallic" value="0.1"/></bsdf>
  <bsdf type="blendbsdf" id="unused"><float name="weight" value="0.5"/>
    <bsdf type="diffuse"><texture type="bitmap" name="reflectance">
      <string name="filename" value="paint.jpg"/></texture></bsdf>
    <bsdf type="roughconductor"><string name="material" value="Au"/></bsdf></bsdf>
  <sensor type="perspective" id="eye"><float name="fov" value="40"/>
    <transform name="to_world"><lookat origin="0, 1, 5" target="0, 0, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="32"/></film></sensor>
</scene>
"""
SETTINGS = """seed = 3
[geometry]
steps = 4
grid_resolution = 24
views = 4
betas = [0.9, 0.99]
[guidance]
timestep_range_coarse = [0.2, 0.9]
[appearance]
steps = 4
normal_map = true
[output]
texture_size = 64
"""


def sphere_arrays(subdivisions: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, UVs and faces of a small ball."""
    vertices, faces = unit_sphere(subdivisions)
    uv = np.stack([0.5 + np.arctan2(vertices[:, 0], vertices[:, 2]) / 7, 0.5 - vertices[:, 1] / 2.5], axis=1)
    return np.array(vertices), uv, np.array(faces)


def ply_bytes(vertices: np.ndarray, uv: np.ndarray, faces: np.ndarray, binary: bool) -> bytes:
    """A PLY with UVs; nothing is checked."""
    kind = "binary_little_endian" if binary else "ascii"
    lines = ["ply", f"format {kind} 1.0", f"element vertex {len(vertices)}", *(f"property float {n}" for n in "xyzst")]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    rows = np.concatenate([vertices, uv], axis=1)
    if binary:
        body = rows.astype("<f4").tobytes()
        body += b"".join(struct.pack("<B", 3) + np.asarray(face).astype("<i4").tobytes() for face in faces)
        return "\n".join(lines).encode() + body
    text = [" ".join(f"{value:.7g}" for value in row) for row in rows]
    text += ["3 " + " ".join(str(int(index)) for index in face) for face in faces]
    return ("\n".join([*lines[:-1], *text]) + "\n").encode()


def obj_bytes(vertices: np.ndarray, uv: np.ndarray, faces: np.ndarray) -> bytes:
    """An OBJ with UVs and normals; nothing is checked."""
    lines = ["# ball", "o ball", *("v " + " ".join(f"{v:.7g}" for v in row) for row in vertices)]
    lines += ["vt " + " ".join(f"{v:.7g}" for v in row) for row in uv]
    lines += ["vn " + " ".join(f"{v:.7g}" for v in row) for row in vertices]
    lines += ["f " + " ".join(f"{int(i) + 1}/{int(i) + 1}/{int(i) + 1}" for i in face) for face in faces]
    return ("\n".join(lines) + "\n").encode()


def serialized_bytes(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """A mesh in Mitsuba's own compressed format."""
    body = struct.pack("<I", 0x1000) + b"ball\0" + struct.pack("<QQ", len(vertices), len(faces))
    body += vertices.astype("<f4").tobytes() + faces.astype("<u4").tobytes()
    return struct.pack("<HH", 0x041C, 4) + zlib.compress(body) + struct.pack("<QI", 0, 1)


def write_seeds(folder: Path, exr: bytes) -> Path:
    """Write the scene, all that it reads, and `settings.toml`; returns the scene.

    Args:
        exr: a small picture in that format.
    """
    folder.mkdir(parents=True, exist_ok=True)
    vertices, uv, faces = sphere_arrays()
    (folder / "more").mkdir(exist_ok=True)
    (folder / "body.ply").write_bytes(ply_bytes(vertices, uv, faces, binary=True))
    (folder / "more" / "lamp.ply").write_bytes(ply_bytes(vertices, uv, faces, binary=False))
    (folder / "head.obj").write_bytes(obj_bytes(vertices * 0.3, uv, faces))
    (folder / "head.serialized").write_bytes(serialized_bytes(vertices * 0.3, faces))
    (folder / "lamp.spd").write_text("# lamp\n400 1.0\n500 2.0\n600 1.5\n700 1.0\n")
    (folder / "sky.exr").write_bytes(exr)
    pixels = np.random.default_rng(0).integers(0, 255, (8, 8, 3), dtype=np.uint8)
    for suffix in ("png", "jpg"):
        Image.fromarray(pixels).save(folder / f"paint.{suffix}")
    (folder / "part.xml").write_text(PART)
    (folder / "settings.toml").write_text(SETTINGS)
    scene = folder / "scene.xml"
    scene.write_text(SCENE)
    return scene


def small_exr() -> bytes:
    """An uncompressed EXR of 8 x 4 half-float pixels, written by hand so that no library is started."""

    def attribute(name: bytes, kind: bytes, value: bytes) -> bytes:
        return name + b"\0" + kind + b"\0" + struct.pack("<i", len(value)) + value

    width, height = 8, 4
    channels = b"".join(name + b"\0" + struct.pack("<iiii", 1, 0, 1, 1) for name in (b"B", b"G", b"R")) + b"\0"
    box = struct.pack("<iiii", 0, 0, width - 1, height - 1)
    fields = attribute(b"channels", b"chlist", channels) + attribute(b"compression", b"compression", b"\0")
    fields += attribute(b"dataWindow", b"box2i", box) + attribute(b"displayWindow", b"box2i", box)
    fields += attribute(b"lineOrder", b"lineOrder", b"\0") + attribute(
        b"pixelAspectRatio", b"float", struct.pack("<f", 1)
    )
    fields += attribute(b"screenWindowCenter", b"v2f", bytes(8)) + attribute(
        b"screenWindowWidth", b"float", struct.pack("<f", 1)
    )
    head = b"\x76\x2f\x31\x01\x02\0\0\0" + fields + b"\0"
    line = np.full(width * 3, 0.7, "<f2").tobytes()
    start = len(head) + 8 * height
    table = b"".join(struct.pack("<Q", start + row * (8 + len(line))) for row in range(height))
    return head + table + b"".join(struct.pack("<ii", row, len(line)) + line for row in range(height))
