"""Is an export what it says? `python benchmarks/check_export.py RUN [--json]` on a finished run with a material.

Reads the files in RUN/export, as another program would, and compares them with the scene and the learned fields:

    base_files_identical      every copy of the base's meshes and pictures has the bytes of its source
    base_hausdorff            between the base in the GLB and that of the scene, at their vertices, share of its size
    frame_round_trip          the user's frame -> canonical -> the user's frame, share of the base's size
    manifold, gap, union      the part's solid, and manifold3d's union with the base where that is closed
    seam_jump, seam_beyond    colours at the two sides of the atlas's seams, in steps of 255; less what the field does
    mip3_stray, mip3_stray_99 mip level 3: beyond all colours that the field has under the filter, worst and 99 %

Exit code 1 if one of them is not as it should be.
"""

from __future__ import annotations

import argparse
import io
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "benchmarks"), str(ROOT / "src")]

import manifold3d  # noqa: E402
import numpy as np  # noqa: E402
import pygltflib  # noqa: E402
import torch  # noqa: E402
import trimesh  # noqa: E402
from machine import print_figures  # noqa: E402
from PIL import Image  # noqa: E402

from fd_mitsuba.evaluation.atlas_faults import foreign_colour, seam_jumps  # noqa: E402
from fd_mitsuba.evaluation.base_drift import export_drift  # noqa: E402
from fd_mitsuba.export.solid.solid import Solid  # noqa: E402
from fd_mitsuba.io.srgb import srgb_from_linear  # noqa: E402
from fd_mitsuba.runs.appearance_outcome import finished_appearance  # noqa: E402
from fd_mitsuba.runs.saved_run import saved_run  # noqa: E402
from fd_mitsuba.scene.edit_scene import EditScene  # noqa: E402
from fd_mitsuba.scene.mesh_distance import MeshDistance  # noqa: E402
from fd_mitsuba.scene.triangle_mesh import topology  # noqa: E402

MOST_JUMP = 2.0
MOST_STRAY, MOST_STRAY_99 = 2.0, 1.0
ROUNDING = 1e-6
"""GLB holds 32-bit numbers; the base itself does, too, but a node's matrix is applied to them anew."""


class Glb:
    """Meshes and pictures of a GLB, in the frame of its scene."""

    def __init__(self, path: Path) -> None:
        self.file = pygltflib.GLTF2().load(str(path))
        self.scene = trimesh.load(path, process=False)

    def mesh(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and faces of the nodes `name` and `name_...`."""
        meshes = []
        for node in self.scene.graph.nodes_geometry:
            if node == name or node.startswith(f"{name}_"):
                place, geometry = self.scene.graph[node]
                meshes.append(self.scene.geometry[geometry].copy().apply_transform(place))
        whole = trimesh.util.concatenate(meshes)
        return np.asarray(whole.vertices), np.asarray(whole.faces)

    def textured(self, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Vertices, faces, UVs with v downwards, and the picture of the base colour, 0 to 255."""
        node = next(node for node in self.file.nodes if node.name == name)
        primitive = self.file.meshes[node.mesh].primitives[0]
        attributes = primitive.attributes
        surface = self.file.materials[primitive.material].pbrMetallicRoughness
        image = self.file.images[self.file.textures[surface.baseColorTexture.index].source]
        view = self.file.bufferViews[image.bufferView]
        data = self.file.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
        picture = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
        faces = self._numbers(primitive.indices).reshape(-1, 3).astype(np.int64)
        return self._numbers(attributes.POSITION), faces, self._numbers(attributes.TEXCOORD_0), picture

    def _numbers(self, index: int) -> np.ndarray:
        item = self.file.accessors[index]
        view = self.file.bufferViews[item.bufferView]
        kind = {5126: "<f4", 5125: "<u4", 5123: "<u2"}[item.componentType]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}[item.type]
        data = self.file.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
        return np.frombuffer(data, kind).reshape(item.count, width).astype(np.float64)


def lossless(scene: EditScene, run: Path, glb: Glb) -> dict[str, Any]:
    """Figures of the base."""
    drift = export_drift(scene, run)
    soup = scene.base_soup
    vertices, faces = glb.mesh("base")
    size = float(np.ptp(soup.vertices, axis=0).max())
    there = MeshDistance(soup.vertices, soup.faces).unsigned(vertices).max()
    back = MeshDistance(vertices, faces).unsigned(soup.vertices).max()
    again = scene.frame.to_user(scene.frame.to_canonical(soup.vertices))
    return {
        "base_files_identical": drift["files_identical"] == drift["files"] > 0 and not drift["missing"],
        "base_hausdorff": float(max(there, back)) / size,
        "frame_round_trip": float(np.abs(again - soup.vertices).max()) / size,
    }


def solid(scene: EditScene, vertices: np.ndarray, faces: np.ndarray) -> dict[str, Any]:
    """Figures of a part, doubled along its seams; `union` is None with an open base, which has none."""
    points, welded = np.unique(vertices, axis=0, return_inverse=True)
    part = Solid(scene.frame.to_canonical(points), welded.reshape(-1)[faces])
    whole: manifold3d.Manifold | None = manifold3d.Manifold()
    for shape in scene.base:
        source = manifold3d.Mesh(scene.frame.to_canonical(shape.vertices).astype(np.float32), shape.faces.astype("u4"))
        source.merge()  # vertices are doubled along seams
        closed = topology(shape.vertices, shape.faces).closed
        whole = whole + manifold3d.Manifold(source) if whole is not None and closed else None
    union = None if whole is None else (whole + part.to_manifold()).status() == manifold3d.Error.NoError
    return {"manifold": part.manifold, "gap": part.gap(scene.base_canonical), "union": union}


def check(run: Path) -> dict[str, Any]:
    """The figures of the module's docstring, the worst of all parts."""
    scene, config = saved_run(run)
    stage = finished_appearance(scene, config, run)
    if stage is None:
        sys.exit(f"{run}: its appearance stage has not begun; run it with --stage appearance")
    glb = Glb(run / "export" / "asset.glb")

    def truth(points: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            values = stage.field(torch.from_numpy(scene.frame.to_canonical(points).astype(np.float32)))
        return 255 * srgb_from_linear(values.base_color.numpy())

    found: dict[str, Any] = lossless(scene, run, glb) | {"manifold": True, "gap": 0.0, "union": True}
    found |= dict.fromkeys(("seams", "seam_jump", "seam_beyond", "mip3_stray", "mip3_stray_99"), 0)
    for name in scene.parts:
        asset = glb.textured(f"part_{name}")
        figures = solid(scene, *asset[:2])
        found["manifold"] &= figures["manifold"]
        found["gap"] = max(found["gap"], figures["gap"])
        found["union"] = figures["union"] and found["union"]
        jumps, stray = seam_jumps(*asset, truth), foreign_colour(*asset, truth)
        measured = {"seam_jump": jumps["jump"], "seam_beyond": jumps["beyond_own"]}
        measured |= {"mip3_stray": stray["stray"], "mip3_stray_99": stray["stray_99"]}
        found |= {key: max(found[key], round(value, 3)) for key, value in measured.items()}
        found["seams"] += jumps["seams"]
    return found


def failures(found: dict[str, Any]) -> list[str]:
    """Names of the figures that are not as they should be."""
    good = {
        "base_files_identical": found["base_files_identical"],
        "base_hausdorff": found["base_hausdorff"] <= ROUNDING,
        "frame_round_trip": found["frame_round_trip"] <= ROUNDING,
        "manifold": found["manifold"],
        "gap": found["gap"] == 0,
        "union": found["union"] is not False,
        "seam_beyond": found["seam_beyond"] <= MOST_JUMP,
        "mip3_stray": found["mip3_stray"] <= MOST_STRAY,
        "mip3_stray_99": found["mip3_stray_99"] <= MOST_STRAY_99,
    }
    return [name for name, holds in good.items() if not holds]


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Compares a run's exported files with its scene and fields.")
    parser.add_argument("run", type=Path)
    parser.add_argument("--json", action="store_true", help="machine-readable")
    options = parser.parse_args()
    found = check(options.run)
    found["failures"] = failures(found)
    print_figures(found, options.json)
    return 1 if found["failures"] else 0


if __name__ == "__main__":
    sys.exit(main())
