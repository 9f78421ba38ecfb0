"""Light that arrives at surface points: emitter and BSDF sampling with MIS, and further bounces where they are wanted.

Everything here is detached. What carries gradients is the reflection at the first point, see `appearance_pass`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from fd_mitsuba.render.film_samples import LightNumbers

_ROULETTE_FROM = 5
"""Bounces that are never cut short, as in Mitsuba's `path`."""


@dataclass
class Incident:
    """Light at surface points from two directions in the world; their sum is an estimate of all that is reflected.

    reflected = f(from_emitter) emitter_light + f(sampled) / sampled_pdf sampled_light, with f = BSDF times cosine.
    """

    from_emitter: mi.Vector3f
    emitter_light: mi.Color3f
    """Radiance times MIS weight, over the density of the emitter's direction."""
    sampled: mi.Vector3f
    sampled_light: mi.Color3f
    """Radiance, times MIS weight where it comes from an emitter."""
    sampled_pdf: mi.Float
    sampled_weight: mi.Color3f
    """f(sampled) / sampled_pdf, which a mirror has too, although both are infinite."""
    sampled_delta: mi.Bool


class LightTransport:
    """Gathers light in one scene, with paths as long as Mitsuba's `path` allows for the same `max_depth`.

    Args:
        scene: with at least one emitter.
        max_depth: 2 is direct light; -1 leaves the end to chance.
    """

    def __init__(self, scene: mi.Scene, max_depth: int) -> None:
        self.scene, self.max_depth = scene, max_depth
        self._context = mi.BSDFContext()
        self._lights_have_shapes = any(shape.is_emitter() for shape in scene.shapes())
        self._stop = dr.opaque(mi.UInt32, max_depth if max_depth > 0 else 2**31)
        self._brightest = dr.opaque(mi.Float, dr.inf)

    def limit_bounces(self, radiance: float) -> None:
        """Let what a single sample sees by way of another surface count for no more than this: for pictures.

        A small lamp mirrored in a smooth part is found by few samples, which then are bright dots on the base.
        """
        self._brightest = dr.opaque(mi.Float, radiance)

    def incident(
        self, surface: mi.SurfaceInteraction3f, bsdf: Any, numbers: LightNumbers, stream: mi.UInt32, active: mi.Bool
    ) -> Incident:
        """The light at `surface`; `stream` numbers the samples and seeds what further bounces need."""
        with dr.suspend_grad():
            deeper = self.max_depth != 2
            light, ray, hit = self._vertex(surface, bsdf, numbers, active, need_surface=deeper)
            if deeper:
                bounced = self._reflected(ray, hit, stream, active & hit.is_valid())
                light.sampled_light += dr.minimum(bounced, self._brightest)
            return light

    def _vertex(
        self, surface: Any, bsdf: Any, numbers: LightNumbers, active: mi.Bool, need_surface: bool
    ) -> tuple[Incident, mi.Ray3f, mi.SurfaceInteraction3f]:
        """Both directions at one point, the ray along the sampled one, and what that ray hits."""
        smooth = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        # True: shadow rays are traced, so that the radiance is 0 where something stands in the way.
        emitter, radiance = self.scene.sample_emitter_direction(surface, numbers.emitter, True, smooth)
        lit = smooth & (emitter.pdf > 0)
        density = bsdf.pdf(self._context, surface, surface.to_local(emitter.d), lit)
        emitter_light = _finite(radiance * dr.select(emitter.delta, 1, _mis(emitter.pdf, density)), lit)

        sample, weight = bsdf.sample(self._context, surface, numbers.lobe, numbers.direction, active)
        usable = active & (sample.pdf > 0)
        delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
        direction = surface.to_world(sample.wo)
        ray = surface.spawn_ray(direction)
        if need_surface or self._lights_have_shapes:
            hit = self.scene.ray_intersect(ray, mi.RayFlags.All, False, usable)
            seen = usable
        else:
            hit = dr.zeros(mi.SurfaceInteraction3f)
            hit.t, hit.wi, hit.wavelengths = dr.inf, -direction, ray.wavelengths
            seen = usable & ~self.scene.ray_test(ray, usable)
        found = mi.DirectionSample3f(self.scene, hit, surface)
        competing = self.scene.pdf_emitter_direction(surface, found, seen & ~delta)
        arriving = hit.emitter(self.scene, seen).eval(hit, seen) * dr.select(delta, 1, _mis(sample.pdf, competing))
        light = Incident(
            emitter.d,
            emitter_light,
            direction,
            _finite(arriving, seen),
            dr.select(usable, sample.pdf, 1),
            _finite(weight, usable),
            delta,
        )
        return light, ray, hit

    @dr.syntax
    def _reflected(self, ray: Any, surface: Any, stream: Any, active: Any) -> Any:
        """Radiance that `surface`, seen along `ray`, sends back, without what it emits itself."""
        random = mi.PCG32(initstate=mi.UInt64(stream), initseq=mi.UInt64(stream))
        ray, surface = mi.Ray3f(ray), mi.SurfaceInteraction3f(surface)
        # Depth counts as in `path`: 1 is what the camera sees, 2 the light there, which the caller has.
        total, carried, depth, active = mi.Color3f(0), mi.Color3f(1), mi.UInt32(2), mi.Bool(active)
        while active:
            bsdf = surface.bsdf(ray)
            numbers = LightNumbers(
                mi.Point2f(random.next_float32(), random.next_float32()),
                random.next_float32(),
                mi.Point2f(random.next_float32(), random.next_float32()),
            )
            light, ray_next, hit = self._vertex(surface, bsdf, numbers, active, need_surface=True)
            value = bsdf.eval(self._context, surface, surface.to_local(light.from_emitter), active)
            sent = _finite(value * light.emitter_light, active) + light.sampled_weight * light.sampled_light
            total += dr.select(active, carried * sent, 0)
            carried *= light.sampled_weight
            depth += 1
            survival = dr.select(depth > _ROULETTE_FROM, dr.minimum(dr.max(carried), 0.95), 1)
            active &= (depth < self._stop) & hit.is_valid() & (random.next_float32() < survival)
            carried *= dr.select(survival > 0, dr.rcp(survival), 0)
            ray, surface = ray_next, hit
        return total


def _mis(first: mi.Float, second: mi.Float) -> mi.Float:
    """The power heuristic, by the ratio of the densities, since their squares may overflow."""
    return dr.select(first > 0, dr.rcp(1 + dr.square(second / first)), 0)


def _finite(value: mi.Color3f, active: mi.Bool) -> mi.Color3f:
    """The value where it is a number; 0 elsewhere, so that one odd sample cannot blacken a pixel."""
    return dr.select(active & dr.all(dr.isfinite(value)), value, 0)
