"""GLBs for the page, through the package's own export: so that what is shown is what is handed over."""

from __future__ import annotations

import pygltflib as gltf

from fd_mitsuba.config.choice import Choice
from fd_mitsuba.export.base_shapes import base_shapes
from fd_mitsuba.export.formats import AS_IT_IS, EXPORTERS, ExportContent
from fd_mitsuba.export.gltf import ROOT_NAME
from fd_mitsuba.scene.edit_scene import EditScene


def base_glb(scene: EditScene) -> bytes:
    """The base with its textures and vertex colours, analytic shapes too; user frame.

    Raises:
        UserError: a file of the scene that cannot be read any more.
    """
    inputs = scene.inputs
    written: dict[str, bytes] = {}
    shapes = base_shapes(scene, inputs.scene)
    content = ExportContent(scene, inputs, shapes, [], None, {}, {}, {}, {}, written.__setitem__)
    EXPORTERS.make(Choice.of("glb", {"unit": AS_IT_IS}), "--format").write(content)
    return next(iter(written.values()))


def only_parts(asset: bytes, parts: list[str]) -> bytes:
    """An exported GLB with nothing shown but the nodes `part_<name>` of these parts; buffers stay as they are.

    They are in the scene's own unit, as everything on the page is, also where the file is in metres.
    """
    file = gltf.GLTF2.load_from_bytes(asset)
    assert file is not None
    wanted = {f"part_{name}" for name in parts} | {f"cut_face_{name}" for name in parts}
    scene = file.scenes[file.scene or 0]
    nodes = scene.nodes or []
    if len(nodes) == 1 and file.nodes[nodes[0]].name == ROOT_NAME:
        root = file.nodes[nodes[0]]
        nodes, root.children = root.children or [], []
    scene.nodes = [index for index in nodes if file.nodes[index].name in wanted]
    return b"".join(file.save_to_bytes())
