"""Wavefront OBJ with an MTL of PBR maps, and PLY with normals and UVs."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image

from fd_mitsuba.export.export_mesh import ExportMesh
from fd_mitsuba.export.material import PbrMaterial
from fd_mitsuba.export.pictures import Picture
from fd_mitsuba.io.float_steps import is_coarse
from fd_mitsuba.io.safe_text import safe_name
from fd_mitsuba.io.srgb import srgb_from_linear


class ObjMesh(ExportMesh):
    """A group of an OBJ file, in the user frame; its name is that of object, group and material, after `safe_name`.

    UVs are written with the origin bottom left, as OBJ has it; colours behind the position, as sRGB, which is how they
    are read.
    """


def obj_files(meshes: list[ObjMesh], name: str = "asset") -> dict[str, bytes]:
    """File name -> bytes: the OBJ, its MTL and the pictures. Numbers are exact for float32, or 15 digits.

    Positions have the latter where they lie too far from the origin for float32. All names in it, and of the files, are
    of letters, digits, `_`, `.` and `-`, and differ where case does not count.
    """
    files: dict[str, bytes] = {}
    lines = [f"mtllib {name}.mtl"]
    materials: list[str] = []
    labels: list[str] = []
    positions = places = directions = 0
    for mesh in meshes:
        label = safe_name(mesh.name, labels)  # a blank would end it, and make two groups of one
        labels.append(label)
        materials += _material_lines(label, mesh.material, files)
        lines += [f"o {label}", f"g {label}", f"usemtl {label}"]
        far = is_coarse(mesh.vertices)
        rows = np.asarray(mesh.vertices, dtype=np.float64 if far else np.float32)
        if mesh.colours is not None:
            rows = np.concatenate([rows, srgb_from_linear(mesh.colours).astype(np.float32)], axis=1)
        lines += _rows("v", rows, "%.15g" if far else "%.9g")
        corner = [mesh.faces + positions + 1]
        if mesh.uv is not None:
            flipped = np.stack([mesh.uv[:, 0], 1.0 - np.asarray(mesh.uv[:, 1], dtype=np.float64)], axis=1)
            lines += _rows("vt", flipped)
            corner.append(mesh.faces + places + 1)
            places += len(mesh.uv)
        if mesh.normals is not None:
            lines += _rows("vn", mesh.normals)
            corner.append(mesh.faces + directions + 1)
            directions += len(mesh.normals)
        positions += len(mesh.vertices)
        pattern = {1: "{0}", 2: "{0}/{1}" if mesh.uv is not None else "{0}//{1}", 3: "{0}/{1}/{2}"}[len(corner)]
        word = pattern.format("%d", "%d", "%d")
        face = f"f {word} {word} {word}"
        numbers = np.stack(corner, axis=2).reshape(len(mesh.faces), -1)
        lines += [face % tuple(row) for row in numbers.tolist()]
    files[f"{name}.obj"] = ("\n".join(lines) + "\n").encode("utf-8")
    files[f"{name}.mtl"] = ("\n".join(materials) + "\n").encode("utf-8")
    return files


def ply_with_uv(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, uv: np.ndarray) -> bytes:
    """A binary PLY of vertices (V, 3), unit normals (V, 3) and uv (V, 2) with the origin bottom left, all float32.

    Only positions that lie too far from the origin are float64. Mitsuba wants `flip_tex_coords` for it.
    """
    kind = "double" if is_coarse(vertices) else "float"
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property {kind} {name}" for name in "xyz"]
    header += [f"property float {name}" for name in ("nx", "ny", "nz", "s", "t")]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    flipped = np.stack([uv[:, 0], 1.0 - np.asarray(uv[:, 1], dtype=np.float64)], axis=1)
    table = np.empty(len(vertices), [("position", "<f8" if kind == "double" else "<f4", 3), ("further", "<f4", 5)])
    table["position"], table["further"] = vertices, np.concatenate([normals, flipped], axis=1)
    rows = np.empty(len(faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    rows["count"], rows["index"] = 3, faces
    return "\n".join(header).encode("ascii") + table.tobytes() + rows.tobytes()


def _rows(word: str, values: np.ndarray, form: str = "%.9g") -> list[str]:
    line = " ".join([word] + [form] * values.shape[1])
    return [line % tuple(row) for row in values.tolist()]


def _material_lines(name: str, material: PbrMaterial, files: dict[str, bytes]) -> list[str]:
    lines = [f"newmtl {name}", "Kd {:.6g} {:.6g} {:.6g}".format(*material.base_color)]
    lines += ["Ks 0.5 0.5 0.5" if material.specular else "Ks 0 0 0", f"Ni {material.ior:.6g}"]
    lines += [f"d {material.opacity * (1 - material.transmission):.6g}", "illum 2"]
    packed = material.orm_picture is not None
    lines += [f"Pr {1 if packed else material.roughness:.6g}", f"Pm {1 if packed else material.metallic:.6g}"]
    if material.base_picture is not None:
        place = f"{_options(material.base_picture)}{_put(files, material.base_picture)}"
        lines.append(f"map_Kd {place}")
        if material.alpha_mode != "OPAQUE" and material.base_picture.alpha() is not None:
            lines.append(f"map_d {place}")
    if material.orm_picture is not None:
        pixels = material.orm_picture.pixels()
        stem = material.orm_picture.name.removesuffix("_orm")
        for word, channel, label in (("map_Pr", 1, "roughness"), ("map_Pm", 2, "metallic")):
            stream = io.BytesIO()
            Image.fromarray(pixels[..., channel]).save(stream, format="PNG")
            picture = Picture(f"{stem}_{label}", stream.getvalue())
            lines.append(f"{word} {_options(material.orm_picture)}{_put(files, picture)}")
    if material.normal_picture is not None:
        place = f"{_options(material.normal_picture)}{_put(files, material.normal_picture)}"
        # `norm` is the PBR extension's word, `map_Bump` is the one that more programs know. Blender takes the strength
        # of the map from `-bm`, and without it 0.
        lines += [f"norm {place}", f"map_Bump -bm 1 {place}"]
    return [*lines, ""]


def _options(picture: Picture) -> str:
    (u, v), (scale_u, scale_v) = picture.tiling
    tiled = picture.tiling != ((0.0, 0.0), (1.0, 1.0))
    # v runs the other way here: 1 - (v + s (1 - w)) = (1 - v - s) + s w
    text = f"-o {u:.6g} {1 - v - scale_v:.6g} 0 -s {scale_u:.6g} {scale_v:.6g} 1 " if tiled else ""
    return text + ("-clamp on " if picture.wrap == "clamp" else "")


def _put(files: dict[str, bytes], picture: Picture) -> str:
    """The name that the picture got: one that is free, or its own where it is there already."""
    name = safe_name(picture.name, suffix=picture.suffix)
    if files.get(name) != picture.data:
        name = safe_name(picture.name, files, picture.suffix)
    files[name] = picture.data
    return name
