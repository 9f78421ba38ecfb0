"""An asset's meshes as the shapes of a scene: one a material, with the attributes that a Mitsuba mesh can have."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fd_mitsuba.assets.asset import Asset, AssetMaterial, AssetMesh
from fd_mitsuba.assets.crease_normals import crease_normals
from fd_mitsuba.io.float_steps import is_coarse

_PLAIN = AssetMaterial("plain", base_color=(0.7, 0.7, 0.7))
_SHEET = 1e-12


@dataclass(frozen=True)
class SceneShape:
    """One shape of the scene to be.

    Attributes:
        name: of its mesh or material; not safe as a file's name.
        vertices: (V, 3) near the origin of their own frame.
        faces: (F, 3).
        normals: (V, 3) unit; None: flat faces.
        uv: (V, 2), origin top left.
        colours: (V, 3) linear, which take the place of the material's colour.
        to_asset: (4, 4), to the asset's frame.
        material: of all its faces, with textures of the set that `uv` is.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None
    uv: np.ndarray | None
    colours: np.ndarray | None
    to_asset: np.ndarray
    material: AssetMaterial

    def placed(self) -> np.ndarray:
        """Vertices (V, 3) in the asset's frame."""
        return self.vertices @ self.to_asset[:3, :3].T + self.to_asset[:3, 3]


def scene_shapes(asset: Asset, notes: list[str]) -> list[SceneShape]:
    """The asset's shapes. A material that a single mesh has keeps that mesh's own frame, bit for bit; else the meshes
    are put together in the asset's frame. What cannot be said goes to `notes`.
    """
    groups: dict[tuple[int, bool], list[AssetMesh]] = {}
    for mesh in asset.meshes:
        mesh = _with_colours_that_count(mesh)
        groups.setdefault((mesh.material, mesh.colours is not None), []).append(_shaded(mesh, asset.flat))
    shapes = []
    for (number, coloured), meshes in groups.items():
        material = asset.materials[number] if number >= 0 else _PLAIN
        alone = len(meshes) == 1 and np.linalg.det(meshes[0].to_asset[:3, :3]) > _SHEET
        mesh = meshes[0] if alone else _joined(meshes)
        name = mesh.name if len(groups) == 1 or number < 0 or not material.name else material.name
        if coloured:
            mesh, material = _coloured(
                mesh, material if number >= 0 else replace(_PLAIN, base_color=(1.0, 1.0, 1.0)), notes
            )
        material, uv = _one_uv_set(mesh, material, notes)
        vertices, to_asset = mesh.vertices, mesh.to_asset
        if is_coarse(vertices):  # 32 bits are too few for where it lies, but not for its shape
            middle = np.round((vertices.min(axis=0) + vertices.max(axis=0)) / 2)
            move = np.eye(4)
            move[:3, 3] = middle
            vertices, to_asset = vertices - middle, to_asset @ move
        shapes.append(SceneShape(name, vertices, mesh.faces, mesh.normals, uv, mesh.colours, to_asset, material))
    return shapes


def _with_colours_that_count(mesh: AssetMesh) -> AssetMesh:
    white = mesh.colours is not None and bool((mesh.colours >= 1.0 - 1e-6).all())
    return replace(mesh, colours=None) if white else mesh


def _shaded(mesh: AssetMesh, flat: bool) -> AssetMesh:
    if mesh.normals is not None or flat:
        return mesh
    source, normals, faces = crease_normals(mesh.vertices, mesh.faces)
    colours = None if mesh.colours is None else mesh.colours[source]
    uvs = {number: values[source] for number, values in mesh.uvs.items()}
    return replace(mesh, vertices=mesh.vertices[source], faces=faces, normals=normals, uvs=uvs, colours=colours)


def _joined(meshes: list[AssetMesh]) -> AssetMesh:
    """One mesh in the asset's frame; UVs that only some have are 0 on the others."""
    if any(mesh.normals is not None for mesh in meshes):
        meshes = [mesh if mesh.normals is not None else _faceted(mesh) for mesh in meshes]
    placed = [mesh.placed() for mesh in meshes]
    starts = np.cumsum([0] + [len(vertices) for vertices, _, _ in placed[:-1]])
    sets = dict.fromkeys(number for mesh in meshes for number in mesh.uvs)
    uvs = {
        number: np.concatenate([mesh.uvs.get(number, np.zeros((len(mesh.vertices), 2))) for mesh in meshes])
        for number in sets
    }
    normals = [normal for _, _, normal in placed if normal is not None]
    colours = [mesh.colours for mesh in meshes if mesh.colours is not None]
    return AssetMesh(
        meshes[0].name,
        np.concatenate([vertices for vertices, _, _ in placed]),
        np.concatenate([faces + start for (_, faces, _), start in zip(placed, starts, strict=True)]),
        meshes[0].material,
        np.concatenate(normals) if normals else None,
        uvs,
        np.concatenate(colours) if colours else None,
    )


def _faceted(mesh: AssetMesh) -> AssetMesh:
    """The mesh with the normals of its faces, each corner a vertex of its own."""
    corner = mesh.faces.ravel()
    corners = mesh.vertices[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.where(length > 0, normal / np.maximum(length, 1e-300), [0.0, 0.0, 1.0])
    return replace(
        mesh,
        vertices=mesh.vertices[corner],
        faces=np.arange(len(corner)).reshape(-1, 3),
        normals=np.repeat(normal, 3, axis=0),
        uvs={number: values[corner] for number, values in mesh.uvs.items()},
        colours=None if mesh.colours is None else mesh.colours[corner],
    )


def _coloured(mesh: AssetMesh, material: AssetMaterial, notes: list[str]) -> tuple[AssetMesh, AssetMaterial]:
    """Colours at vertices times the material's; a single colour becomes the material's."""
    assert mesh.colours is not None
    colours = mesh.colours * np.array(material.base_color)
    if (np.ptp(mesh.colours, axis=0) < 1e-6).all():
        tint = tuple(float(value) for value in colours[0])
        return replace(mesh, colours=None), replace(material, base_color=tint)
    if material.base_texture is not None:
        notes.append(
            f"material {material.name!r}: its colours at vertices are left out, because Mitsuba cannot multiply them "
            "with its texture; bake them into it"
        )
        return replace(mesh, colours=None), material
    return replace(mesh, colours=colours), replace(material, base_color=(1.0, 1.0, 1.0))


def _one_uv_set(mesh: AssetMesh, material: AssetMaterial, notes: list[str]) -> tuple[AssetMaterial, np.ndarray | None]:
    """The UVs that the first texture wants, and the material without textures that want others."""
    if not material.textures:
        return material, mesh.uvs.get(min(mesh.uvs)) if mesh.uvs else None
    wanted = material.textures[0].uv_set
    if wanted not in mesh.uvs:
        notes.append(f"material {material.name!r}: its mesh has no UVs for its textures, which are left out")
        return _without(material, {texture.uv_set for texture in material.textures}), None
    others = {texture.uv_set for texture in material.textures} - {wanted}
    if others:
        notes.append(f"material {material.name!r}: textures of a second UV set are left out")
    return _without(material, others), mesh.uvs[wanted]


def _without(material: AssetMaterial, sets: set[int]) -> AssetMaterial:
    names = ("base_texture", "roughness_texture", "metallic_texture", "opacity_texture", "normal_texture")
    gone = {name: None for name in names if (texture := getattr(material, name)) and texture.uv_set in sets}
    return replace(material, **gone)
