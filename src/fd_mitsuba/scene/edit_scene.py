"""What to edit, read from a Mitsuba scene: the base's triangles, the focal regions, the prompts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from fd_mitsuba.conventions import BASE_NAME
from fd_mitsuba.errors import UserError
from fd_mitsuba.io.float_steps import is_coarse, size_problem
from fd_mitsuba.scene.base_choice import choose_base
from fd_mitsuba.scene.edit_inputs import EditInputs
from fd_mitsuba.scene.enclosure import encloses_volume
from fd_mitsuba.scene.finite_numbers import refuse_broken_parameters, refuse_broken_properties
from fd_mitsuba.scene.focal_region import SUBTRACT, FocalRegion, PartPrompt
from fd_mitsuba.scene.headroom import frame_with_headroom
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.normalisation import Normalisation
from fd_mitsuba.scene.part_names import part_names
from fd_mitsuba.scene.part_stack import RECORD_NAME, StackedPart, earlier_parts, free_name
from fd_mitsuba.scene.region_element import read_region
from fd_mitsuba.scene.region_mode import check_modes
from fd_mitsuba.scene.region_place import gap_to_base, misplacement
from fd_mitsuba.scene.region_prompt import check_prompts, part_prompts
from fd_mitsuba.scene.scene_file import SceneElement, SceneFile
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
        return _soup(self.base)

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


def load_edit_scene(
    path: Path | str,
    parameters: dict[str, str] | None = None,
    regions: Path | str | None = None,
    prompt: str | None = None,
    on_misplaced: Callable[[UserError], None] | None = None,
    needs_region: bool = True,
) -> EditScene:
    """Read a scene file, check it, and load it once in Mitsuba so that later loading cannot fail.

    Args:
        path: the XML file.
        parameters: values for `$name`, as given with `-D name=value`.
        regions: an XML file whose focal regions, `dual_path` integrator and `<bsdf id="part">` are taken too, in the
            frame of the scene.
        prompt: takes the place of the integrator's; a scene without `dual_path`, as an exported one, needs it.
        on_misplaced: takes what is wrong with the place of a region, which is then kept as it is, so that a picture can
            show it; None: it is raised.
        needs_region: False: a scene without regions is taken as it is, for a picture of its base.

    Raises:
        UserError: any input that cannot be edited, in one line with file, element and remedy.
    """
    inputs = EditInputs.open(Path(path), parameters or {}, None if regions is None else Path(regions))
    file = inputs.scene
    for source in inputs.sources:
        refuse_broken_properties(source)
    elements = inputs.region_elements()

    def provisional(frame: Normalisation) -> list[FocalRegion]:
        return [read_region(owner, element, index, "", frame) for index, (owner, element) in enumerate(elements)]

    choice = choose_base(inputs, provisional)
    base = choice.meshes
    earlier = earlier_parts(file.path, base)
    latest = max(earlier, key=lambda part: part.round, default=None)
    if not needs_region and prompt is None and not inputs.has_prompt:
        prompt = file.path.resolve().parent.name or "a scene"
    prompts = inputs.prompts(prompt, "" if latest is None else latest.prompt)
    if not base:
        raise _without_base(file)
    frame = _frame(file, base)
    if not elements and needs_region:
        remedy = 'add <shape type="focal_region" id="..."> where to edit, or give a file with it by --regions'
        raise UserError(f"{inputs.sources[-1].path}: no focal region; {remedy}")
    names = part_names([element for _, element in elements], earlier)
    found = tuple(
        read_region(owner, element, index, names[index], frame) for index, (owner, element) in enumerate(elements)
    )
    soup = _soup(base)
    roomy = frame_with_headroom(frame, soup.vertices[np.unique(soup.faces)], found)
    if roomy is not frame:
        found = tuple(region.seen_from(roomy.matrix() @ np.linalg.inv(frame.matrix())) for region in found)
        frame = roomy
    soup = TriangleMesh(BASE_NAME, frame.to_canonical(soup.vertices), soup.faces)
    distance = MeshDistance(soup.vertices, soup.faces)
    gaps = [gap_to_base(region, distance, soup) for region in found]
    for (_, element), region, gap in zip(elements, found, gaps, strict=True):
        if problem := misplacement(region, gap, frame):
            error = element.error(problem)
            if on_misplaced is None:
                raise error
            on_misplaced(error)
    check_modes([element for _, element in elements], found, base, frame)
    check_prompts([element for _, element in elements], found)
    for source in inputs.sources:
        refuse_broken_parameters(source, source.instantiate())
    folder = file.path.parent
    record = [folder / RECORD_NAME, *(part.normal_path(folder) for part in earlier)]
    return EditScene(
        path=file.path,
        inputs=inputs,
        prompt=prompts[0],
        base=base,
        base_elements=choice.base,
        surroundings=choice.surroundings,
        base_choice=choice.how,
        regions=found,
        frame=frame,
        base_prompt=prompts[1],
        negative_prompt=prompts[2],
        parameters=file.parameters,
        files=(*inputs.files, *(path for path in record if path is not None and path.is_file())),
        has_light=any(element.kind == "emitter" for element in file.elements),
        has_part_bsdf=inputs.part_bsdf()[1] is not None,
        regions_path=inputs.regions.path if inputs.regions else None,
        regions_parameters=inputs.regions.parameters if inputs.regions else {},
        earlier=earlier,
        unit=inputs.unit(),
        warnings=tuple(dict.fromkeys(line for source in inputs.sources for line in source.warnings)),
    )


def load_base(path: Path | str, parameters: Mapping[str, str] | None = None) -> tuple[TriangleMesh, ...]:
    """The base's meshes in the user frame, of a scene that need not have regions or a prompt yet.

    Raises:
        UserError: a scene that cannot be read, or without a base.
    """
    file = SceneFile(Path(path), dict(parameters or {}))
    refuse_broken_properties(file)
    base = choose_base(EditInputs(file)).meshes
    if not base:
        raise _without_base(file)
    return base


def _without_base(file: SceneFile) -> UserError:
    return UserError(f'{file.path}: no base shape; add the object to edit, such as <shape type="ply" id="base">')


def _soup(meshes: tuple[TriangleMesh, ...]) -> TriangleMesh:
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    faces = [mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=True)]
    sources = tuple(dict.fromkeys(source for mesh in meshes for source in mesh.source_files))
    return TriangleMesh(BASE_NAME, np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces), sources)


def _frame(file: SceneFile, base: tuple[TriangleMesh, ...]) -> Normalisation:
    soup = _soup(base)
    names = ", ".join(mesh.name for mesh in base)
    used = soup.vertices[np.unique(soup.faces)]
    try:
        frame = Normalisation.of_points(used)
    except ValueError:
        raise UserError(
            f"{file.path}: base {names}: all its vertices are at one point; give a mesh with a size"
        ) from None
    if problem := size_problem(float(np.ptp(used, axis=0).max())):
        raise UserError(f"{file.path}: base {names}: {problem}")
    if not encloses_volume(TriangleMesh(BASE_NAME, frame.to_canonical(soup.vertices), soup.faces)):
        count = len(soup.faces)
        raise UserError(
            f"{file.path}: base {names}: its {count} faces enclose no volume; give a solid object, closed or nearly so"
        )
    return frame
