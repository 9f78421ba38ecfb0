"""Reading a scene to edit: all that can be wrong with it is said here, in one line, before anything is rendered."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from fd_mitsuba.conventions import BASE_NAME
from fd_mitsuba.errors import UserError
from fd_mitsuba.io.float_steps import size_problem
from fd_mitsuba.scene.base_choice import choose_base
from fd_mitsuba.scene.edit_inputs import EditInputs
from fd_mitsuba.scene.edit_scene import EditScene, as_one
from fd_mitsuba.scene.enclosure import encloses_volume
from fd_mitsuba.scene.finite_numbers import refuse_broken_parameters, refuse_broken_properties
from fd_mitsuba.scene.focal_region import FocalRegion
from fd_mitsuba.scene.headroom import frame_with_headroom
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.normalisation import Normalisation
from fd_mitsuba.scene.part_names import part_names
from fd_mitsuba.scene.part_stack import RECORD_NAME, earlier_parts
from fd_mitsuba.scene.region_element import read_region
from fd_mitsuba.scene.region_mode import check_modes
from fd_mitsuba.scene.region_place import gap_to_base, misplacement
from fd_mitsuba.scene.region_prompt import check_prompts
from fd_mitsuba.scene.scene_file import SceneFile
from fd_mitsuba.scene.triangle_mesh import TriangleMesh


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
    soup = as_one(base)
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


def scene_prompt(path: Path | str, parameters: Mapping[str, str] | None = None) -> str | None:
    """The prompt that a scene gives itself; None: none.

    Raises:
        UserError: a scene that cannot be read.
    """
    inputs = EditInputs(SceneFile(Path(path), dict(parameters or {})))
    return inputs.prompts(None, "")[0] if inputs.has_prompt else None


def _without_base(file: SceneFile) -> UserError:
    return UserError(f'{file.path}: no base shape; add the object to edit, such as <shape type="ply" id="base">')


def _frame(file: SceneFile, base: tuple[TriangleMesh, ...]) -> Normalisation:
    soup = as_one(base)
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
