"""The two Mitsuba plugins that a scene to edit needs: shape `focal_region` and integrator `dual_path`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fd_mitsuba.backend.startup import FACES, VERTICES
from fd_mitsuba.conventions import DEFAULT_PART_NAME
from fd_mitsuba.scene.focal_region import ADD
from fd_mitsuba.scene.mesh_source import FILE_SHAPES, shape_triangles
from fd_mitsuba.scene.tessellate import Arrays, unit_sphere

FOCAL_REGION = "focal_region"
DUAL_PATH = "dual_path"

_registered: set[str] = set()


def register(mi: Any) -> None:
    """Make both plugins known to the current variant of `mi`; registering twice is harmless.

    Mitsuba keeps plugins a variant: call this after every `mi.set_variant` to a new one.
    """
    variant = mi.variant()
    if variant is None:
        raise RuntimeError("choose a Mitsuba variant before the plugins are registered")
    if variant in _registered:
        return
    mi.register_shape(FOCAL_REGION, lambda properties: _focal_region(mi, properties))
    mi.register_integrator(DUAL_PATH, _dual_path_class(mi))
    _registered.add(variant)


def region_triangles(mi: Any, filename: str | None, to_world: np.ndarray, subdivisions: int = 4) -> Arrays:
    """Vertices and faces after `to_world` of a region: the unit sphere, or the mesh in `filename`.

    Raises:
        ValueError: the file is of no mesh type. Further: see `mesh_source.shape_triangles`.
    """
    if filename is None:
        vertices, faces = unit_sphere(subdivisions)
        if np.linalg.det(to_world[:3, :3]) < 0:
            faces = faces[:, ::-1]
        return vertices @ to_world[:3, :3].T + to_world[:3, 3], np.array(faces)
    suffix = Path(filename).suffix.lower()
    if suffix not in FILE_SHAPES:
        raise ValueError(f"{filename!r} is not one of {', '.join(FILE_SHAPES)}")
    return shape_triangles(mi, FILE_SHAPES[suffix], {"filename": filename}, to_world)


def _focal_region(mi: Any, properties: Any) -> Any:
    # Mitsuba's own names: `part` and `mode` are ours, `filename` and `to_world` mean what they mean for a `ply`.
    properties.get("part", DEFAULT_PART_NAME)
    properties.get("mode", ADD)
    filename = properties.get("filename", None)
    to_world = np.array(properties.get("to_world", mi.ScalarTransform4f()).matrix, dtype=np.float64)
    vertices, faces = region_triangles(mi, filename, to_world)
    if not properties.objects():
        # Without a BSDF of its own a region is glassy, so that a plain render of the scene shows what it encloses.
        glassy = {"type": "mask", "opacity": 0.25, "nested": {"type": "twosided", "bsdf": {"type": "diffuse"}}}
        properties["bsdf"] = mi.load_dict(glassy)
    mesh = mi.Mesh(properties.id() or FOCAL_REGION, len(vertices), len(faces), props=properties)
    parameters = mi.traverse(mesh)
    parameters[VERTICES] = np.ascontiguousarray(vertices.ravel(), dtype=np.float32)
    parameters[FACES] = np.ascontiguousarray(faces.ravel(), dtype=np.uint32)
    parameters.update()
    return mesh


def _dual_path_class(mi: Any) -> Any:
    class DualPath(mi.SamplingIntegrator):
        """Holds the prompts; a plain render with it is a path-traced preview of the scene as it stands."""

        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            self.prompt = properties.get("prompt", "")
            self.base_prompt = properties.get("base_prompt", "")
            self.negative_prompt = properties.get("negative_prompt", "")
            self.simple_prompt = properties.get("simple_prompt", "")
            self._preview = mi.load_dict({"type": "path", "max_depth": 4})

        def sample(
            self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True
        ) -> tuple[Any, Any, list[Any]]:
            return self._preview.sample(scene, sampler, ray, medium, active)

        def aov_names(self) -> list[str]:
            return []

        def to_string(self) -> str:
            return f"dual_path[prompt={self.prompt!r}, base_prompt={self.base_prompt!r}]"

    return DualPath
