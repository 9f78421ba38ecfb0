"""Close pictures of where the part meets the base: what the union's k is there to smooth."""

from __future__ import annotations

import numpy as np
import torch

from fd_mitsuba.render.geometry_pass import GeometryPass
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.framing import bounding_ball
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.training.geometry_stage import GeometryStage

_AZIMUTHS = (30.0, 100.0)
_ELEVATION, _DISTANCE, _MARGIN = 15.0, 3.0, 1.7
_NEAR = 0.04


@torch.no_grad()
def junction_pictures(stage: GeometryStage, size: int = 160) -> np.ndarray:
    """Two shaded close-ups (2, size, size, 3) uint8 of the union; the part is tinted.

    The cameras follow from the scene alone, so pictures of several runs of one scene can be laid side by side.
    """
    surface = stage.surface()
    pictures = GeometryPass(size, 16, 0, "camera").render_primal(
        surface.vertices, surface.faces, surface.part_weight, junction_cameras(stage.scene), seed=0
    )
    light = (0.15 + 0.85 * pictures[:, 2].clamp(min=0))[..., None]
    mask, part = (pictures[:, channel, ..., None] for channel in (3, 4))
    tint = torch.tensor([1.0, 0.86, 0.62]) * part + (mask - part)
    return ((light * tint + 0.2 * (1 - mask)).clamp(0, 1).numpy() * 255 + 0.5).astype(np.uint8)


def junction_cameras(scene: EditScene) -> CameraBatch:
    """Two cameras at the place where the first focal region's surface crosses the base, or at the region itself."""
    region = scene.regions[0]
    points = region.surface(4).vertices
    base = scene.base_canonical
    near = points[MeshDistance(base.vertices, base.faces).unsigned(points) < _NEAR]
    centre, reach = bounding_ball(near if len(near) > 2 else points)
    fov = 2 * np.degrees(np.arctan(max(_MARGIN * reach, 0.1) / _DISTANCE))
    return CameraBatch.around(
        np.array(_AZIMUTHS), _ELEVATION, _DISTANCE, min(float(fov), 45.0), np.tile(centre, (len(_AZIMUTHS), 1))
    )
