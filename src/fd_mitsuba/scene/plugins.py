"""The two Mitsuba plugins that a scene to edit needs: shape `focal_region` and integrator `dual_path`."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fd_mitsuba.backend.startup import FACES, VERTICES
from fd_mitsuba.config.choice import Choice
from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.mesh_source import FILE_SHAPES, shape_triangles
from fd_mitsuba.scene.region_shapes import ELLIPSOID, REGION_SHAPES, shape_arrays
from fd_mitsuba.scene.tessellate import Arrays

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


def region_triangles(mi: Any, properties: Mapping[str, Any], to_world: np.ndarray) -> Arrays:
    """Vertices and faces after `to_world` of a region: an entry of `REGION_SHAPES`, or the mesh in `filename`.

    Raises:
        UserError: see `region_choice` and `region_shapes.shape_arrays`.
        ValueError: the file is of no mesh type. Further: see `mesh_source.shape_triangles`.
    """
    choice = region_choice(properties)
    if choice is None:
        filename = str(properties["filename"])
        suffix = Path(filename).suffix.lower()
        if suffix not in FILE_SHAPES:
            raise ValueError(f"{filename!r} is not one of {', '.join(FILE_SHAPES)}")
        return shape_triangles(mi, FILE_SHAPES[suffix], {"filename": filename}, to_world)
    vertices, faces = shape_arrays(choice)
    if np.linalg.det(to_world[:3, :3]) < 0:
        faces = faces[:, ::-1]
    return vertices @ to_world[:3, :3].T + to_world[:3, 3], np.array(faces)


def region_choice(properties: Mapping[str, Any]) -> Choice | None:
    """The shape that a region's properties name, with its settings; None: it is a mesh from `filename`.

    Raises:
        UserError: both a shape and a file, an unknown shape, a property that it does not have.
    """
    shape = properties.get("shape")
    options = {name: _plain(value) for name, value in properties.items() if name not in _OWN}
    is_file = "filename" in properties
    if is_file and shape is not None:
        raise UserError(f"has the shape {shape!r} and a filename; keep one of them")
    choice = Choice.of(ELLIPSOID if shape is None else str(shape), options)
    fields = () if is_file else REGION_SHAPES.entry(choice.kind, "shape").settings.model_fields
    for name in options:
        if name not in fields:
            near = difflib.get_close_matches(name, [*_OWN, *fields], n=3, cutoff=0.4)
            hint = f"nearest: {', '.join(near)}; " if near else ""
            raise UserError(f"no property {name!r} in a region of this shape; {hint}correct its name")
    return None if is_file else choice


_OWN = (
    "part",
    "mode",
    "prompt",
    "negative_prompt",
    "filename",
    "shape",
    "to_world",
    "face_normals",
    "flip_normals",
    "silent",
)
"""Properties of a region that are none of its shape's: ours, and those that Mitsuba gives every shape."""


def _plain(value: Any) -> Any:
    """A number, text, or a list of numbers for a vector."""
    if isinstance(value, (bool, int, float, str)):
        return value
    try:
        return np.array(value, dtype=np.float64).ravel().tolist()
    except (TypeError, ValueError):
        return str(value)


def _focal_region(mi: Any, properties: Any) -> Any:
    links = (mi.Properties.Type.Reference, mi.Properties.Type.ResolvedReference, mi.Properties.Type.Object)
    # Reading a property tells Mitsuba that it is known.
    known = {name: properties[name] for name in properties.keys() if properties.type(name) not in links}
    transform = known.get("to_world", mi.ScalarTransform4f())
    vertices, faces = region_triangles(mi, known, np.array(transform.matrix, dtype=np.float64))
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
            self.base = properties.get("base", "")
            self.unit = properties.get("unit", "")
            self.only_these_regions = properties.get("only_these_regions", False)
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
