"""Pictures of a lit, textured object for the guidance: base and part, each by its own path, with true gradients.

The part's shading is deferred: primary rays are traced once, the field is evaluated in torch at what they hit, its
values become film-sized textures, and the part's stock BSDF looks them up at the pixel's place on the film. So any
BSDF can have the field's values, and each value is used by all samples of its pixel.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import torch

from fd_mitsuba.backend import bridge
from fd_mitsuba.render.appearance_scene import AppearanceScene, Triangles
from fd_mitsuba.render.cameras import FilmCameras
from fd_mitsuba.render.gbuffer import GBuffer, Samples, trace
from fd_mitsuba.render.light_transport import Incident, LightTransport
from fd_mitsuba.render.part_shading import CHANNELS, FilmShading, PartShading
from fd_mitsuba.render.shading_frame import bent_frame
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.views import CameraBatch

_MOST_SAMPLES = 2**31
CLAY = {"type": "principled", "base_color": {"type": "rgb", "value": 0.5}, "roughness": 0.7}
"""The grey that models which see what they edit are shown in place of a material."""


@dataclass(frozen=True)
class AppearancePictures:
    """Linear RGB of B views, multiplied by coverage; the background is black and left to the caller.

    Attributes:
        merged: (B, 3, S, S) = part_path + base_path. Gradients flow to the field's values.
        part_path: what is seen of the part, with these gradients.
        base_path: what is seen of the base; constant.
        alpha: (B, 1, S, S) coverage of both, constant, and so is
        part_mask: (B, 1, S, S), the share of the pixel's samples that see the part.
    """

    merged: torch.Tensor
    part_path: torch.Tensor
    base_path: torch.Tensor
    alpha: torch.Tensor
    part_mask: torch.Tensor


class AppearancePass:
    """Renders one scene with its parts. Make it once and call it at every step: it keeps its Mitsuba scene.

    Source: the paper's "Dual-path Physically Based Rendering" and supplement, "PBR Material".

    Args:
        scene: whose base shapes, BSDFs, textures and emitters are used as they are.
        parts: name -> mesh in the canonical frame, closed or the faces of a cut. None at all gives the base alone.
        shading: the parts' BSDF and which fields feed it.
        size: pictures are `size` x `size` pixels.
        spp: samples a pixel.
        max_depth: as of Mitsuba's `path`: 2 is direct light with shadows; more adds bounces; -1 leaves the end to
            chance. Bounces see the part with the values of `set_vertex_values` and without its perturbed normals.
        deferred_base: the ablation with a single path: the field shades the base as well.
        opened: the base after a cut, whose faces are the parts; see `AppearanceScene.build`.

    Raises:
        UserError: the scene has no emitter, or one with values that are not finite.
        ValueError: a mesh that cannot be used; sizes, samples or depth out of range.
    """

    def __init__(
        self,
        scene: EditScene,
        parts: Mapping[str, Triangles],
        shading: PartShading,
        size: int = 128,
        spp: int = 16,
        max_depth: int = 2,
        deferred_base: bool = False,
        opened: Mapping[int, Path | None] | None = None,
    ) -> None:
        if size < 2 or spp < 1 or (max_depth < 2 and max_depth != -1):
            raise ValueError(f"size = {size}, spp = {spp}, max_depth = {max_depth}: at least 2, 1, and 2 or -1")
        self.size, self.spp, self.deferred_base = size, spp, deferred_base
        self.part_names = tuple(parts)
        self._frame = scene.render_frame
        self.scene = AppearanceScene.build(scene, parts, shading, max_depth != 2, opened)
        self._transport = LightTransport(self.scene.lit, max_depth)
        self._shading = FilmShading(shading)
        self._clay = None

    def set_vertex_values(self, part: str, values: Mapping[str, np.ndarray]) -> None:
        """What bounces see on a part: field -> (V, channels), one row a vertex; of no use where `max_depth` is 2.

        The fields that `render` takes, evaluated at the mesh's vertices; 0.5 until this is called.
        """
        fed = {name: self._shading.fed_value(name, np.asarray(value)) for name, value in values.items()}
        self.scene.set_vertex_values(self.part_names.index(part), fed)

    def limit_bounces(self, radiance: float) -> None:
        """For pictures, see `LightTransport.limit_bounces`; without it bounces are those of Mitsuba's `path`."""
        self._transport.limit_bounces(radiance)

    def trace(self, cameras: CameraBatch, seed: int, size: int | None = None, spp: int | None = None) -> GBuffer:
        """What B cameras of the canonical frame see.

        Args:
            seed: view b uses the random numbers of `seed + b`, so leave room for B between the seeds of two calls.
            size: instead of the pass's own; each size compiles kernels of its own. Likewise `spp`.
        """
        size, spp = size or self.size, spp or self.spp
        if len(cameras) * size**2 * spp >= _MOST_SAMPLES:
            raise ValueError(f"{len(cameras)} views of {size}^2 pixels and {spp} samples: too many for one call")
        position, target = (self._frame.to_user(points) for points in (cameras.position, cameras.target))
        views = FilmCameras(dataclasses.replace(cameras, position=position, target=target), size)
        to_canonical = (self._frame.scale, tuple(self._frame.centre.tolist()))
        return trace(self.scene, to_canonical, views, spp, seed, self.deferred_base)

    def render(
        self,
        gbuffer: GBuffer,
        base_color: torch.Tensor | None,
        roughness: torch.Tensor | None,
        metallic: torch.Tensor | None,
        normal: torch.Tensor | None,
        seed: int,
    ) -> AppearancePictures:
        """Light on what was traced; gradients flow to the fields' values and to nothing else.

        Equal seeds give the base equal light samples, with a part or without.

        Args:
            base_color: (N, 3) linear RGB at the G-buffer's points. None where the BSDF is not fed by it; likewise
            roughness: (N, 1), and
            metallic: (N, 1), in the ranges of the BSDF's parameters.
            normal: (N, 3) perturbation in the frame of `fields.tangent_frame`, of any length but 0; None is (0, 0, 1).
            seed: view b uses the random numbers of `seed + b`. May be the seed of the trace.

        Raises:
            ValueError: a value that the BSDF needs is missing, or has another shape.
        """
        base_path = self.render_base(gbuffer, seed)
        given = {"base_color": base_color, "roughness": roughness, "metallic": metallic}
        part_path = self._render_part(gbuffer, self._films(gbuffer, given, normal), seed)
        return AppearancePictures(part_path + base_path, part_path, base_path, gbuffer.alpha, gbuffer.part_mask)

    def render_base(self, gbuffer: GBuffer, seed: int) -> torch.Tensor:
        """The base path alone: (B, 3, S, S), constant."""
        samples = gbuffer.base_samples
        if not len(samples):
            return _black(gbuffer)
        with dr.suspend_grad():
            ray = gbuffer.rays(samples)
            surface = samples.hit.compute_surface_interaction(ray, mi.RayFlags.All)
            bsdf = surface.bsdf(ray)
            lanes, numbers = mi.Bool(True), gbuffer.numbers(samples, seed)
            light = self._transport.incident(surface, bsdf, numbers, samples.lane, lanes)
            value = bsdf.eval(mi.BSDFContext(), surface, surface.to_local(light.from_emitter), lanes)
            colour = _numbers_only(value * light.emitter_light) + light.sampled_weight * light.sampled_light
            flat = bridge.to_torch(dr.concat(gbuffer.picture(samples, colour)))
        return _as_picture(flat, gbuffer)

    def render_clay(self, gbuffer: GBuffer, seed: int) -> torch.Tensor:
        """The part path with the parts in plain grey clay: (B, 3, S, S), constant."""
        samples = gbuffer.part_samples
        if not len(samples):
            return _black(gbuffer)
        if self._clay is None:
            self._clay = PartShading(CLAY).load({})
        with dr.suspend_grad():
            surface = self._part_surface(gbuffer, None)
            numbers = gbuffer.numbers(samples, seed)
            light = self._transport.incident(surface, self._clay, numbers, samples.lane, mi.Bool(True))
            flat = bridge.to_torch(dr.concat(gbuffer.picture(samples, _reflected(self._clay, surface, light))))
        return _as_picture(flat, gbuffer)

    def render_light(self, gbuffer: GBuffer) -> torch.Tensor:
        """The environment as the cameras see it behind everything: (B, 3, S, S), constant; black if there is none."""
        environment = self.scene.lit.environment()
        if environment is None:
            return _black(gbuffer)
        with dr.suspend_grad():
            every = Samples(dr.arange(mi.UInt32, gbuffer.pixels * gbuffer.spp), dr.zeros(mi.PreliminaryIntersection3f))
            away = dr.zeros(mi.SurfaceInteraction3f, len(every))
            away.wi = -gbuffer.rays(every).d
            flat = bridge.to_torch(dr.concat(gbuffer.picture(every, mi.Color3f(environment.eval(away)))))
        return _as_picture(flat, gbuffer)

    def _films(
        self, gbuffer: GBuffer, given: dict[str, torch.Tensor | None], normal: torch.Tensor | None
    ) -> dict[str, torch.Tensor]:
        """Field -> (B S S, channels), zero where no pixel sees the part: sizes that no step changes."""
        values = {name: given[name] for name in self._shading.fed}
        if normal is not None:
            values["normal"] = normal
        films = {}
        for name, value in values.items():
            shape = (len(gbuffer.points), CHANNELS.get(name, 3))
            if value is None or tuple(value.shape) != shape:
                found = "missing" if value is None else tuple(value.shape)
                raise ValueError(f"{name}: {found}; this BSDF needs {shape}")
            empty = torch.zeros(gbuffer.pixels, shape[1])
            films[name] = empty.index_copy(0, gbuffer.pixel, value.to(torch.float32))
        return films

    def _render_part(self, gbuffer: GBuffer, films: dict[str, torch.Tensor], seed: int) -> torch.Tensor:
        samples = gbuffer.part_samples
        if not len(samples):
            zero = sum((film.sum() * 0.0 for film in films.values()), torch.zeros(()))
            return zero + _black(gbuffer)
        names = list(films)

        def draw(*arrays: mi.Float) -> mi.Float:
            values = dict(zip(names, arrays, strict=True))
            size = gbuffer.views.size
            for name in self._shading.fed:
                self._shading.set(name, values[name], gbuffer.views.count * size, size)
            surface = self._part_surface(gbuffer, values.get("normal"))
            numbers = gbuffer.numbers(samples, seed)
            # Directions and their densities come from the present values, but are constants from here on.
            light = self._transport.incident(surface, self._shading.bsdf, numbers, samples.lane, mi.Bool(True))
            dr.eval(light)
            return dr.concat(gbuffer.picture(samples, _reflected(self._shading.bsdf, surface, light)))

        return _as_picture(bridge.differentiable(draw, *films.values()), gbuffer)

    def _part_surface(self, gbuffer: GBuffer, normal: mi.Float | None) -> mi.SurfaceInteraction3f:
        """Surface points with the bent frame, and with film coordinates in place of texture coordinates."""
        samples, size = gbuffer.part_samples, gbuffer.views.size
        ray = gbuffer.rays(samples)
        surface = samples.hit.compute_surface_interaction(ray, mi.RayFlags.All)
        pixel = samples.lane // gbuffer.spp
        perturbation = mi.Vector3f(0, 0, 1) if normal is None else dr.gather(mi.Vector3f, normal, pixel)
        frame = bent_frame(mi.Vector3f(surface.sh_frame.n), perturbation, -ray.d)
        surface.sh_frame, surface.wi = frame, frame.to_local(-ray.d)
        row, column = pixel // size, pixel % size
        surface.uv = mi.Point2f((column + 0.5) / size, (row + 0.5) / (gbuffer.views.count * size))
        return surface


def _black(gbuffer: GBuffer) -> torch.Tensor:
    return torch.zeros(gbuffer.views.count, 3, gbuffer.views.size, gbuffer.views.size)


def _as_picture(flat: torch.Tensor, gbuffer: GBuffer) -> torch.Tensor:
    """(B, 3, S, S) of channel after channel."""
    size = gbuffer.views.size
    return flat.reshape(3, gbuffer.views.count, size, size).transpose(0, 1)


def _numbers_only(colour: mi.Color3f) -> mi.Color3f:
    return dr.select(dr.all(dr.isfinite(colour)), colour, 0)


def _reflected(bsdf: mi.BSDF, surface: mi.SurfaceInteraction3f, light: Incident) -> mi.Color3f:
    """What the part sends to the camera of the given light: attached to the field's values."""
    context = mi.BSDFContext()
    by_emitter = bsdf.eval(context, surface, surface.to_local(light.from_emitter)) * light.emitter_light
    factor = light.sampled_light / light.sampled_pdf
    by_sample = bsdf.eval(context, surface, surface.to_local(light.sampled)) * factor
    # A mirror's direction has no value that could be differentiated; it counts as it is.
    by_sample = dr.select(light.sampled_delta, light.sampled_weight * light.sampled_light, by_sample)
    return _numbers_only(by_emitter) + _numbers_only(by_sample)
