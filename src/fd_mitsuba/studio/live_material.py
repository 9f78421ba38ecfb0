"""The part with the material that it has learned so far, while the appearance stage runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from fd_mitsuba.export.gltf import GltfMesh, glb_bytes
from fd_mitsuba.export.material import PbrMaterial, pbr_material
from fd_mitsuba.export.ready_part import colour_factor
from fd_mitsuba.scene.part_material import part_material
from fd_mitsuba.scene.vertex_normals import vertex_normals
from fd_mitsuba.training.appearance_stage import AppearanceStage


class LiveMaterial:
    """Makes GLBs of a stage's parts; what does not change during the stage is made once.

    Example:
        live = LiveMaterial(stage)
        data = live.glb()  # after any step
    """

    def __init__(self, stage: AppearanceStage) -> None:
        scene, settings = stage.scene, stage.config.appearance
        self._stage = stage
        file, element = scene.inputs.part_bsdf()
        plain = PbrMaterial("part") if element is None else pbr_material(file, element, "part")
        fed = part_material(scene, settings.fixed, settings.normal_map)
        self._learned = fed.learned
        colour = colour_factor(plain, fed) if "base_color" in fed.learned else plain.base_color
        self._material = replace(plain, base_color=colour, base_picture=None, orm_picture=None, normal_picture=None)
        self._meshes = {}
        for name, mesh in stage.parts.items():
            vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
            self._meshes[name] = vertices, faces, vertex_normals(vertices, faces)

    def glb(self) -> bytes:
        """The parts, user frame: base colours at their vertices, roughness and metallic as means over these.

        Nothing of the stage is changed, and no random number is drawn.
        """
        scene, origin = self._stage.scene, np.eye(4)
        origin[:3, 3] = scene.origin
        made = []
        for name, (vertices, faces, normals) in self._meshes.items():
            with torch.no_grad():
                values = self._stage.field(torch.from_numpy(vertices.astype(np.float32)))
            fed = [key for key in ("roughness", "metallic") if key in self._learned]
            means = {key: float(getattr(values, key).mean()) for key in fed}
            colours = values.base_color.numpy().clip(0, 1) if "base_color" in self._learned else None
            material = replace(self._material, name=f"part_{name}", **means)
            placed = scene.frame.to_user(vertices) - scene.origin
            made.append(GltfMesh(material.name, placed, faces, material, normals, colours=colours, to_world=origin))
        return glb_bytes(made, {})
