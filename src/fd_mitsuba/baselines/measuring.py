"""The metrics by which methods are compared; the same views, pixels and definitions for all of them."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fd_mitsuba.baselines.drift import image_psnr, leaked_share, outside_regions, surface_chamfer
from fd_mitsuba.baselines.interface import EditedImages, EditedObject, EditTask
from fd_mitsuba.baselines.view_consistency import view_consistency
from fd_mitsuba.errors import UserError
from fd_mitsuba.evaluation.front_in_back import front_in_back
from fd_mitsuba.evaluation.judged_views import coloured, judged_cameras
from fd_mitsuba.evaluation.similarity import EditPrompt, Judge, clip_scores

FORMAT = 1
SHEET_VIEWS = 3


@dataclass(frozen=True)
class CompareProtocol:
    """How to look at every method's result.

    Attributes:
        views: on the evaluation's ring at 45 degrees, front first. Editors of single images edit each of them.
        size: pixels a side.
    """

    views: int = 24
    size: int = 96

    def __post_init__(self) -> None:
        if not (4 <= self.views <= 1000 and 16 <= self.size <= 512):
            raise UserError(
                f"--views {self.views} --size {self.size}: give 4 to 1000 views and 16 to 512 pixels a side"
            )


@dataclass(frozen=True)
class Measured:
    """What one method's result is like.

    Attributes:
        metrics: as `evaluation.report.score_table` reads them, with `consistency` and `fit` besides.
        edited, base: (N, 3, S, S) images in [0, 1] of the ring, for figures.
    """

    metrics: dict[str, Any]
    edited: Tensor
    base: Tensor


@torch.no_grad()
def measure(edited: EditedObject, task: EditTask, judge: Judge, protocol: CompareProtocol) -> Measured:
    """Look at an edited object from the ring and measure it; see `docs/baselines.md` for every metric."""
    scene, geometry = task.scene, task.config.geometry
    cameras = judged_cameras(protocol.views, np.zeros(3))
    images, base = (edited.images(cameras, protocol.size), edited.base_images(cameras, protocol.size))
    after, before = (judge.images(shown_to(judge, found)) for found in (images, base))
    clip = clip_scores(judge, after, before, EditPrompt(scene.prompt, scene.base_prompt))
    faces = front_in_back(after, before, cameras.azimuth_deg)
    band = geometry.focal_band
    outside = outside_regions(scene, cameras, protocol.size, band)
    consistency = view_consistency(images.mask, base.mask, cameras, scene.base_canonical)
    mesh = edited.mesh
    # A method that has no finer idea of the base than its grid is not blamed for that.
    cell = 2.0 * 1.05 / geometry.grid_resolution
    leakage = None if mesh is None else leaked_share(mesh, scene, band, cell)
    metrics = {
        "judge": judge.name,
        "views": {"kind": images.kind, "count": protocol.views, "size": protocol.size},
        "clip": {"judge": judge.name} | clip,
        "base": {
            "psnr_db": image_psnr(images, base, outside),
            "chamfer": None if mesh is None else surface_chamfer(mesh, scene, band),
        },
        "part": {"leakage": leakage},
        "multi_face": {} if faces is None else asdict(faces),
        "consistency": {"explained": consistency.explained, "new_pixels": int(consistency.new_pixels.sum())},
        "fit": edited.fit,
    }
    return Measured(metrics, images.rgb, base.rgb)


def shown_to(judge: Judge, images: EditedImages) -> Tensor:
    """(N, 3, S, S) in [0, 1] as a judge wants to see them: bare shapes as normals or shaded, colours as they are."""
    if images.kind == "colour":
        return images.rgb
    kind = "normals" if judge.geometry_pictures == "normals" else "shaded"
    return coloured(torch.cat([images.values, images.mask], dim=1), kind)
