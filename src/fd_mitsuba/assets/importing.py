"""From a mesh file of any kind to a scene to edit."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fd_mitsuba.assets.orientation import find_orientation, read_axis
from fd_mitsuba.assets.placing import prompted_regions
from fd_mitsuba.assets.readers import read_asset
from fd_mitsuba.assets.scene_writer import SceneText, write_scene
from fd_mitsuba.assets.shapes import SceneShape, scene_shapes
from fd_mitsuba.errors import UserError
from fd_mitsuba.io.float_steps import size_problem
from fd_mitsuba.scene.enclosure import encloses_volume
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.normalisation import Normalisation
from fd_mitsuba.scene.part_stack import UNITS
from fd_mitsuba.scene.region_words import ObjectPlaces
from fd_mitsuba.scene.triangle_mesh import TriangleMesh
from fd_mitsuba.scene.usual_regions import PromptedParts, usual_place

_MANY_SHAPES = 64


@dataclass(frozen=True)
class ImportedAsset:
    """A scene that was made of an asset.

    Attributes:
        scene: its `scene.xml`.
        low, high: (3,) corners of the object's box in the scene's frame and unit.
        shapes, faces: how many.
        regions: a sentence for each focal region.
        remarks: what was guessed, with the option that says otherwise.
        notes: what was left out or understood in another way.
        refusal: why a run refuses the scene as it is; None: it was not asked, or it does not.
    """

    scene: Path
    low: np.ndarray
    high: np.ndarray
    shapes: int
    faces: int
    regions: tuple[str, ...]
    remarks: tuple[str, ...]
    notes: tuple[str, ...]
    refusal: str | None = None

    def lines(self) -> list[str]:
        """All of it for people."""
        size = " x ".join(f"{value:.4g}" for value in self.high - self.low)
        count = f"{self.shapes} shape{'s' if self.shapes != 1 else ''}"
        lines = [f"{self.scene}: {count}, {self.faces} faces, {size} (width x height x depth)"]
        lines += [f"region   {line}" for line in self.regions]
        lines += [f"guess    {line}" for line in self.remarks]
        lines += [f"note     {line}" for line in self.notes]
        return lines + ([f"refused  a run refuses the scene as it is: {self.refusal}"] if self.refusal else [])


def import_file(
    path: Path,
    folder: Path,
    light: Path,
    prompt: str | None = None,
    base_prompt: str | None = None,
    up: str | None = None,
    front: str | None = None,
    units: str | None = None,
    at: Sequence[str] = (),
    size: str | None = None,
    subtract: bool = False,
    asked: PromptedParts | None = None,
) -> ImportedAsset:
    """Write a scene to edit; see `api.import_asset`.

    Args:
        light: the EXR that lights it.
        asked: what the prompt asks for; None: nothing is known of it.

    Raises:
        UserError: an asset that cannot be read or edited, options that are wrong, a folder with something in it.
    """
    wanted = tuple(
        None if text is None else read_axis(option, text) for option, text in (("--up", up), ("--front", front))
    )
    if units is not None and units not in UNITS:
        raise UserError(f"--units {units}: give one of {', '.join(UNITS)}")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UserError(f"{folder}: is not an empty folder; choose another with -o")
    asset = read_asset(path)
    notes = list(asset.notes)
    shapes = scene_shapes(asset, notes)
    vertices, faces = _whole(path, shapes)
    suffix = Path(asset.packed or path).suffix.lower()
    orientation = find_orientation(vertices, faces, suffix, (asset.up, asset.front), (wanted[0], wanted[1]))
    to_scene = orientation.matrix()
    places = ObjectPlaces(vertices @ to_scene[:3, :3].T, faces)
    asked = asked or PromptedParts()
    regions, about = prompted_regions(places, asked, at, size, subtract)
    words = _words(path)
    text = SceneText(
        prompt=prompt or words,
        base_prompt=base_prompt or asked.body or words,
        light=light,
        comment=f"Made of {path.name} by fd_mitsuba import.",
        unit=units or asset.unit,
    )
    scene = write_scene(folder, shapes, to_scene, regions, text, notes)
    if len(shapes) > _MANY_SHAPES:
        notes.append(f"its {len(shapes)} shapes make renders slow; join those of one look before the export")
    remarks = list(orientation.remarks)
    if not at and len(regions) > 1:
        remarks.append("puts each part where such a part usually is; an --at for each, in their order, says otherwise")
    elif not at:
        usual = usual_place(asked.only, asked.headless)
        where = "on its head" if usual == "head" else f"at {places.find(usual).about}"
        remarks.append(f"puts the region {where}; --at says otherwise: top, back, 'left side', x,y,z and the like")
    if prompt is None:
        remarks.append(f"calls it {text.prompt!r}; give the prompt of a run with --prompt")
    return ImportedAsset(
        scene,
        places.low,
        places.high,
        len(shapes),
        len(faces),
        tuple(about),
        tuple(remarks),
        tuple(dict.fromkeys(notes)),
        _refusal(scene) if subtract else None,
    )


def _whole(path: Path, shapes: list[SceneShape]) -> tuple[np.ndarray, np.ndarray]:
    """All shapes as one soup in the asset's frame, which encloses a volume and has a size."""
    placed = [shape.placed() for shape in shapes]
    starts = np.cumsum([0] + [len(vertices) for vertices in placed[:-1]])
    vertices = np.concatenate(placed)
    faces = np.concatenate([shape.faces + start for shape, start in zip(shapes, starts, strict=True)])
    if not len(faces):
        raise UserError(f"{path}: has no faces; save a surface")
    used = vertices[np.unique(faces)]
    if not np.isfinite(used).all():
        raise UserError(f"{path}: has positions that are NaN or infinite; save the mesh anew")
    try:
        frame = Normalisation.of_points(used)
    except ValueError:
        raise UserError(f"{path}: all its vertices are at one point; give a mesh with a size") from None
    if problem := size_problem(float(np.ptp(used, axis=0).max())):
        raise UserError(f"{path}: {problem}")
    if not encloses_volume(TriangleMesh("base", frame.to_canonical(vertices), faces)):
        raise UserError(f"{path}: its {len(faces)} faces enclose no volume; give a solid object, closed or nearly so")
    return vertices, faces


def _refusal(scene: Path) -> str | None:
    """Why nothing can be cut out of what was written, if so: the mesh is not closed, or all of it would go."""
    try:
        load_edit_scene(scene)
    except UserError as error:
        return str(error)
    return None


def _words(path: Path) -> str:
    """The file's name in words, as in "a rubber duck"."""
    text = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", path.stem)
    words = [word for word in re.split(r"[\W_]+", text) if word and not word.isdigit()]
    name = " ".join(words).lower() or "thing"
    return f"{'an' if name[0] in 'aeiou' else 'a'} {name}"
