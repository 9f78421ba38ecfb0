"""What to edit, read from a Mitsuba scene: the base's triangles, the focal regions, the prompts."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from fd_mitsuba.conventions import BASE_NAME
from fd_mitsuba.io.float_steps import is_coarse
from fd_mitsuba.scene.edit_inputs import EditInputs
from fd_mitsuba.scene.focal_region import SUBTRACT, FocalRegion, PartPrompt
from fd_mitsuba.scene.normalisation import Normalisation
from fd_mitsuba.scene.part_stack import StackedPart, free_name
from fd_mitsuba.scene.region_prompt import part_prompts
from fd_mitsuba.scene.scene_file import SceneElement
from fd_mitsuba.scene.triangle_mesh import TriangleMesh


@dataclass(frozen=True)
class EditScene:
    """A scene to edit; frozen, with nothing of Mitsuba's instantiated in it.

    Attributes:
        path: the scene file.
        inputs: the parsed files, for all that asks more of them: a file is read and checked once.
        parameters: the `-D` values that the scene file was read with.
        prompt: what the edited object shall look like; never blank.
        base_prompt: what the base looks like, "" if not given.
        negative_prompt: what to keep away from, "" if not given.
        base: the base's meshes in the user frame, after their `to_world`.
        base_elements: the shapes in the file that they are of, one each.
        surroundings: the file's other shapes, regions and area lights apart: light and shadow of the appearance stage
            and of renders know them, nothing else.
        base_choice: a line that tells which shapes are edited, where that was found out; else "".
        regions: the focal regions, in the canonical frame.
        frame: the map between the two frames.
        files: every file that is read, the scene file and its includes first.
        has_light: whether the scene has an emitter of any kind.
        has_part_bsdf: whether there is a top-level BSDF with the id "part".
        regions_path: the file of regions beside the scene; None: the scene says itself.
        regions_parameters: the `-D` values that it was read with.
        earlier: the parts of earlier rounds, which are among the meshes of `base`.
        unit: what a unit of the user frame is: "mm", "cm", "m", or None where the scene does not say.
        warnings: what is wrong with its files but was mended, and what Mitsuba warned of, a line each.
    """

    path: Path
    inputs: EditInputs = field(repr=False, compare=False)
    prompt: str
    base: tuple[TriangleMesh, ...]
    regions: tuple[FocalRegion, ...]
    frame: Normalisation
    base_elements: tuple[SceneElement, ...] = field(default=(), repr=False, compare=False)
    surroundings: tuple[SceneElement, ...] = field(default=(), repr=False, compare=False)
    base_choice: str = ""
    base_prompt: str = ""
    negative_prompt: str = ""
    parameters: dict[str, str] = field(default_factory=dict)
    files: tuple[Path, ...] = ()
    has_light: bool = False
    has_part_bsdf: bool = False
    regions_path: Path | None = None
    regions_parameters: dict[str, str] = field(default_factory=dict)
    earlier: tuple[StackedPart, ...] = ()
    warnings: tuple[str, ...] = ()
    unit: str | None = None

    @property
    def parts(self) -> dict[str, tuple[FocalRegion, ...]]:
        """Part name -> its regions, in the order of the scene file."""
        names = dict.fromkeys(region.part for region in self.regions)
        return {name: tuple(region for region in self.regions if region.part == name) for name in names}

    @property
    def part_prompts(self) -> dict[str, PartPrompt]:
        """Part name -> its own prompt, of the parts that have one."""
        return part_prompts(self.regions)

    def prompt_of(self, part: str) -> str:
        """What a part is to be: its own prompt, or the scene's."""
        own = self.part_prompts.get(part)
        return self.prompt if own is None else own.prompt

    @property
    def told_apart(self) -> bool:
        """Whether all parts have prompts of their own."""
        return set(self.part_prompts) == set(self.parts)

    @property
    def subtracts(self) -> bool:
        """Whether the parts are cut out of the base instead of added; all regions agree."""
        return bool(self.regions) and self.regions[0].mode == SUBTRACT

    @cached_property
    def has_headroom(self) -> bool:
        """Whether the canonical frame differs from the paper's, so that it holds the regions."""
        soup = self.base_soup
        paper = Normalisation.of_points(soup.vertices[np.unique(soup.faces)])
        return paper.scale != self.frame.scale or not np.array_equal(paper.centre, self.frame.centre)

    @cached_property
    def origin(self) -> np.ndarray:
        """(3,) what to subtract from the user frame's coordinates before they become 32-bit floats: 0 unless the base
        lies so far away that these are too coarse."""
        used = self.base_soup.vertices[np.unique(self.base_soup.faces)]
        return np.round(self.frame.centre) if is_coarse(used) else np.zeros(3)

    @cached_property
    def render_frame(self) -> Normalisation:
        """The map from the canonical frame to that in which Mitsuba renders: the user frame without `origin`."""
        return self.frame if not self.origin.any() else Normalisation(self.frame.centre - self.origin, self.frame.scale)

    @cached_property
    def render_base(self) -> tuple[TriangleMesh, ...]:
        """`base` in the frame in which Mitsuba renders."""
        if not self.origin.any():
            return self.base
        return tuple(replace(mesh, vertices=mesh.vertices - self.origin) for mesh in self.base)

    @cached_property
    def base_soup(self) -> TriangleMesh:
        """All base meshes as one, user frame, vertices not welded: for distances, not for export."""
        return as_one(self.base)

    @property
    def base_box(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner (3,) of the base, user frame."""
        used = self.base_soup.vertices[np.unique(self.base_soup.faces)]
        return used.min(axis=0), used.max(axis=0)

    @cached_property
    def base_canonical(self) -> TriangleMesh:
        """`base_soup` in the canonical frame."""
        soup = self.base_soup
        return TriangleMesh(BASE_NAME, self.frame.to_canonical(soup.vertices), soup.faces, soup.source_files)

    @cached_property
    def surroundings_ids(self) -> list[str]:
        """What each of `surroundings` is called in exports: its id, or one that no shape has yet."""
        taken = {shape.id for shape in self.inputs.scene.top_level("shape")}
        names = []
        for shape in self.surroundings:
            names.append(shape.id or free_name("surroundings", taken))
            taken.add(names[-1])
        return names

    def mitsuba_scene(self, without: tuple[str, ...] = ()) -> Any:
        """The scene file as an `mi.Scene` in the render frame without its surroundings; see `SceneFile.instantiate`."""
        file = self.inputs.scene
        shapes = None
        if self.surroundings:
            around = {id(shape) for shape in self.surroundings}
            shapes = [shape for shape in file.top_level("shape") if id(shape) not in around]
        return file.instantiate(without, self.origin, shapes)

    def mitsuba_surroundings(self) -> Any | None:
        """The surroundings alone as an `mi.Scene` in the render frame; None without any."""
        if not self.surroundings:
            return None
        return self.inputs.scene.instantiate(("sensor", "integrator", "emitter"), self.origin, self.surroundings)


def as_one(meshes: tuple[TriangleMesh, ...]) -> TriangleMesh:
    """All meshes as one, called the base, vertices not welded."""
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    faces = [mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=True)]
    sources = tuple(dict.fromkeys(source for mesh in meshes for source in mesh.source_files))
    return TriangleMesh(BASE_NAME, np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces), sources)
