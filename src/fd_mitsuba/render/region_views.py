"""Where the focal regions are seen: per part the share of each pixel in which one of its regions comes first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from fd_mitsuba.render.geometry_pass import GeometryPass
from fd_mitsuba.render.vertex_normals import vertex_normals
from fd_mitsuba.scene.focal_region import FocalRegion
from fd_mitsuba.scene.views import CameraBatch

_SPP = 4


class RegionViews:
    """Renders the regions alone, without the base: what of it hides them is not theirs, and is not edited either.

    Args:
        parts: part -> its regions.
        size: masks are `size` x `size` pixels.
        margin: how far the regions are grown, canonical units: parts may overrun them a little.
    """

    def __init__(self, parts: Mapping[str, Sequence[FocalRegion]], size: int, margin: float = 0.0) -> None:
        vertices, faces, owners = [], [], []
        for index, regions in enumerate(parts.values()):
            for region in regions:
                surface = region.surface()
                points = torch.from_numpy(np.array(surface.vertices, np.float32))
                corners = torch.from_numpy(np.array(surface.faces, np.int64))
                faces.append(corners + sum(map(len, vertices)))
                vertices.append(points + margin * vertex_normals(points, corners))
                owners.append(torch.full((len(points),), index))
        self.parts = tuple(parts)
        self._vertices, self._faces, self._owners = torch.cat(vertices), torch.cat(faces), torch.cat(owners)
        self._rendering = GeometryPass(size, _SPP, silhouette_spp=0)

    def render(self, cameras: CameraBatch, seed: int) -> dict[str, Tensor]:
        """Part -> (B, 1, size, size) in [0, 1]; together they are at most 1. No gradients.

        Args:
            seed: view b uses the random numbers of `seed + b`.
        """
        masks = {}
        for index, part in enumerate(self.parts):
            weight = (self._owners == index).float()
            pictures = self._rendering.render_primal(
                self._vertices, self._faces, weight, cameras, seed, static_faces=len(self._faces)
            )
            masks[part] = pictures[:, 4:5]
        return masks
