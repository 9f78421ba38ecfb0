"""Makes tests/data/assets: small files in every format that is imported, each with what importers tend to get wrong.

    .venv/bin/python tools/make_test_assets.py

Everything is written by hand, with NumPy and Pillow alone, so that no reader is tested by the writer of its own
library. The object of most files is a box from -1 to 1 whose sides all show the picture `corners`, seen from outside
the right way up: red top left, green top right, blue bottom left, yellow bottom right.
"""

from __future__ import annotations

import base64
import io
import json
import math
import struct
from pathlib import Path

import numpy as np
from PIL import Image

FOLDER = Path(__file__).parents[1] / "tests" / "data" / "assets"
RED, GREEN, BLUE, YELLOW = (220, 40, 30), (40, 180, 60), (40, 70, 210), (240, 210, 50)
SIDES = [  # outward axis, the axis to the right seen from outside, the axis up
    ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
    ((0, 0, -1), (-1, 0, 0), (0, 1, 0)),
    ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    ((-1, 0, 0), (0, 0, 1), (0, 1, 0)),
    ((0, 1, 0), (1, 0, 0), (0, 0, -1)),
    ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
]
CORNERS = ((-1, 1), (-1, -1), (1, -1), (1, 1))  # top left, then counter-clockwise
UV_TOP = np.array([(0, 0), (0, 1), (1, 1), (1, 0)], dtype=np.float32)  # origin top left


def box_quads() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners (24, 3), normals (24, 3), UVs with the origin top left (24, 2); four corners a side."""
    points = [np.array(n) + x * np.array(r) + y * np.array(u) for n, r, u in SIDES for x, y in CORNERS]
    normals = np.repeat(np.array([side[0] for side in SIDES]), 4, axis=0)
    return np.array(points, np.float32), normals.astype(np.float32), np.tile(UV_TOP, (6, 1))


def box_triangles() -> np.ndarray:
    first = 4 * np.arange(6)[:, None]
    return np.concatenate([first + [0, 1, 2], first + [0, 2, 3]], axis=1).reshape(-1, 3)


def ball(radii: tuple[float, float, float], centre: tuple[float, float, float], count: int = 12):
    """Positions and triangles of a closed ellipsoid."""
    rows = [(0.0, 1.0, 0.0)]
    for i in range(1, count):
        polar = math.pi * i / count
        for j in range(2 * count):
            around = math.pi * j / count
            rows.append((math.sin(polar) * math.sin(around), math.cos(polar), math.sin(polar) * math.cos(around)))
    rows.append((0.0, -1.0, 0.0))
    faces, ring, last = [], 2 * count, len(rows) - 1
    for j in range(ring):
        k = (j + 1) % ring
        faces.append((0, 1 + j, 1 + k))
        for i in range(count - 2):
            a, b = 1 + i * ring + j, 1 + i * ring + k
            faces += [(a, a + ring, b + ring), (a, b + ring, b)]
        faces.append((1 + (count - 2) * ring + j, last, 1 + (count - 2) * ring + k))
    return (np.array(rows) * radii + centre).astype(np.float32), np.array(faces)


def corners_picture(mode: str = "RGB", size: int = 2) -> Image.Image:
    """The picture of four colours; with RGBA, its lower left quarter cannot be seen."""
    rows = np.array([[RED, GREEN], [BLUE, YELLOW]], np.uint8).repeat(size // 2, 0).repeat(size // 2, 1)
    if mode == "RGBA":
        alpha = np.full((size, size, 1), 255, np.uint8)
        alpha[size // 2 :, : size // 2] = 20
        rows = np.concatenate([rows, alpha], axis=2)
    return Image.fromarray(rows)


def encoded(image: Image.Image, form: str = "PNG", **options) -> bytes:
    stream = io.BytesIO()
    image.save(stream, format=form, **options)
    return stream.getvalue()


class Gltf:
    """Collects what a glTF needs."""

    def __init__(self) -> None:
        self.blob = bytearray()
        self.json: dict = {"asset": {"version": "2.0", "generator": "tools/make_test_assets.py"}}

    def add(self, key: str, item: dict) -> int:
        self.json.setdefault(key, []).append(item)
        return len(self.json[key]) - 1

    def view(self, data: bytes, **more) -> int:
        self.blob += b"\0" * (-len(self.blob) % 4)
        view = {"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(data), **more}
        self.blob += data
        return self.add("bufferViews", view)

    def accessor(self, values: np.ndarray, kind: str = "<f4", **more) -> int:
        array = np.ascontiguousarray(values, kind)
        width = 1 if array.ndim == 1 else array.shape[1]
        component = {"<f4": 5126, "<u2": 5123, "<u1": 5121}[kind]
        shape = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}[width]
        found = {"componentType": component, "count": len(array), "type": shape, **more}
        return self.add("accessors", {"bufferView": self.view(array.tobytes()), **found})

    def mesh(self, vertices, faces, normals=None, uv=None, material=None, **attributes) -> int:
        low, high = vertices.min(axis=0).tolist(), vertices.max(axis=0).tolist()
        found = {"POSITION": self.accessor(vertices, min=low, max=high), **attributes}
        if normals is not None:
            found["NORMAL"] = self.accessor(normals)
        if uv is not None:
            found["TEXCOORD_0"] = self.accessor(uv)
        primitive = {"attributes": found, "indices": self.accessor(np.ravel(faces), "<u2")}
        if material is not None:
            primitive["material"] = material
        return self.add("meshes", {"primitives": [primitive]})

    def texture(self, data: bytes, mime: str = "image/png", sampler: dict | None = None, name: str = "") -> int:
        image = {"bufferView": self.view(data), "mimeType": mime, **({"name": name} if name else {})}
        found = {"source": self.add("images", image)}
        if sampler is not None:
            found["sampler"] = self.add("samplers", sampler)
        return self.add("textures", found)

    def scene(self, *roots: int) -> None:
        self.json["scenes"], self.json["scene"] = [{"nodes": list(roots)}], 0

    def glb(self) -> bytes:
        self.json["buffers"] = [{"byteLength": len(self.blob)}]
        text = json.dumps(self.json).encode()
        text += b" " * (-len(text) % 4)
        blob = bytes(self.blob) + b"\0" * (-len(self.blob) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(blob), 0x004E4942) + blob
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def box_glb() -> bytes:
    """One material with a texture, smooth edges off, nearest filter."""
    file = Gltf()
    vertices, normals, uv = box_quads()
    texture = file.texture(encoded(corners_picture()), sampler={"magFilter": 9728, "minFilter": 9728}, name="../evil")
    surface = {"baseColorTexture": {"index": texture}, "metallicFactor": 0.0, "roughnessFactor": 0.4}
    material = file.add("materials", {"name": "paint", "pbrMetallicRoughness": surface})
    file.scene(file.add("nodes", {"name": "box", "mesh": file.mesh(vertices, box_triangles(), normals, uv, material)}))
    return file.glb()


def transformed_uv_glb() -> bytes:
    """KHR_texture_transform turns, scales and moves the UVs back to what they are in `box_glb`."""
    file = Gltf()
    vertices, normals, uv = box_quads()
    angle, scale, offset = 0.5 * math.pi, np.array([0.5, 2.0]), np.array([0.25, 0.75])
    turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    stored = ((uv - offset) @ turn) / scale  # the inverse of offset + turn (scale uv), turn being orthogonal
    sampler = {"magFilter": 9728, "wrapS": 33071, "wrapT": 33071}
    transform = {"offset": offset.tolist(), "rotation": angle, "scale": scale.tolist()}
    info = {
        "index": file.texture(encoded(corners_picture()), sampler=sampler),
        "extensions": {"KHR_texture_transform": transform},
    }
    surface = {"baseColorTexture": info, "metallicFactor": 0.0}
    material = file.add("materials", {"name": "paint", "pbrMetallicRoughness": surface})
    file.json["extensionsUsed"] = file.json["extensionsRequired"] = ["KHR_texture_transform"]
    mesh = file.mesh(vertices, box_triangles(), normals, stored.astype(np.float32), material)
    file.scene(file.add("nodes", {"mesh": mesh}))
    return file.glb()


def figure_glb() -> bytes:
    """Nodes within nodes, turned, scaled and mirrored; two materials of factors alone, one of them on three meshes."""
    file = Gltf()
    surface = {"baseColorFactor": [0.8, 0.1, 0.05, 1], "metallicFactor": 0, "roughnessFactor": 0.3}
    red = file.add("materials", {"name": "red", "pbrMetallicRoughness": surface})
    gold = {"baseColorFactor": [1.0, 0.75, 0.3, 1], "metallicFactor": 1.0, "roughnessFactor": 0.25}
    golden = file.add("materials", {"name": "gold", "pbrMetallicRoughness": gold})
    points, faces = ball((0.5, 0.5, 0.5), (0, 0, 0), 8)
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    body = file.mesh(points, faces, normals, material=red)
    head = file.mesh(points, faces, normals, material=golden)
    limb, limb_faces = ball((0.12, 0.5, 0.12), (0.5, 0.2, 0.1), 6)
    arm = file.mesh(limb, limb_faces, material=red)
    arms = [file.add("nodes", {"name": "left", "mesh": arm})]
    arms.append(file.add("nodes", {"name": "right", "mesh": arm, "scale": [-1, 1, 1]}))
    top = file.add("nodes", {"name": "head", "mesh": head, "translation": [0, 1.4, 0], "scale": [0.7, 0.7, 0.7]})
    trunk = {"name": "trunk", "mesh": body, "scale": [1, 2, 1], "children": []}
    half = math.sqrt(0.5)
    turned = {"name": "all", "rotation": [0, half, 0, half], "translation": [5, 1, 0]}
    turned["children"] = [file.add("nodes", trunk), top, *arms]
    del trunk["children"]
    file.scene(file.add("nodes", turned))
    return file.glb()


def colours_glb() -> bytes:
    """Colours at vertices in bytes, no texture, no normals, indices of a strip in the mesh of a second primitive."""
    file = Gltf()
    points, faces = ball((0.6, 1.0, 0.5), (0, 1, 0), 8)
    red = (points[:, 1] / 2 * 255).round()
    colours = np.stack([red, 255 - red, np.full(len(red), 60), np.full(len(red), 255)], axis=1)
    mesh = file.mesh(points, faces, COLOR_0=file.accessor(colours, "<u1", normalized=True))
    file.scene(file.add("nodes", {"mesh": mesh}))
    return file.glb()


def mask_glb() -> bytes:
    """Alpha in the texture, cut at a half; both sides show."""
    file = Gltf()
    vertices, normals, uv = box_quads()
    texture = file.texture(encoded(corners_picture("RGBA", 8)), sampler={"magFilter": 9728})
    surface = {"baseColorTexture": {"index": texture}, "metallicFactor": 0}
    entry = {"name": "holes", "alphaMode": "MASK", "doubleSided": True, "pbrMetallicRoughness": surface}
    mesh = file.mesh(vertices, box_triangles(), normals, uv, file.add("materials", entry))
    file.scene(file.add("nodes", {"mesh": mesh}))
    return file.glb()


def maps_glb() -> bytes:
    """A JPEG, one image for roughness and metallic, a normal map, clear coat, an index of refraction."""
    file = Gltf()
    vertices, normals, uv = box_quads()
    packed = np.zeros((4, 4, 3), np.uint8)
    packed[..., 1] = np.array([40, 90, 160, 220])[:, None]
    packed[..., 2] = np.array([0, 0, 255, 255])[None]
    bumps = np.full((4, 4, 3), (128, 128, 255), np.uint8)
    bumps[1, 1] = (150, 140, 245)
    colours = encoded(corners_picture(size=16), "JPEG", quality=95, subsampling=0)
    surface = {
        "baseColorTexture": {"index": file.texture(colours, "image/jpeg", name="paint")},
        "metallicRoughnessTexture": {"index": file.texture(encoded(Image.fromarray(packed)))},
        "roughnessFactor": 0.5,
    }
    coat = {"clearcoatFactor": 0.2, "clearcoatRoughnessFactor": 0.1}
    entry = {
        "name": "maps",
        "pbrMetallicRoughness": surface,
        "normalTexture": {"index": file.texture(encoded(Image.fromarray(bumps)))},
        "extensions": {"KHR_materials_clearcoat": coat, "KHR_materials_ior": {"ior": 1.4}},
    }
    file.json["extensionsUsed"] = ["KHR_materials_clearcoat", "KHR_materials_ior"]
    mesh = file.mesh(vertices, box_triangles(), normals, uv, file.add("materials", entry))
    file.scene(file.add("nodes", {"mesh": mesh}))
    return file.glb()


def skinned_glb() -> bytes:
    """Two joints, of which the upper one is moved by 1 in the rest pose, and an animation."""
    file = Gltf()
    points, faces = ball((0.5, 1.0, 0.5), (0, 1, 0), 8)
    upper = (points[:, 1] > 1).astype(np.float32)
    joints = np.zeros((len(points), 4))
    joints[:, 1] = upper
    weights = np.stack([1 - upper, upper, 0 * upper, 0 * upper], axis=1)
    attributes = {"JOINTS_0": file.accessor(joints, "<u1"), "WEIGHTS_0": file.accessor(weights)}
    mesh = file.mesh(points, faces, **attributes)
    tip = file.add("nodes", {"name": "tip", "translation": [0, 2, 0]})
    root = file.add("nodes", {"name": "root", "children": [tip]})
    inverse = np.stack([np.eye(4), np.eye(4)])
    inverse[1, :3, 3] = [0, -1, 0]
    matrices = file.accessor(inverse.transpose(0, 2, 1).reshape(2, 16))
    skin = file.add("skins", {"joints": [root, tip], "inverseBindMatrices": matrices})
    body = file.add("nodes", {"name": "body", "mesh": mesh, "skin": skin, "translation": [9, 9, 9]})
    times, moves = file.accessor(np.array([0, 1.0]), min=[0.0], max=[1.0]), file.accessor(np.zeros((2, 3)))
    sampler, target = {"input": times, "output": moves}, {"node": root, "path": "translation"}
    file.add("animations", {"samplers": [sampler], "channels": [{"sampler": 0, "target": target}]})
    file.scene(root, body)
    return file.glb()


def apart_gltf() -> dict[str, bytes]:
    """A .gltf with its buffer and image beside it; see-through glass of a constant alpha."""
    file = Gltf()
    vertices, normals, uv = box_quads()
    image = file.add("images", {"uri": "apart%20picture.png"})
    surface = {
        "baseColorTexture": {"index": file.add("textures", {"source": image})},
        "baseColorFactor": [0.5, 1.0, 1.0, 0.4],
        "metallicFactor": 0,
    }
    entry = {"name": "tinted", "alphaMode": "BLEND", "pbrMetallicRoughness": surface}
    mesh = file.mesh(vertices, box_triangles(), normals, uv, file.add("materials", entry))
    file.scene(file.add("nodes", {"mesh": mesh}))
    file.json["buffers"] = [{"byteLength": len(file.blob), "uri": "apart.bin"}]
    text = json.dumps(file.json, indent=1).encode()
    return {"apart.gltf": text, "apart.bin": bytes(file.blob), "apart picture.png": encoded(corners_picture(size=8))}


def embedded_gltf() -> bytes:
    """Everything as base64, mirrored repetition, a sparse accessor that moves one corner."""
    file = Gltf()
    vertices, normals, uv = box_quads()
    place, corner = file.view(np.array([16], "<u2").tobytes()), file.view(np.array([(-1, 1.5, -1)], "<f4").tobytes())
    mesh = file.mesh(vertices, box_triangles(), normals, uv * 2)
    position = file.json["accessors"][file.json["meshes"][mesh]["primitives"][0]["attributes"]["POSITION"]]
    position["sparse"] = {
        "count": 1,
        "indices": {"bufferView": place, "componentType": 5123},
        "values": {"bufferView": corner},
    }
    position["max"] = [1.0, 1.5, 1.0]
    uri = "data:image/png;base64," + base64.b64encode(encoded(corners_picture(size=8))).decode()
    sampler = file.add("samplers", {"wrapS": 33648, "wrapT": 33648})
    texture = file.add("textures", {"source": file.add("images", {"uri": uri}), "sampler": sampler})
    surface = {"baseColorTexture": {"index": texture}, "metallicFactor": 0}
    material = file.add("materials", {"pbrMetallicRoughness": surface})
    file.json["meshes"][mesh]["primitives"][0]["material"] = material
    file.scene(file.add("nodes", {"mesh": mesh}))
    data = "data:application/octet-stream;base64," + base64.b64encode(bytes(file.blob)).decode()
    file.json["buffers"] = [{"byteLength": len(file.blob), "uri": data}]
    return json.dumps(file.json).encode()


def box_obj() -> dict[str, bytes]:
    """Quads with indices of their own into 8 positions, 4 UVs and 6 normals; two materials, one with maps."""
    positions = sorted({tuple(row) for row in box_quads()[0].tolist()})
    lines = ["# a box", "mtllib box materials.mtl", *(f"v {x:g} {y:g} {z:g}" for x, y, z in positions)]
    lines += [f"vt {u:g} {1 - v:g}" for u, v in UV_TOP]
    lines += [f"vn {x} {y} {z}" for (x, y, z), _, _ in SIDES]
    points = box_quads()[0].tolist()
    for number in range(6):
        lines.append(f"usemtl {'paint' if number < 4 else 'ends'}")
        index = [positions.index(tuple(points[4 * number + corner])) + 1 for corner in range(4)]
        lines.append("f " + " ".join(f"{at}/{corner + 1}/{number + 1}" for corner, at in enumerate(index)))
    materials = """newmtl paint
Kd 0.3 0.3 0.3
Pr 0.35
map_Kd -s 1 1 1 C:\\maps\\box_picture.png
newmtl ends
Kd 0.2 0.4 0.9
Ns 250
d 0.5
map_Pr missing.png
"""
    picture = encoded(corners_picture(size=8))
    return {"box.obj": "\n".join(lines).encode(), "box materials.mtl": materials.encode(), "box_picture.png": picture}


def star_obj() -> bytes:
    """A thick star: two concave n-gons, quads at the rim, negative indices, colours at vertices, a line continued."""
    count = 10
    lines = ["o star"]
    for z in (0.3, -0.3):
        for i in range(count):
            radius = 1.0 if i % 2 == 0 else 0.4
            angle = math.pi / 2 + 2 * math.pi * i / count
            tint = "1 0.5 0.2" if i % 2 == 0 else "0.2 0.4 0.9"
            lines.append(f"v {radius * math.cos(angle):.6f} {radius * math.sin(angle):.6f} {z} {tint}")
    front = [f"{i - 2 * count}" for i in range(count)]
    lines.append("f " + " ".join(front[:5]) + " \\\n" + " ".join(front[5:]))
    lines.append("f " + " ".join(str(-1 - i) for i in range(count)))
    for i in range(count):
        k = (i + 1) % count
        lines.append(f"f {i + 1} {count + i + 1} {count + k + 1} {k + 1}")
    return ("\n".join(lines) + "\n").encode()


def ply_quads() -> bytes:
    """Binary, big-endian, quads, colours in bytes, z upwards, looking along -y."""
    vertices = box_quads()[0]
    z_up = np.stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1] + 1], axis=1)
    colours = np.tile(np.array([RED, BLUE, YELLOW, GREEN]), (6, 1))
    head = "ply\nformat binary_big_endian 1.0\nelement vertex 24\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += "".join(f"property uchar {channel}\n" for channel in ("red", "green", "blue"))
    head += "element face 6\nproperty list uchar int vertex_indices\nend_header\n"
    rows = b"".join(struct.pack(">3f3B", *point, *colour) for point, colour in zip(z_up, colours.tolist(), strict=True))
    return head.encode() + rows + b"".join(struct.pack(">B4i", 4, *range(4 * i, 4 * i + 4)) for i in range(6))


def ply_sixteen() -> bytes:
    """Text, colours of 16 bits, a triangle among quads."""
    points = [(-1, 0, -1), (1, 0, -1), (1, 0, 1), (-1, 0, 1), (0, 2, 0)]
    faces = [(0, 1, 2, 3), (0, 4, 1), (1, 4, 2), (2, 4, 3), (3, 4, 0)]
    head = ["ply", "format ascii 1.0", "comment a pyramid", "element vertex 5"]
    head += [f"property float {axis}" for axis in "xyz"]
    head += [f"property ushort {channel}" for channel in ("red", "green", "blue")]
    head += ["element face 5", "property list uchar int vertex_index", "end_header"]
    tints = [(65535, 0, 0), (0, 65535, 0), (0, 0, 65535), (65535, 65535, 0), (32768, 32768, 32768)]
    rows = [" ".join(map(str, (*point, *tint))) for point, tint in zip(points, tints, strict=True)]
    return "\n".join([*head, *rows, *(" ".join(map(str, (len(face), *face))) for face in faces), ""]).encode()


def ply_corner_uvs() -> dict[str, bytes]:
    """Eight vertices, UVs at the corners of the faces, a picture named in a comment."""
    positions = sorted({tuple(row) for row in box_quads()[0].tolist()})
    points, _, uv = box_quads()
    head = ["ply", "format binary_little_endian 1.0", "comment TextureFile corner_uvs.png", "element vertex 8"]
    head += [f"property double {axis}" for axis in "xyz"]
    head += ["element face 12", "property list uchar uint vertex_indices", "property list uchar float texcoord"]
    rows = b"".join(struct.pack("<3d", *row) for row in positions)
    for face in box_triangles():
        index = [positions.index(tuple(points[corner].tolist())) for corner in face]
        values = [value for corner in face for value in (uv[corner][0], 1 - uv[corner][1])]
        rows += struct.pack("<B3I", 3, *index) + struct.pack("<B6f", 6, *values)
    data = "\n".join([*head, "end_header", ""]).encode() + rows
    return {"corner_uvs.ply": data, "corner_uvs.png": encoded(corners_picture(size=8))}


def duck_stl() -> bytes:
    """Binary, in millimetres, z upwards, standing on z = 0, looking along +x: a body, a head, a beak."""
    pieces = [ball((30, 20, 18), (0, 0, 18), 10), ball((11, 11, 11), (24, 0, 42), 8), ball((9, 4, 3), (38, 0, 41), 6)]
    rows = b""
    for points, faces in pieces:
        for face in faces:
            corners = points[face]
            normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
            normal /= max(np.linalg.norm(normal), 1e-12)
            rows += struct.pack("<12fH", *normal, *corners.ravel(), 0)
    return b"a duck".ljust(80) + struct.pack("<I", len(rows) // 50) + rows


def coff() -> bytes:
    """A box of quads with colours at vertices, and a comment."""
    positions = sorted({tuple(row) for row in box_quads()[0].tolist()})
    points = box_quads()[0].tolist()
    lines = ["COFF # a box", "8 6 0"]
    lines += [f"{x:g} {y:g} {z:g} {int(100 * x + 120)} 60 200 255" for x, y, z in positions]
    for number in range(6):
        index = [positions.index(tuple(points[4 * number + corner])) for corner in range(4)]
        lines.append("4 " + " ".join(map(str, index)))
    return ("\n".join(lines) + "\n").encode()


def box_3ds() -> bytes:
    """Chunks in chunks, z upwards: a box of triangles with UVs, its material and image, a colour of 0..255."""

    def chunk(kind: int, *content: bytes) -> bytes:
        body = b"".join(content)
        return struct.pack("<HI", kind, 6 + len(body)) + body

    points, _, uvs = box_quads()
    faces = np.concatenate([box_triangles(), np.full((12, 1), 7)], axis=1).astype("<u2")
    image = chunk(0xA200, chunk(0x0030, struct.pack("<h", 100)), chunk(0xA300, b"BOX_PICTURE.PNG\0"))
    material = chunk(0xAFFF, chunk(0xA000, b"paint\0"), chunk(0xA020, chunk(0x0011, bytes([200, 200, 200]))), image)
    own = chunk(0x4130, b"paint\0", struct.pack("<H", 12), np.arange(12, dtype="<u2").tobytes())
    mesh = chunk(
        0x4100,
        chunk(0x4110, struct.pack("<H", 24), points.astype("<f4").tobytes()),
        chunk(0x4140, struct.pack("<H", 24), np.stack([uvs[:, 0], 1 - uvs[:, 1]], axis=1).astype("<f4").tobytes()),
        chunk(0x4120, struct.pack("<H", 12), faces.tobytes(), own),
    )
    return chunk(0x4D4D, chunk(0x3D3D, material, chunk(0x4000, b"box\0", mesh)))


def box_dae() -> bytes:
    """Quads with UVs of their own, in centimetres, an image through surface and sampler, moved by its node."""
    points, _, _ = box_quads()
    corners = " ".join(f"{4 * side + k} {k}" for side in range(6) for k in range(4))
    places = " ".join(f"{value:g}" for value in points.ravel())
    uvs = " ".join(f"{u:g} {1 - v:g}" for u, v in UV_TOP)

    def source(name: str, values: str, axes: str) -> str:
        count = len(values.split())
        params = "".join(f'<param name="{axis}" type="float"/>' for axis in axes)
        return (
            f'<source id="{name}"><float_array id="{name}-a" count="{count}">{values}</float_array><technique_common>'
            f'<accessor source="#{name}-a" count="{count // len(axes)}" stride="{len(axes)}">{params}</accessor>'
            "</technique_common></source>"
        )

    return f"""<?xml version="1.0" encoding="utf-8"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><created>2026-01-01T00:00:00</created><modified>2026-01-01T00:00:00</modified>
<unit name="centimeter" meter="0.01"/><up_axis>Y_UP</up_axis></asset>
<library_images><image id="picture"><init_from>box_picture.png</init_from></image></library_images>
<library_effects><effect id="paint"><profile_COMMON>
<newparam sid="s"><surface type="2D"><init_from>picture</init_from></surface></newparam>
<newparam sid="t"><sampler2D><source>s</source></sampler2D></newparam>
<technique sid="common"><lambert><diffuse><texture texture="t" texcoord="UV"/></diffuse></lambert></technique>
</profile_COMMON></effect></library_effects>
<library_materials><material id="m" name="paint"><instance_effect url="#paint"/></material></library_materials>
<library_geometries><geometry id="g" name="box"><mesh>
{source("places", places, "XYZ")}
{source("uvs", uvs, "ST")}
<vertices id="v"><input semantic="POSITION" source="#places"/></vertices>
<polylist material="symbol" count="6"><input semantic="VERTEX" source="#v" offset="0"/>
<input semantic="TEXCOORD" source="#uvs" offset="1" set="0"/>
<vcount>4 4 4 4 4 4</vcount><p>{corners}</p></polylist></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="scene"><node id="n"><translate>0 100 0</translate><scale>100 100 100</scale>
<instance_geometry url="#g"><bind_material><technique_common><instance_material symbol="symbol" target="#m">
<bind_vertex_input semantic="UV" input_semantic="TEXCOORD" input_set="0"/></instance_material></technique_common>
</bind_material></instance_geometry></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#scene"/></scene></COLLADA>
""".encode()


def main() -> None:
    files = {
        "box.glb": box_glb(),
        "transformed_uv.glb": transformed_uv_glb(),
        "figure.glb": figure_glb(),
        "colours.glb": colours_glb(),
        "mask.glb": mask_glb(),
        "maps.glb": maps_glb(),
        "skinned.glb": skinned_glb(),
        **apart_gltf(),
        "embedded.gltf": embedded_gltf(),
        **box_obj(),
        "star.obj": star_obj(),
        "quads.ply": ply_quads(),
        "sixteen.ply": ply_sixteen(),
        **ply_corner_uvs(),
        "duck.stl": duck_stl(),
        "colours.off": coff(),
        "box.3ds": box_3ds(),
        "box.dae": box_dae(),
    }
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        (FOLDER / name).write_bytes(data)
        print(f"{name}: {len(data)} bytes")


if __name__ == "__main__":
    main()
