"""A mesh with one material as exporters write it, whatever the format."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fd_mitsuba.export.material import PbrMaterial


@dataclass(frozen=True)
class ExportMesh:
    """Triangles with what their material asks of them.

    Attributes:
        name: of the object.
        vertices: (V, 3).
        faces: (F, 3), counter-clockwise seen from outside.
        material: one for all faces.
        normals: (V, 3) unit; None: flat faces.
        uv: (V, 2), origin top left.
        colours: (V, 3) linear in [0, 1].
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    material: PbrMaterial
    normals: np.ndarray | None = None
    uv: np.ndarray | None = None
    colours: np.ndarray | None = None
