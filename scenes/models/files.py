"""From a model to the files of a scene folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from models.model import Model
from models.texture import Unwrapped, bake, unwrap, write_textures

SCENES = Path(__file__).resolve().parent.parent
Vector = tuple[float, float, float]


def save(
    name: str,
    model: Model,
    bounds: tuple[Vector, Vector],
    cell: float,
    *,
    seed: int,
    texture: int = 512,
    scale: float = 1.0,
    place: Vector = (0, 0, 0),
    paint_vertices: bool = False,
    open_below: float | None = None,
) -> None:
    """Meshes `model` inside `bounds` and writes `scenes/<name>.ply` with UVs, and its textures.

    Args:
        name: "<scene>/<mesh>".
        cell: length of the edges.
        texture: pixels a side; 0 writes no texture.
        scale, place: taken by the finished mesh, so that the scene has units and an origin of its own.
        paint_vertices: store the colours as vertex attribute `color` too.
        open_below: leave out the faces below this height, as a scan of an object on the ground has none.
    """
    surface = model.mesh(*bounds, cell)
    if open_below is not None:
        surface.update_faces(surface.triangles[:, :, 1].max(axis=1) > open_below)
        surface.remove_unreferenced_vertices()
    mesh = unwrap(surface, texture or 256)
    (SCENES / name).parent.mkdir(parents=True, exist_ok=True)
    sizes = []
    if texture:
        for path in write_textures(SCENES / name, bake(mesh, model, texture, seed)):
            sizes.append(f"{path.name} {path.stat().st_size // 1024} KB")
    colours = model.looks(mesh.vertices, mesh.normals, seed)[:, :3] if paint_vertices else None
    path = SCENES / f"{name}.ply"
    write_ply(path, mesh, scale, np.asarray(place), colours)
    extent = (np.array(surface.bounds).T * scale + np.asarray(place)[:, None]).round(3).tolist()
    print(
        f"{name}.ply: {len(mesh.vertices)} vertices, {len(mesh.faces)} faces, {path.stat().st_size // 1024} KB,", end=""
    )
    print(f" x y z in {extent}", *sizes, sep=", ")


def save_region(
    name: str, model: Model, bounds: tuple[Vector, Vector], cell: float, scale: float, place: Vector
) -> None:
    """Writes `scenes/<name>.ply`, a closed mesh with nothing but positions, for a focal region."""
    surface = model.mesh(*bounds, cell)
    bare = np.zeros((len(surface.vertices), 0))
    write_ply(SCENES / f"{name}.ply", Unwrapped(surface.vertices, bare, bare, surface.faces), scale, np.asarray(place))
    print(f"{name}.ply: region, {len(surface.faces)} faces")


def write_ply(path: Path, mesh: Unwrapped, scale: float, place: np.ndarray, colours: np.ndarray | None = None) -> None:
    """Writes a binary PLY: positions, and if the mesh has them normals and UVs, then linear float colours."""
    # Rounded to what can be seen: the zeros at the end of the mantissas let the repository compress the file.
    grain = 2.0 ** np.floor(np.log2(np.ptp(mesh.vertices, axis=0).max() * scale) - 14)
    columns = [np.rint((mesh.vertices * scale + place) / grain) * grain]
    names = "x y z".split()
    if mesh.uv.shape[1]:
        columns += [np.rint(mesh.normals * 256) / 256, np.rint(mesh.uv * 2**13) / 2**13]
        names += "nx ny nz s t".split()
    if colours is not None:
        columns.append(np.rint(colours * 256) / 256)
        names += "r g b".split()
    face = np.zeros(len(mesh.faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    face["count"], face["index"] = 3, mesh.faces
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(mesh.vertices)}"]
    header += [f"property float {name}" for name in names]
    header += [f"element face {len(face)}", "property list uchar int vertex_indices", "end_header", ""]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes("\n".join(header).encode() + np.hstack(columns).astype("<f4").tobytes() + face.tobytes())
