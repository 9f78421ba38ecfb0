"""A part made ready for every format: its atlas, its material, its baked textures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fd_mitsuba.config import RunConfig
from fd_mitsuba.export.bake.bake import Field, bake, bent_normals
from fd_mitsuba.export.bake.shading_noise import surface_noise, widened_roughness
from fd_mitsuba.export.bake.unwrap import UnwrappedMesh, unwrap
from fd_mitsuba.export.material import PbrMaterial, pbr_material
from fd_mitsuba.export.obj import ply_with_uv
from fd_mitsuba.export.pictures import Picture, exr, part_pictures, png
from fd_mitsuba.io.atomic import write_atomically
from fd_mitsuba.scene.edit_inputs import EditInputs
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.part_material import PartMaterial, part_material


@dataclass(frozen=True)
class PartAsset:
    """One part to export.

    Attributes:
        vertices: (V, 3), user frame.
        faces: (F, 3), a closed solid, or the faces of a cut.
        values: the learned material; None: the constants of the scene's `<bsdf id="part">`.
        normals: (V, 3) unit shading normals; None: the smooth ones of the faces.
    """

    vertices: np.ndarray
    faces: np.ndarray
    values: Field | None = None
    normals: np.ndarray | None = None


@dataclass(frozen=True)
class ReadyPart:
    """What the writers need of a part."""

    name: str
    label: str
    """What it is called in files, nodes and groups: `part_<name>`, or `cut_face_<name>`."""
    mesh: UnwrappedMesh
    material: PbrMaterial
    pictures: dict[str, Picture]
    feeds: dict[str, str]
    """Picture -> parameter of the part's BSDF in Mitsuba."""
    noise_deg: float | None = None
    """The noise of its shading that the roughness was widened for; None: it is as it was learned."""

    def ply(self) -> bytes:
        """The mesh with normals and UVs; Mitsuba wants `flip_tex_coords` for it."""
        return ply_with_uv(self.mesh.vertices, self.mesh.faces, self.mesh.normals, self.mesh.uv)


def ready_part(
    scene: EditScene,
    config: RunConfig,
    inputs: EditInputs,
    name: str,
    label: str,
    part: PartAsset,
    folder: Path,
    texture_size: int,
    say: Callable[[str], None],
) -> ReadyPart:
    """The part with its atlas, its material, and its textures if it has a learned one.

    Writes the latter into `textures/` of the folder, as PNG and EXR.
    """
    mesh = unwrap(part.vertices, part.faces, texture_size, part.normals)
    file, element = inputs.part_bsdf()
    plain = PbrMaterial(label) if element is None else pbr_material(file, element, label)
    if part.values is None:
        return ReadyPart(name, label, mesh, plain, {}, {})
    say(f"baking the textures of {name}, {texture_size} x {texture_size}")
    canonical = replace(mesh, vertices=scene.frame.to_canonical(mesh.vertices))
    textures = bake(canonical, part.values, texture_size)
    noise = None
    if config.output.roughness_floor:
        noise = surface_noise(canonical.vertices, canonical.faces, bent_normals(canonical, part.values))
        textures = replace(textures, roughness=widened_roughness(textures.roughness, noise))
    pictures = part_pictures(label, textures)
    fed = part_material(scene, config.appearance.fixed, config.appearance.normal_map)
    feeds = {}
    for channel, path in fed.feeds.items():
        feeds[channel] = path.rpartition(".")[2]
        if channel in fed.squared:
            alpha = Picture(f"{label}_alpha", png(textures.roughness**2), wrap="clamp")
            pictures["alpha"], feeds["alpha"] = alpha, feeds.pop(channel)
    for key, picture in pictures.items():
        write_atomically(folder / "textures" / picture.file_name, picture.data)
        if hasattr(textures, key):
            write_atomically(folder / "textures" / f"{picture.name}.exr", exr(file.mi, getattr(textures, key)))
    material = replace(
        plain,
        base_color=colour_factor(plain, fed),
        base_picture=pictures["base_color"],
        orm_picture=pictures["orm"],
        normal_picture=pictures.get("normal"),
    )
    return ReadyPart(name, label, mesh, material, pictures, feeds, noise)


def colour_factor(plain: PbrMaterial, fed: PartMaterial) -> tuple[float, float, float]:
    """What the learned colour is to be multiplied with: a metal's own colour where it only tints that.

    Args:
        plain: the part's BSDF as it is before anything is learned.
    """
    if not fed.feeds.get("base_color", "").endswith("specular_reflectance"):
        return (1.0, 1.0, 1.0)
    tint = np.array(plain.base_color) / np.maximum(np.array(fed.start.base_color), 1e-3)
    return tuple(float(v) for v in np.clip(tint, 0, 1))  # type: ignore[return-value]
