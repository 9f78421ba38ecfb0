"""What became of the base: in the pictures of the result, and in the files that the run hands over."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from fd_mitsuba.backend.file_threads import file_threads
from fd_mitsuba.errors import UserError
from fd_mitsuba.evaluation.judged_views import JudgedViews
from fd_mitsuba.evaluation.picture_difference import psnr, ssim
from fd_mitsuba.io.safe_text import safe_file_name, safe_name
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.mesh_source import BrokenMesh, NotAMesh, shape_triangles
from fd_mitsuba.scene.scene_file import ready_mitsuba

_SURFACE_POINTS = 20_000
Mesh = tuple[np.ndarray, np.ndarray]


def picture_drift(views: JudgedViews) -> dict[str, float | None]:
    """Figures of the base's pixels, edited against base; None where no pixel counts.

    `psnr_db` and `ssim`: over the untouched pixels, which a perfect edit leaves as they were. `psnr_lit_db` and
    `ssim_lit`: over all pixels that show the base alone, where the part's shadows and reflections differ, too.
    `colour_drift`: mean absolute difference of sRGB over the untouched pixels. `untouched_share`: how many of the
    base's pixels these are.
    """
    free = views.base_pixels.sum()
    change = (views.edited - views.base).abs()[views.untouched.expand_as(views.edited)]
    return {
        "psnr_db": psnr(views.edited, views.base, views.untouched),
        "ssim": ssim(views.edited, views.base, views.untouched, views.untouched),
        "psnr_lit_db": psnr(views.edited, views.base, views.base_pixels),
        "ssim_lit": ssim(views.edited, views.base, views.base_pixels, views.base_pixels),
        "colour_drift": float(change.double().mean()) if change.numel() else None,
        "untouched_share": float(views.untouched.sum() / free) if free else 0.0,
    }


def export_drift(scene: EditScene, folder: Path) -> dict[str, Any]:
    """Compare the copies below `folder/export/base` with what the scene reads.

    `chamfer`: see `chamfer`, canonical units, of the exported and the given base. `files`: how many there are;
    `files_identical`: how many have the bytes of their source; `textures`: how many of the files are pictures;
    `texture_difference`: the largest difference of a pixel value, in [0, 1]; `missing`: sources without a copy.
    """
    exported = folder / "export" / "base"
    sources = {path for mesh in scene.base for path in mesh.source_files}
    pictures = set(_pictures(scene))
    copies = {source: _copy_of(source, exported) for source in sources | pictures}
    present = {source: copy for source, copy in copies.items() if copy is not None}
    same = [_sha(source) == _sha(copy) for source, copy in present.items()]
    differences = [_difference(source, copy) for source, copy in present.items() if source in pictures]
    after = _exported_base(scene, exported, copies)
    return {
        "chamfer": None if after is None else chamfer(after, (scene.base_soup.vertices, scene.base_soup.faces))
        * scene.frame.scale,
        "files": len(present),
        "files_identical": sum(same),
        "textures": len(differences),
        "texture_difference": max(differences, default=0.0),
        "missing": sorted(source.name for source, copy in copies.items() if copy is None),
    }  # fmt: skip


def chamfer(one: Mesh, other: Mesh, seed: int = 0) -> float:
    """Half the sum of the mean distances from either surface to the other, in the unit of the meshes.

    Each mean is over all vertices and 20 000 points that are uniform by area; distances are not squared.
    """
    means = []
    for source, target in ((one, other), (other, one)):
        mesh = trimesh.Trimesh(*source, process=False)
        points = trimesh.sample.sample_surface(mesh, _SURFACE_POINTS, seed=seed)[0]
        distance = MeshDistance(*target)
        vertices = np.asarray(source[0])[np.unique(source[1])]
        means.append(float(np.concatenate([distance.unsigned(vertices), distance.unsigned(points)]).mean()))
    return sum(means) / 2


def _exported_base(scene: EditScene, exported: Path, copies: dict[Path, Path | None]) -> Mesh | None:
    """All base shapes as the exported files have them, user frame; None if one is missing."""
    vertices, faces, first = [], [], 0
    for element, mesh in zip(scene.base_elements, scene.base, strict=True):
        properties = {name: value for name, value in element.properties.items() if name != "to_world"}
        transform, plugin = element.properties.get("to_world"), element.plugin
        to_world = np.eye(4) if transform is None else np.array(getattr(transform, "matrix", transform), np.float64)
        if mesh.source_files:
            path = copies[mesh.source_files[0]]
        else:  # an analytic shape is exported as triangles in the user's frame
            path, plugin, properties, to_world = exported / safe_name(mesh.name, suffix=".ply"), "ply", {}, np.eye(4)
        if path is None or not path.is_file():
            return None
        try:
            points, triangles = shape_triangles(
                ready_mitsuba(), plugin, {**properties, "filename": str(path)}, to_world
            )
        except (BrokenMesh, NotAMesh, RuntimeError) as error:
            raise UserError(f"{path}: is damaged ({error}); export the run anew") from None
        vertices.append(points)
        faces.append(triangles + first)
        first += len(points)
    return np.concatenate(vertices), np.concatenate(faces)


def _pictures(scene: EditScene) -> Iterator[Path]:
    """Files of the textures of the base's shapes."""
    file, waiting = scene.inputs.scene, [*scene.base_elements]
    while waiting:
        element = waiting.pop()
        name = element.properties.get("filename")
        if element.kind == "texture" and isinstance(name, str):
            yield file.resolve(name)
        waiting += [file.elements[position] for position in element.children.values()]


def _copy_of(source: Path, folder: Path) -> Path | None:
    """The copy with the source's bytes; else one with its name, maybe after a prefix; None if there is none."""
    wanted = f"_{safe_file_name(source.name)}"
    named = sorted(path for path in folder.glob("*") if f"_{path.name}".endswith(wanted))
    return next((path for path in named if _sha(path) == _sha(source)), named[0] if named else None)


def _difference(source: Path, copy: Path) -> float:
    if _sha(source) == _sha(copy):
        return 0.0
    mi = ready_mitsuba()
    with file_threads():
        try:
            before, after = (np.array(mi.Bitmap(str(path))) for path in (source, copy))
        except RuntimeError:  # an image that cannot be read any more is another one
            return 1.0
    if before.shape != after.shape:
        return 1.0
    whole = np.iinfo(before.dtype).max if before.dtype.kind == "u" else 1.0
    return float(np.abs(before.astype(np.float64) - after.astype(np.float64)).max() / whole)


def _sha(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
