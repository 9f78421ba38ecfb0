"""The growing part as a mesh, while the geometry stage runs."""

from __future__ import annotations

import numpy as np
import torch

from fd_mitsuba.training.geometry_stage import GeometryStage


def live_part(stage: GeometryStage) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float64 in the user frame and faces (F, 3) int64 of the part as it is now.

    The part's side of the union with the base: open where it joins the base, which the page shows itself. Nothing of
    the stage is changed, no random number is drawn. It takes a twentieth of a step's
    processor time.
    """
    with torch.no_grad():
        surface = stage.surface()
        faces = surface.faces[surface.face_is_part]
        used, compact = torch.unique(faces, return_inverse=True)
        vertices = surface.vertices[used].numpy()
    return stage.scene.frame.to_user(vertices), compact.reshape(-1, 3).numpy().astype(np.int64)
