"""What a finished geometry stage hands to exports: data and functions of space, nothing that could still learn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from fd_mitsuba.extraction.surface import SurfaceExtractor
from fd_mitsuba.extraction.tet_grid import TetGrid
from fd_mitsuba.fields.part_sdf import PartField
from fd_mitsuba.scene.focal_region import FocalRegion
from fd_mitsuba.scene.triangle_mesh import TriangleMesh


@dataclass(frozen=True)
class GrownPart:
    """All parts of a scene as they grew, together with the base that they join.

    A stage makes one with `GeometryStage.grown()`; what writes files, measures or draws needs no more of a stage.

    Attributes:
        parts: name of a part -> its focal regions, in the order of the scene file; `field` is positive inside all.
        base: the surface that the parts join, canonical frame.
        extractor: the union of base and part on the training's grid. Knows `sdf_base` and the fillet.
        field: `sdf_part` at any point. Shared with the stage, not copied.
    """

    parts: Mapping[str, tuple[FocalRegion, ...]]
    base: TriangleMesh
    extractor: SurfaceExtractor
    field: PartField

    @property
    def grid(self) -> TetGrid:
        """The tetrahedral grid of the training."""
        return self.extractor.grid
