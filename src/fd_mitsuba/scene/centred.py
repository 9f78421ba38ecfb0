"""A scene far from the origin, moved to it in 64 bits before Mitsuba makes 32 of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from fd_mitsuba.backend.startup import NORMALS, VERTICES
from fd_mitsuba.scene.double_positions import has_normals, read_positions

if TYPE_CHECKING:
    from fd_mitsuba.scene.scene_file import SceneElement, SceneFile

_PLACED_EMITTERS = ("point", "spot", "projector")
"""Emitters with a place of their own; those of shapes go with these, all others are infinitely far away."""


def move_nodes(mi: Any, nodes: list[Any], origin: np.ndarray) -> None:
    """Subtract `origin` (3,) from the places of parsed top-level objects: shapes, placed lights, sensors."""
    back = mi.ScalarTransform4d().translate((-origin).tolist())
    for node in nodes:
        kind, properties = str(node.type).rpartition(".")[2].lower(), node.props
        if kind not in ("shape", "sensor") and properties.plugin_name() not in _PLACED_EMITTERS:
            continue
        if "position" in properties:
            properties["position"] = (np.array(properties["position"], dtype=np.float64) - origin).tolist()
            continue
        placed = properties["to_world"] if "to_world" in properties else mi.ScalarTransform4d()
        matrix = np.array(back.matrix, dtype=np.float64) @ np.array(placed.matrix, dtype=np.float64)
        properties["to_world"] = type(back)(matrix.tolist())


def restore_digits(file: SceneFile, scene: Any, pairs: list[tuple[SceneElement, Any]], origin: np.ndarray) -> None:
    """Give meshes of a loaded, moved scene the positions that their files have in more than 32 bits."""
    parameters, changed = file.mi.traverse(scene), False
    keys = [key for key in parameters.keys() if key.endswith(f".{VERTICES}") or key == VERTICES]
    meshes = [shape for _, shape in pairs if VERTICES in file.mi.traverse(shape)]
    if len(keys) != len(meshes):
        return
    key_of = {id(shape): key for shape, key in zip(meshes, keys, strict=True)}
    for element, shape in pairs:
        filename = element.properties.get("filename")
        key = key_of.get(id(shape))
        if not isinstance(filename, str) or key is None:
            continue
        exact = read_positions(file.resolve(filename))
        if exact is None:
            continue
        placed = element.properties.get("to_world")
        matrix = np.eye(4) if placed is None else np.array(placed.matrix, dtype=np.float64)
        world = exact @ matrix[:3, :3].T + (matrix[:3, 3] - origin)
        loaded = np.array(parameters[key], dtype=np.float64).reshape(-1, 3)
        steps = np.spacing(np.float32(np.abs(exact).max())) * np.linalg.norm(matrix[:3, :3], 2)
        if world.shape != loaded.shape or np.abs(world - loaded).max() > 8 * steps:
            continue
        normals = f"{key.removesuffix(VERTICES)}{NORMALS}"
        kept = np.array(parameters[normals]) if normals in parameters and has_normals(file.resolve(filename)) else None
        parameters[key] = np.ascontiguousarray(world.ravel(), dtype=np.float32)
        if kept is not None:
            parameters[normals] = kept
        changed = True
    if changed:
        parameters.update()
