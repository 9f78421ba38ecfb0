"""Maps of single views, brought onto the vertices of a mesh."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from fd_mitsuba.backend import startup
from fd_mitsuba.baselines.voxels.grid import on_film
from fd_mitsuba.render.mesh_tracer import MeshTracer
from fd_mitsuba.scene.views import CameraBatch

_JUST_BEFORE = 1e-3
"""A ray to a vertex may end this share of its way before it, since it ends on a face."""
_ASIDE = np.array([3e-4, 7e-4, 5e-4], np.float32)
"""So far beside the camera a ray begins: one that goes exactly through another vertex may slip between its faces."""


def seen_vertices(vertices: Tensor, faces: Tensor, cameras: CameraBatch) -> Tensor:
    """(N, V) bool: whether a camera sees a vertex of a mesh (V, 3), (F, 3), in the canonical frame, unhidden by it."""
    startup.start(mi.variant() or startup.DEFAULT_VARIANT)
    tracer = MeshTracer()
    points = np.asarray(vertices, np.float32)
    tracer.set_mesh(points, np.asarray(faces))
    rows = []
    for eye in cameras.position:
        position = eye + _ASIDE
        ray = mi.Ray3f(mi.Point3f(*position.tolist()), mi.Vector3f((points - position).T))
        hit = tracer.trace(ray, coherent=False)
        rows.append(torch.from_numpy(np.array(hit.depth)) > 1 - _JUST_BEFORE)
    return torch.stack(rows)


def vertex_values(vertices: Tensor, faces: Tensor, maps: Tensor, cameras: CameraBatch) -> Tensor:
    """(V,) the mean of maps (N, s, s) of N views over those that see a vertex; 0 where none does.

    Bilinear between the middles of the maps' pixels.
    """
    size, total, count = maps.shape[-1], torch.zeros(len(vertices)), torch.zeros(len(vertices))
    seen = seen_vertices(vertices, faces, cameras)
    for view in range(len(cameras)):
        film = on_film(vertices, cameras, view, size)
        inside = ((film >= 0) & (film <= size)).all(dim=1) & seen[view]
        place = (film * (2.0 / size) - 1).view(1, 1, -1, 2)
        found = grid_sample(maps[view][None, None].float(), place, padding_mode="border", align_corners=False)
        total += torch.where(inside, found.view(-1), 0.0)
        count += inside
    return total / count.clamp(min=1)
