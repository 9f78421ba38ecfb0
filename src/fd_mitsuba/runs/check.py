"""What can be said about a run before anyone waits for it: the base, the regions, the cost, and what to improve."""

from __future__ import annotations

import numpy as np

from fd_mitsuba.config import RunConfig, misfits
from fd_mitsuba.config.for_model import is_builtin
from fd_mitsuba.conventions import GRID_HALF_EXTENT
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.model_vocabulary import vocabulary_of
from fd_mitsuba.guidance.prompt_reader import PromptReading
from fd_mitsuba.guidance.understood_prompt import understood_part_prompt, understood_prompt
from fd_mitsuba.io.float_steps import size_warnings
from fd_mitsuba.runs.check_report import BaseCheck, CheckReport, RegionCheck
from fd_mitsuba.runs.choices import checked_choices
from fd_mitsuba.runs.cost import estimate_cost
from fd_mitsuba.runs.model_check import check_model
from fd_mitsuba.runs.prompt_fit import prompt_warnings
from fd_mitsuba.runs.scene_model import model_for_scene
from fd_mitsuba.scene.appearance_inputs import check_appearance_inputs, check_shading
from fd_mitsuba.scene.base_appearance import base_shapes
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.focal_region import FocalRegion
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.part_material import part_material
from fd_mitsuba.scene.region_place import gap_to_base, refuse_hidden_parts, share_in_grid
from fd_mitsuba.scene.triangle_mesh import topology

THINNEST_IN_CELLS = 3.0
"""A region thinner than this many cells of the grid loses its shape in the marching tetrahedra."""


def check_scene(scene: EditScene, config: RunConfig) -> CheckReport:
    """The report on a scene that was loaded, for a run with `config`. Takes seconds; nothing is written.

    Raises:
        UserError: what a run would refuse: a part all of whose regions lie within the base, settings that name what is
            not registered or give it wrong options.
    """
    config, model = model_for_scene(checked_choices(config), scene)
    refuse_hidden_parts(scene.path, scene.regions, scene.base_canonical)
    reading, part_readings, refusal = _prompts(scene, config)
    base = tuple(
        BaseCheck(mesh.name, len(mesh.vertices), len(mesh.faces), mesh.volume(), topology(mesh.vertices, mesh.faces))
        for mesh in scene.base
    )
    cell = 2 * GRID_HALF_EXTENT / config.geometry.grid_resolution
    soup = scene.base_canonical
    distance = MeshDistance(soup.vertices, soup.faces)
    regions = tuple(_region(scene, region, distance, cell) for region in scene.regions)
    cost = estimate_cost(scene, config)
    used = scene.base_soup.vertices[np.unique(scene.base_soup.faces)]
    return CheckReport(
        scene=str(scene.path),
        prompt=scene.prompt,
        base=base,
        base_closed=all(mesh.topology.closed for mesh in base),
        base_low=tuple(used.min(axis=0).tolist()),
        base_high=tuple(used.max(axis=0).tolist()),
        longest_side=float(np.ptp(used, axis=0).max()),
        grid_cell=cell / scene.frame.scale,
        grid_low=_user_corner(scene, -GRID_HALF_EXTENT),
        grid_high=_user_corner(scene, GRID_HALF_EXTENT),
        has_headroom=scene.has_headroom,
        regions=regions,
        cost=cost,
        warnings=tuple(
            _size_warnings(used)
            + _base_warnings(base)
            + _region_warnings(regions, config)
            + _scene_warnings(scene, config)
            + prompt_warnings(scene, config)
            + ([cost.memory_warning] if cost.memory_warning else [])
        ),
        prompt_reading=reading,
        part_readings=part_readings,
        surroundings=tuple(scene.surroundings_ids),
        base_choice=scene.base_choice,
        model_choice=model or "",
        refusal=refusal,
    )


def _prompts(scene: EditScene, config: RunConfig) -> tuple[PromptReading | None, dict[str, PromptReading], str | None]:
    """How the guidance models read the scene's prompt and those of parts, and why a run would refuse models or them."""
    by_words = config.appearance.lambda_sds > 0 and scene.has_light and not scene.subtracts
    asked = {False: config.geometry.lambda_sds > 0, True: by_words}
    reading, parts, refused, model = None, {}, None, config.guidance.model
    try:
        # The built-in prior knows no cuts, so that their material is left as it is; other models paint them, too.
        paints = by_words or (config.appearance.lambda_sds > 0 and scene.has_light and not is_builtin(model))
        check_model(config, asked[False], paints)
    except UserError as error:  # a run loads its model before it reads the prompt
        refused = str(error)
    try:
        for appearance in (stage for stage, wanted in asked.items() if wanted):
            if (vocabulary := vocabulary_of(model, appearance)) is None:
                continue
            found = understood_prompt(scene.prompt, vocabulary, scene.base_prompt, scene.subtracts)
            reading = reading or found
            for part, own in scene.part_prompts.items():
                words = own.prompt, vocabulary, scene.base_prompt, scene.subtracts
                parts.setdefault(part, understood_part_prompt(part, *words))
    except UserError as error:
        return reading, parts, refused or str(error)
    return reading, parts, refused


def _user_corner(scene: EditScene, value: float) -> tuple[float, ...]:
    return tuple(float(x) for x in scene.frame.to_user(np.full(3, value)))


def _region(scene: EditScene, region: FocalRegion, distance: MeshDistance, cell: float) -> RegionCheck:
    low, high = region.bounds
    points = low + np.random.default_rng(0).random((6000, 3)) * (high - low)
    points = points[region.sdf(points) > 0]
    return RegionCheck(
        name=region.name,
        part=region.part,
        share_in_grid=share_in_grid(region),
        gap_to_base=gap_to_base(region, distance, scene.base_canonical) / scene.frame.scale,
        share_in_base=float(np.mean(distance.inside(points))) if len(points) else 0.0,
        volume_cells=region.volume / cell**3,
        thickness_cells=region.thickness / cell,
    )


def _size_warnings(used: np.ndarray) -> list[str]:
    return [f"base: {warning}" for warning in size_warnings(used)]


def _base_warnings(base: tuple[BaseCheck, ...]) -> list[str]:
    warnings = []
    for mesh in base:
        found, name = mesh.topology, f"base {mesh.name}"
        if not found.closed and found.boundary_edges:
            warnings.append(
                f"{name}: not closed ({found.boundary_edges} boundary edges); its holes count as filled "
                "where most of the surface around them exists: fill them if the part grows there"
            )
        if found.misoriented_edges:
            warnings.append(
                f"{name}: {found.misoriented_edges} edges between faces that point opposite ways; "
                "make the faces point outwards"
            )
        if found.nonmanifold_edges:
            warnings.append(f"{name}: {found.nonmanifold_edges} edges with more than two faces; harmless for editing")
        if found.degenerate_faces:
            warnings.append(f"{name}: {found.degenerate_faces} faces without area; remove them")
        if found.duplicate_faces:
            warnings.append(f"{name}: {found.duplicate_faces} faces are there twice; remove the copies")
        if mesh.faces > 1_000_000:
            warnings.append(f"{name}: {mesh.faces} faces make every step slower; a tenth of them is enough")
    return warnings


def _region_warnings(regions: tuple[RegionCheck, ...], config: RunConfig) -> list[str]:
    warnings = []
    for region in regions:
        name = f"region {region.name}"
        if region.share_in_grid < 0.999:  # half a percent is a cap of 8 % of a half-axis, flat for all to see
            warnings.append(
                f"{name}: {1 - region.share_in_grid:.1%} of it lies outside the grid and cannot be edited; "
                "move or shrink it until it fits the grid's extent above"
            )
        if region.gap_to_base > 0:
            warnings.append(
                f"{name}: a gap of {region.gap_to_base:.3g} to the base; the part may float: "
                "move it until they overlap a little"
            )
        if region.share_in_base > 0.9:
            warnings.append(
                f"{name}: {region.share_in_base:.0%} of it is inside the base, where nothing is seen; "
                "move it outwards or enlarge it"
            )
        if region.thickness_cells < THINNEST_IN_CELLS:
            resolution = config.geometry.grid_resolution
            needed = int(np.ceil(resolution * THINNEST_IN_CELLS / max(region.thickness_cells, 1e-9)))
            cure = f"set geometry.grid_resolution={needed} or thicken it" if needed <= 256 else "thicken it"
            warnings.append(f"{name}: only {region.thickness_cells:.1f} grid cells thin; {cure}")
    return warnings


def _scene_warnings(scene: EditScene, config: RunConfig) -> list[str]:
    warnings = list(scene.warnings)
    if not scene.base_prompt:
        warnings.append("no base_prompt: preservation scores and before/after prompts lack it; describe the base")
    elif scene.base_prompt.casefold() == scene.prompt.casefold():
        wanted = "take off" if scene.subtracts else "add"
        warnings.append(f"prompt and base_prompt are the same; name in the prompt what to {wanted}")
    if scene.has_light:
        try:
            warnings += check_appearance_inputs(scene)
            part_material(scene, config.appearance.fixed, config.appearance.normal_map)
        except UserError as error:
            warnings.append(f"no material can be learned, only a shape (--stage geometry): {error}")
    else:
        warnings.append("no emitter: previews use a lamp of their own; add an envmap for the appearance")
        try:
            warnings += check_shading(scene, *base_shapes(scene))
        except UserError as error:
            warnings.append(str(error))
    warnings += misfits(config)
    if config.geometry.lambda_focal == 0:
        warnings.append("geometry.lambda_focal=0: nothing keeps the part in its region")
    return warnings
