"""What can be said about a run before anyone waits for it: the base, the regions, the cost, and what to improve."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fd_mitsuba.config import RunConfig
from fd_mitsuba.conventions import GRID_HALF_EXTENT
from fd_mitsuba.scene.edit_scene import EditScene, gap_to_base, share_in_grid
from fd_mitsuba.scene.focal_region import FocalRegion, union_sdf
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.triangle_mesh import Topology, topology

THINNEST_IN_CELLS = 3.0
"""A region thinner than this many cells of the grid loses its shape in the marching tetrahedra."""

START_AND_EXPORT_SECONDS = 15.0
"""What every run takes besides its steps: imports, kernels, meshes, turntable."""

_OPERATIONS = 6e10
"""Floating-point operations a second of two cores on the networks of Stable Diffusion."""

_REACH = 0.15
"""How far around its regions a part is evaluated: that of `extraction.surface`, without its imports."""


@dataclass(frozen=True)
class BaseCheck:
    """One mesh of the base: sizes, and `Topology` with positions taken as one where they are equal."""

    name: str
    vertices: int
    faces: int
    volume: float
    """Enclosed volume in the user's units; negative where the faces point inwards, rough where the mesh is open."""
    topology: Topology


@dataclass(frozen=True)
class RegionCheck:
    """One focal region, lengths in the user's units."""

    name: str
    part: str
    share_in_grid: float
    gap_to_base: float
    share_in_base: float
    """Share of the region's volume that the base already fills."""
    volume_cells: float
    thickness_cells: float


@dataclass(frozen=True)
class CostEstimate:
    """A rough forecast: within a factor of two on a machine like the one of the assumptions."""

    active_vertices: int
    active_share: float
    seconds_per_step: float
    seconds_total: float
    memory_mb: float
    assumptions: tuple[str, ...]


@dataclass(frozen=True)
class CheckReport:
    """Everything `fd_mitsuba check` prints. A scene that cannot be edited at all never gets here: loading it fails."""

    scene: str
    prompt: str
    base: tuple[BaseCheck, ...]
    base_closed: bool
    longest_side: float
    """Longest side of the base's bounding box in the user's units."""
    grid_cell: float
    """Side of a grid cell in the user's units."""
    grid_low: tuple[float, ...]
    grid_high: tuple[float, ...]
    """Corners of the cube in the user's units within which a part can grow."""
    regions: tuple[RegionCheck, ...]
    cost: CostEstimate
    warnings: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """The report as plain dicts, lists, numbers and strings for `json.dumps`, keys as the attributes."""
        return dataclasses.asdict(self)

    def lines(self) -> list[str]:
        """The report as lines for a person, warnings last."""
        lines = [f"scene    {self.scene}", f"prompt   {self.prompt}"]
        for mesh in self.base:
            found = mesh.topology
            state = "closed" if found.closed else f"open ({found.boundary_edges} boundary edges)"
            pieces = f"{found.components} component{'s' if found.components != 1 else ''}"
            lines.append(f"base     {mesh.name}: {mesh.vertices} vertices, {mesh.faces} faces, {state}, {pieces}")
        lines.append(f"frame    longest side {self.longest_side:.4g}, grid cell {self.grid_cell:.3g} (scene units)")
        spans = zip("xyz", self.grid_low, self.grid_high, strict=True)
        lines.append(f"grid     {', '.join(f'{axis} {low:.4g} to {high:.4g}' for axis, low, high in spans)}")
        for region in self.regions:
            touch = "touches the base" if region.gap_to_base == 0 else f"{region.gap_to_base:.3g} from the base"
            lines.append(
                f"region   {region.name} (part {region.part}): {touch}, {region.share_in_grid:.0%} in the grid, "
                f"{region.share_in_base:.0%} within the base, {region.thickness_cells:.1f} cells thin"
            )
        cost = self.cost
        lines.append(
            f"cost     about {_number(cost.seconds_per_step)} s a step, {_duration(cost.seconds_total)} in all, "
            f"{cost.memory_mb / 1000:.1f} GB of memory; {cost.active_share:.1%} of the grid active"
        )
        lines += [f"         assumes {assumption}" for assumption in cost.assumptions]
        lines += [f"warning  {warning}" for warning in self.warnings] or ["ok       nothing to warn of"]
        return lines


def check_scene(scene: EditScene, config: RunConfig) -> CheckReport:
    """The report on a scene that was loaded, for a run with `config`. Takes seconds; nothing is written."""
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
        longest_side=float(np.ptp(used, axis=0).max()),
        grid_cell=cell / scene.frame.scale,
        grid_low=_user_corner(scene, -GRID_HALF_EXTENT),
        grid_high=_user_corner(scene, GRID_HALF_EXTENT),
        regions=regions,
        cost=cost,
        warnings=tuple(_base_warnings(base) + _region_warnings(regions, config) + _scene_warnings(scene, config)),
    )


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


def estimate_cost(scene: EditScene, config: RunConfig) -> CostEstimate:
    """A rough forecast of a geometry run's time and memory, by counting what a step touches.

        step = fixed + field (active vertices) + surface (faces) + rays + guidance (passes of the networks)

    averaged over the phases: a refined step renders eight times as many pixels a side and, with Stable Diffusion, sends
    them through the VAE's encoder and back. The constants are fitted to runs of the pegasus scene with 2 cores, no GPU:
    0.28 s a step of `configs/quick.toml`, 0.42 s on the grid of 128 cells a side, 0.7 s in the refined phase, peaks of
    1.1, 1.2 and 1.2 GB; importing, compiling and exporting took 15 s.
    """
    geometry, guidance = config.geometry, config.guidance
    axis = np.linspace(-GRID_HALF_EXTENT, GRID_HALF_EXTENT, 41)
    lattice = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    share = float(np.mean(union_sdf(scene.regions, lattice) > -_REACH))
    vertices = (geometry.grid_resolution + 1) ** 3
    active = round(share * vertices)

    queries = active + geometry.focal_samples
    field = 3.5e-8 * config.field.levels * queries
    surface = 8e-7 * 8.6 * vertices ** (2 / 3)
    builtin = guidance.model == "builtin"
    side = 32 if builtin else 64
    refined = 1 - geometry.coarse_fraction
    coarse_rays = 6e-7 * geometry.views * side**2 * (geometry.spp + geometry.silhouette_spp)
    refined_rays = 6e-7 * geometry.views * (8 * side) ** 2 * (1 + geometry.silhouette_spp)
    weights, source = _unet_weights(guidance.model)
    passes = geometry.views * (2 if guidance.guidance_scale != 1 else 1)
    if builtin:
        forward, encoder = 0.1 / 4, 0.1 / 4  # four views are one picture to it
    else:
        # Stable Diffusion's layout: 800 operations a weight at a 64x64 latent, 2.2e12 to encode a picture and back.
        forward, encoder = 800.0 * weights / _OPERATIONS, 2.2e12 / _OPERATIONS
    image = passes * forward + (1 - refined) * coarse_rays + refined * (refined_rays + geometry.views * encoder)
    step = 0.03 + field + surface + (image if geometry.lambda_sds > 0 else 0.0)
    assumptions = (
        "2 cores of about 60 GFLOP/s together, otherwise idle, and views at the size of the latent",
        f"a UNet of {weights / 1e6:.3g} million weights ({source})",
        f"{queries} queries of the part's field a step",
    )
    memory = 850 + 5e-5 * vertices + 7e-5 * queries * config.field.levels
    if geometry.lambda_sds > 0:
        size = {"float32": 4, "bfloat16": 2, "float16": 2}[guidance.dtype]
        memory += 100 + 1.2e-6 * weights * size
        if not builtin:  # as `guidance.memory` will demand: one call of the UNet, and the encoder's maps for half of it
            memory += 65 * size * guidance.views_per_call + 3300 * max(1, guidance.views_per_call // 2)
    return CostEstimate(active, share, step, step * geometry.steps + START_AND_EXPORT_SECONDS, memory, assumptions)


def _unet_weights(model: str) -> tuple[float, str]:
    folder = Path(model) / "unet"
    files = list(folder.glob("*.safetensors")) or list(folder.glob("*.bin"))
    if files:
        size = max(file.stat().st_size for file in files)
        return size / (2 if ".fp16." in files[0].name else 4), f"from {folder}"
    if model == "builtin":
        return 7.0e6, "the built-in prior"
    return 860e6, "as Stable Diffusion 1.5; the model is not in a local folder"


def _base_warnings(base: tuple[BaseCheck, ...]) -> list[str]:
    warnings = []
    for mesh in base:
        found, name = mesh.topology, f"base {mesh.name}"
        if not found.closed and found.boundary_edges:
            warnings.append(
                f"{name}: not closed ({found.boundary_edges} boundary edges); its holes count as filled "
                "where most of the surface around them exists: fill them if the part grows there"
            )
        if found.closed and mesh.volume < 0:
            warnings.append(f"{name}: its faces point inwards; flip them, or it is lit from the wrong side")
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
        if region.share_in_grid < 0.995:
            warnings.append(
                f"{name}: {1 - region.share_in_grid:.0%} of it lies outside the grid and cannot be edited; "
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
    warnings = []
    if not scene.base_prompt:
        warnings.append("no base_prompt: preservation scores and before/after prompts lack it; describe the base")
    elif scene.base_prompt.casefold() == scene.prompt.casefold():
        warnings.append("prompt and base_prompt are the same; say in the prompt what shall be added")
    if not scene.has_light:
        warnings.append("no emitter: previews use a lamp of their own; add an envmap for the appearance")
    if config.geometry.lambda_focal == 0:
        warnings.append("geometry.lambda_focal=0: nothing keeps the part in its region")
    return warnings


def _number(value: float) -> str:
    return f"{value:.2g}" if value < 10 else f"{value:.0f}"


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
