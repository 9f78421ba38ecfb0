"""What a judge of parts is shown of a shape: views before and after, of the whole object and of the part close by."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from fd_mitsuba.evaluation.part_judge import CAMERA_RADIUS, VIEW_SIZE
from fd_mitsuba.extraction.union_surface import UnionSurface
from fd_mitsuba.render.geometry_pass import GeometryPass
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.focal_region import deepest_in
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.training.geometry_stage import GeometryStage

_VIEWS_A_RING, _ELEVATIONS_DEG, _SPP = 8, (15.0, 40.0), 16
_HALF_WIDTH = 1.25
"""Of a view of the whole object, canonical units; in the middle of what the judge was trained on."""
_CLOSE, _LEAST_HALF_WIDTH = 1.5, 0.3
"""Half width of a close-up, in radii of the part, and at least so wide; both as in the judge's training."""


@torch.no_grad()
def before_and_after(
    stage: GeometryStage, surface: UnionSurface, of: str | None = None
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Views of the base and of a surface with a part: rings around the whole, then close-ups around the part.

    Args:
        of: the one of several parts that is looked at; the others are there before, too.
    """
    grown, before = surface.part_weight > 0.5, (stage.base_surface.vertices, stage.base_surface.faces)
    if of is not None:
        own = _belongs_to(stage.scene, of, surface.vertices)
        others = surface.faces[(grown & ~own)[surface.faces].all(dim=1)]
        grown = grown & own
        before = torch.cat([before[0], surface.vertices]), torch.cat([before[1], others + len(before[0])])
    part = surface.vertices[grown].double().numpy()
    frames = [(elevation, stage.aim, _HALF_WIDTH) for elevation in _ELEVATIONS_DEG]
    if len(part):
        low, high = part.min(0), part.max(0)
        half = np.clip(_CLOSE * np.linalg.norm(high - low) / 2, _LEAST_HALF_WIDTH, _HALF_WIDTH)
        frames.append((25.0, (low + high) / 2, float(half)))
    for elevation, target, half in frames:
        whole = surface.vertices, surface.faces
        yield judged_views(*before, target, elevation, half), judged_views(*whole, target, elevation, half)


def _belongs_to(scene: EditScene, part: str, points: torch.Tensor) -> torch.Tensor:
    """(N,) whether points (N, 3) are nearer to a part's regions than to those of any other."""
    owner = deepest_in(points.double().numpy(), scene.parts.values())
    return torch.from_numpy(owner == list(scene.parts).index(part))


def judged_views(
    vertices: torch.Tensor, faces: torch.Tensor, target: np.ndarray, elevation_deg: float, half_width: float
) -> np.ndarray:
    """A ring of views (8, 4, 32, 32) of a mesh as `PartJudge` takes them, the first from the front.

    Args:
        vertices, faces: (V, 3) canonical, (F, 3).
        target: (3,) what the cameras look at, canonical.
        half_width: of the view at the target, canonical units.
    """
    fov = 2 * np.degrees(np.arctan(half_width / CAMERA_RADIUS))
    turn = np.arange(_VIEWS_A_RING) * (360.0 / _VIEWS_A_RING)
    cameras = CameraBatch.around(turn, elevation_deg, CAMERA_RADIUS, fov, np.tile(target, (len(turn), 1)))
    rendering, weight = GeometryPass(VIEW_SIZE, _SPP, 0), torch.zeros(len(vertices))
    pictures = rendering.render_primal(vertices.float(), faces, weight, cameras, seed=0).numpy()
    return np.concatenate([pictures[:, :3], 2 * pictures[:, 3:4] - 1], axis=1)
