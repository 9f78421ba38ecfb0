"""What a batch of cameras sees first, and where: primary rays traced once, shaded as often as wanted."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
import torch

from fd_mitsuba.backend import bridge
from fd_mitsuba.backend.upload import upload_indices
from fd_mitsuba.render.appearance_scene import AppearanceScene
from fd_mitsuba.render.cameras import FilmCameras
from fd_mitsuba.render.film_extent import pixels_within
from fd_mitsuba.render.film_samples import LightNumbers, film_position, light_numbers, opaque_seed


@dataclass(frozen=True)
class Samples:
    """Some of the samples of a batch of pictures, with what they hit; evaluated and detached.

    Sample number = (view * pixels + pixel) * spp + sample within the pixel.
    """

    lane: mi.UInt32
    hit: mi.PreliminaryIntersection3f

    def __len__(self) -> int:
        return dr.width(self.lane)


@dataclass(frozen=True)
class GBuffer:
    """B square views of `size` pixels, `spp` samples each; pixels are numbered through all views, row after row.

    Attributes:
        points: (N, 3) float32 canonical frame: one point on the part for each pixel that sees it, namely the first of
            the pixel's samples that does. The field is to be evaluated here.
        normals: (N, 3) float32 smooth unit normals of the mesh there.
        pixel: (N,) int64 place in the flattened (B, size, size) pictures, ascending.
        view: (N,) int64.
        part: (N,) int64, which of the parts, in the order in which they were given.
        alpha: (B, 1, size, size) share of samples that see base or part.
        part_mask: the same for the part alone: the pixel-wise discriminative mask.
        base_mask: alpha - part_mask.
    """

    points: torch.Tensor
    normals: torch.Tensor
    pixel: torch.Tensor
    view: torch.Tensor
    part: torch.Tensor
    alpha: torch.Tensor
    part_mask: torch.Tensor
    base_mask: torch.Tensor
    views: FilmCameras
    spp: int
    seed: int
    part_samples: Samples
    """Samples that the field shades."""
    base_samples: Samples
    """Samples that their shape's own BSDF shades."""

    @property
    def pixels(self) -> int:
        """B size^2."""
        return self.views.count * self.views.size**2

    def rays(self, samples: Samples) -> mi.Ray3f:
        """Primary rays, unit directions, the frame in which they were traced."""
        return _rays(self.views, samples.lane, self.spp, opaque_seed(self.seed))

    def numbers(self, samples: Samples, seed: int) -> LightNumbers:
        """The samples' random numbers for light; they do not depend on which samples are asked for."""
        place, pixels = samples.lane // self.spp, self.views.size**2
        return light_numbers(place % pixels, samples.lane % self.spp, place // pixels + opaque_seed(seed))

    def picture(self, samples: Samples, colour: mi.Color3f) -> list[mi.Float]:
        """Three flat channels (B size^2): the mean over each pixel's samples, 0 for those not in `samples`."""
        channels = []
        dr.eval(colour)  # together: each channel would repeat the shading
        for value in colour:
            # By way of every sample's own place: sums in a fixed order, whatever the number of threads.
            film = dr.zeros(mi.Float, self.pixels * self.spp)
            dr.scatter(film, value, samples.lane, mode=dr.ReduceMode.Permute)
            channels.append(dr.block_sum(film, self.spp) / self.spp)
        return channels


def trace(
    scene: AppearanceScene, to_canonical: tuple[float, tuple[float, ...]], views: FilmCameras, spp: int, seed: int,
    deferred_base: bool,
) -> GBuffer:  # fmt: skip
    """The G-buffer of views in the user's frame.

    Args:
        to_canonical: scale, and the user frame's point that becomes the origin.
        views: cameras in the user's frame.
        seed: view b uses the random numbers of `seed + b`.
        deferred_base: the field shades the base, too; `part_mask` is still the part's.
    """
    size, count = views.size, views.count
    pixels = pixels_within(scene.corners, views)
    with dr.suspend_grad():
        lane = _lanes(pixels, count * size**2, spp)
        hit = scene.visible.ray_intersect_preliminary(_rays(views, lane, spp, opaque_seed(seed)), coherent=True)
        seen, part = hit.is_valid(), mi.UInt32(0)
        is_part = mi.Bool(False)
        for number, mesh in enumerate(scene.parts):
            this = seen & (hit.shape == mi.ShapePtr(mesh))
            is_part, part = is_part | this, dr.select(this, number, part)
        is_part &= seen
        deferred = seen if deferred_base else is_part
        dr.eval(lane, hit, is_part, part, seen)
        of_part, of_base = (dr.compress(which) for which in (deferred, seen & ~deferred))
        part_samples, base_samples = (_some(hit, lane, index) for index in (of_part, of_base))
        alpha, part_mask = (_share(which, pixels, views, spp) for which in (seen, is_part))
        part = dr.gather(mi.UInt32, part, of_part)
        points, normals, pixel, number = _first_points(part_samples, part, views, spp, seed)
    scale, centre = to_canonical
    return GBuffer(
        points=((points.double() - torch.tensor(centre, dtype=torch.float64)) * scale).float(),
        normals=normals,
        pixel=pixel,
        view=pixel // size**2,
        part=number,
        alpha=alpha,
        part_mask=part_mask,
        base_mask=alpha - part_mask,
        views=views,
        spp=spp,
        seed=seed,
        part_samples=part_samples,
        base_samples=base_samples,
    )


def _rays(views: FilmCameras, lane: mi.UInt32, spp: int, seed: mi.UInt32) -> mi.Ray3f:
    place, pixels = lane // spp, views.size**2
    view = place // pixels
    ray = views.at(view).ray(film_position(place % pixels, lane % spp, spp, views.size, view + seed))
    return mi.Ray3f(ray.o, dr.normalize(ray.d))


def _lanes(pixels: np.ndarray, every: int, spp: int) -> mi.UInt32:
    """The numbers of all samples of some of `every` pixel."""
    lane = dr.arange(mi.UInt32, len(pixels) * spp)
    if len(pixels) == every:
        return lane
    return dr.gather(mi.UInt32, upload_indices(pixels), lane // spp) * spp + lane % spp


def _share(which: mi.Bool, pixels: np.ndarray, views: FilmCameras, spp: int) -> torch.Tensor:
    """(B, 1, size, size): the share of each pixel's samples for which it is true, given for some of the pixels."""
    film = torch.zeros(views.count * views.size**2)
    film[torch.from_numpy(pixels)] = bridge.to_torch(dr.block_sum(dr.select(which, mi.Float(1), 0), spp) / spp)
    return film.reshape(views.count, 1, views.size, views.size)


def _some(hit: mi.PreliminaryIntersection3f, lane: mi.UInt32, index: mi.UInt32) -> Samples:
    chosen, lane = dr.gather(mi.PreliminaryIntersection3f, hit, index), dr.gather(mi.UInt32, lane, index)
    dr.eval(chosen, lane)
    return Samples(lane, chosen)


def _first_points(
    samples: Samples, part: mi.UInt32, views: FilmCameras, spp: int, seed: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Position and normal in the traced frame (N, 3), pixel and part (N,) of the first sample in every pixel."""
    if not len(samples):
        nothing = torch.zeros(0, 3)
        return nothing, nothing, nothing[:, 0].long(), nothing[:, 0].long()
    index = dr.arange(mi.UInt32, len(samples))
    pixel = samples.lane // spp
    before = dr.gather(mi.UInt32, pixel, dr.maximum(mi.Int32(index) - 1, 0))
    first = dr.compress((index == 0) | (pixel != before))
    hit = dr.gather(mi.PreliminaryIntersection3f, samples.hit, first)
    lane = dr.gather(mi.UInt32, samples.lane, first)
    ray = _rays(views, lane, spp, opaque_seed(seed))
    surface = hit.compute_surface_interaction(ray, mi.RayFlags.All)
    position, normal = surface.p, surface.sh_frame.n
    place, number = lane // spp, dr.gather(mi.UInt32, part, first)
    dr.eval(position, normal, place, number)
    points, normals = (torch.stack([bridge.to_torch(axis) for axis in v], dim=1) for v in (position, normal))
    return points, normals, bridge.indices_to_torch(place), bridge.indices_to_torch(number)
