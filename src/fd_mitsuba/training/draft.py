"""A part that is drafted before it is guided: after pictures of the edited object that the guidance draws at once.

Image gradients move surfaces, and cannot make one where there is none: a region that shrinks onto antlers passes them
by. So the field begins as the visual hull of what was drawn (`fields.visual_hull`), and the first steps follow the
pictures themselves, always from the same close views, all around the part's focal regions; those of several parts in
turn. Pictures of one mosaic are of one part; those of several mosaics are of several. Views and pictures follow from
the settings and the run's seed, so that a resumed run goes on with the same ones. Not in the paper.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from fd_mitsuba.config import CamerasConfig, RunConfig
from fd_mitsuba.extraction.surface import SurfaceExtractor
from fd_mitsuba.fields.part_sdf import PartField
from fd_mitsuba.fields.visual_hull import explained, hull_sdf, support
from fd_mitsuba.guidance.interface import Drafter, Drawn, Guidance, GuidanceResult, GuidanceViews
from fd_mitsuba.render.point_views import point_views
from fd_mitsuba.scene.triangle_mesh import TriangleMesh
from fd_mitsuba.scene.views import CameraBatch, close_fov
from fd_mitsuba.training.field_fit import fit_field
from fd_mitsuba.training.seeds import Purpose, seed_for
from fd_mitsuba.training.step_views import views_at_once

_ZOOM = 1.4
"""Half width of the pictures over the radius of the focal regions; in the middle of other close views'."""

_LEAST_VERTICES, _LEAST_EXPLAINED = 20, 1 / 3
"""Of the grid within a hull that is worth to be followed, and of what was drawn, the share that it explains."""
_AROUND_CELLS = 4
"""How far around the regions the field is fitted."""

ShowBase = Callable[[CameraBatch], GuidanceViews]
"""The base's pictures from cameras, as a guidance takes them."""


@dataclass(frozen=True)
class Place:
    """Where one part may be drafted.

    Attributes:
        base: canonical.
        extractor: of the part's field.
        region_sdf: (count,) to the part's focal regions, at the grid's vertices.
        focus: centre and radius of what the pictures show, canonical.
    """

    base: TriangleMesh
    extractor: SurfaceExtractor
    region_sdf: Tensor
    focus: tuple[np.ndarray, float]


class Draft:
    """What is drawn of one part, and the way towards it.

    Args:
        cameras: of the pictures, and of each step that follows them.
        mosaic: consecutive cameras of a picture.
        drafter: draws.
        place: where.
        show_base: what the drafter is shown.
        seed: of what it draws.
    """

    def __init__(
        self, cameras: CameraBatch, mosaic: int, drafter: Drafter, place: Place, show_base: ShowBase, seed: int
    ) -> None:
        self.cameras, self.place = cameras, place
        self._mosaic, self._drafter, self._show_base, self._seed = mosaic, drafter, show_base, seed

    @property
    def leads(self) -> bool:
        """Whether what was drawn is one part in the regions, and so to be followed."""
        return self.hull is not None

    @cached_property
    def drawn(self) -> Drawn:
        """The pictures."""
        return self._drafter.draw(self._show_base(self.cameras), self._seed)

    @cached_property
    def hull(self) -> Tensor | None:
        """(count,) signed distance to the hull of what was drawn in the regions, inside positive, canonical units.

        None where that is next to nothing, or little of what was drawn: elsewhere, or in several places at once.
        """
        place, grid = self.place, self.place.extractor.grid
        points, room = grid.vertices.numpy(), (place.region_sdf > 0).numpy()
        coverage = self.drawn.part.numpy()
        views = point_views(place.base.vertices, place.base.faces, self.cameras, coverage.shape[-1], points[room])
        known = np.full(len(points), np.nan)
        known[room] = support(coverage, views.film, views.seen)
        outside = (place.extractor.sdf_base < 0).numpy()
        cells = hull_sdf(*(values.reshape((grid.side,) * 3) for values in (known, room & outside, ~room & outside)))
        hull = torch.from_numpy(cells.ravel() * grid.spacing).float().minimum(place.region_sdf)
        shown = views.seen & (hull.numpy()[room] > -0.5 * grid.spacing)
        worth = explained(coverage, views.film, shown) >= _LEAST_EXPLAINED
        return hull if worth and int((hull > 0).sum()) >= _LEAST_VERTICES else None

    def guide(self, pictures: Tensor, first: int) -> GuidanceResult:
        """The loss of a step that follows the pictures.

        Args:
            pictures: (B, 5, H, H) of the edited object, from some of the cameras.
            first: which of them the first one is.
        """
        begin = first // self._mosaic
        return self._drafter.guide(pictures, self.drawn, slice(begin, begin + len(pictures) // self._mosaic))


class Drafts:
    """The drafts of a scene's parts, which the first steps follow in turn.

    Args:
        steps: how many of the first steps.
        parts: at least one.
        seed: of the field's fit.
    """

    def __init__(self, steps: int, parts: Sequence[Draft], seed: int) -> None:
        self.steps, self.parts, self._seed = steps, tuple(parts), seed

    @classmethod
    def planned(
        cls,
        config: RunConfig,
        guidance: Guidance | None,
        coarse_steps: int,
        places: Sequence[Place],
        show_base: ShowBase,
    ) -> Drafts | None:
        """The drafts that the settings ask for; None: none, or a guidance that draws no shapes.

        Args:
            coarse_steps: of the run.
            places: of each part.
        """
        steps, drafter = round(config.geometry.draft_fraction * coarse_steps), getattr(guidance, "drafter", None)
        if steps == 0 or drafter is None:
            return None
        mosaic, drafts = views_at_once(guidance), []
        for number, place in enumerate(places):
            cameras = draft_views(config.cameras, config.geometry.views, mosaic, place.focus)
            seed = seed_for(config.seed, Purpose.DRAFT, number)
            drafts.append(Draft(cameras, mosaic, drafter, place, show_base, seed))
        return cls(steps, drafts, seed_for(config.seed, Purpose.DRAFT))

    @property
    def lead(self) -> bool:
        """Whether any of them is to be followed; else all steps are guided."""
        return any(part.leads for part in self.parts)

    def of(self, step: int) -> Draft | None:
        """The one that the step follows; None: it is guided."""
        part = self.parts[step % len(self.parts)]
        return part if step < self.steps and part.leads else None

    def begin(self, field: PartField) -> float | None:
        """Fit the field to the hulls, and to the regions of a part without one; returns the mean error in cells, None
        where no part has a hull.
        """
        if not self.lead:
            return None
        extractor = self.parts[0].place.extractor
        grid, regions = extractor.grid, torch.stack([part.place.region_sdf for part in self.parts]).amax(0)
        hulls = [part.place.region_sdf if part.hull is None else part.hull for part in self.parts]
        near = torch.nonzero(regions > -_AROUND_CELLS * grid.spacing).flatten()
        start, target = extractor.initial_sdf[near], torch.stack(hulls).amax(0)[near]
        return fit_field(field, grid.vertices[near], start, target, grid.spacing, self._seed)


def draft_views(settings: CamerasConfig, count: int, together: int, focus: tuple[np.ndarray, float]) -> CameraBatch:
    """`count` close views all around, in the middle of the settings' elevations; the first looks at the front.

    Args:
        together: views of a mosaic, which are evenly spread; divides `count`.
        focus: centre and radius of what they show, canonical.
    """
    turn, groups = 360.0 / together, count // together
    azimuth = (np.arange(groups)[:, None] * turn / groups + np.arange(together) * turn).ravel()
    fov = min(float(np.mean(settings.fov_deg)), float(close_fov(_ZOOM, focus[1], settings.radius)))
    return CameraBatch.around(azimuth, float(np.mean(settings.elevation_deg)), settings.radius, fov, focus[0])
