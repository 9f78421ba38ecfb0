"""Pictures of a surface for the guidance: normals, object mask and part mask of several views, with true gradients."""

from __future__ import annotations

from typing import get_args

import drjit as dr
import mitsuba as mi
import torch

from fd_mitsuba.backend import bridge, startup
from fd_mitsuba.backend.upload import upload_indices
from fd_mitsuba.conventions import GEOMETRY_CHANNELS, NormalSpace
from fd_mitsuba.render.boundary_term import add_boundary_term, film_beside
from fd_mitsuba.render.cameras import FilmCameras
from fd_mitsuba.render.enclosing import is_closed, is_outside
from fd_mitsuba.render.film_samples import film_position, opaque_seed
from fd_mitsuba.render.mesh_check import CheckedMesh, check_mesh
from fd_mitsuba.render.mesh_tracer import Hit, MeshTracer
from fd_mitsuba.render.outline_points import sample_outline
from fd_mitsuba.render.silhouette import find_outline
from fd_mitsuba.render.surface_point import ShadedMesh, shade_hit
from fd_mitsuba.render.vertex_normals import area_sums, vertex_normals
from fd_mitsuba.scene.views import CameraBatch

_CHANNELS = len(GEOMETRY_CHANNELS)
RAYS_AT_ONCE = 1 << 22


class GeometryPass:
    """Renders geometry pictures of one size. Make it once and call it at every step: it keeps its Mitsuba scenes.

    Args:
        size: pictures are `size` x `size` pixels. Another size compiles other kernels; keep one object for each.
        spp: samples a pixel for the pictures, jittered, box filter.
        silhouette_spp: outline points a view, per pixel of the picture; 0 leaves the outline's gradient out.
        normal_space: the frame of the normals, `camera` or `world` (here: the canonical frame).
    """

    def __init__(self, size: int, spp: int = 4, silhouette_spp: int = 1, normal_space: NormalSpace = "camera") -> None:
        if size < 1 or spp < 1 or silhouette_spp < 0 or normal_space not in get_args(NormalSpace):
            raise ValueError(
                f"size = {size}, spp = {spp}, silhouette_spp = {silhouette_spp}, normal_space = {normal_space!r}: "
                "sizes and samples must be positive, normal_space camera or world"
            )
        startup.start(mi.variant() or startup.DEFAULT_VARIANT)
        self.size, self.spp, self.silhouette_spp = size, spp, silhouette_spp
        self.normal_space: NormalSpace = normal_space
        self._tracer = MeshTracer()
        self._static_sums, self._static_sums_build = torch.zeros(0, 3), 0

    @property
    def static_builds(self) -> int:
        """How often the static faces were sent to the ray tracer: 1 as long as they stay the same."""
        return self._tracer.static_builds

    def render(
        self,
        vertices: torch.Tensor,
        faces: torch.Tensor,
        part_weight: torch.Tensor,
        cameras: CameraBatch,
        seed: int,
        static_faces: int = 0,
        static_vertices: int = 0,
    ) -> torch.Tensor:
        """Pictures (B, 5, size, size) with the channels of `GEOMETRY_CHANNELS`, zero where there is nothing.

        Gradients flow to `vertices` (inside the surface and at every visible outline: against the background and of one
        piece before another) and to `part_weight`; not to the cameras. They need a closed, welded surface with outward
        winding and cameras outside of it. An empty mesh gives blank pictures and zero gradients.

        Args:
            vertices: (V, 3) float32, canonical frame.
            faces: (F, 3) int64.
            part_weight: (V,) float32 in [0, 1].
            cameras: B views.
            seed: view b uses the random numbers of `seed + b`, so leave room for B between the seeds of two calls.
            static_faces: how many faces at the head of the list, with their vertices, are the same as in the last call;
                they are neither sent to the ray tracer nor searched for edges again. Their vertices should come first,
                too. This is checked: a difference costs time only.
            static_vertices: how many vertices at the head of the list need no gradient; that of their normals is left
                out. Saves time where they are all the vertices of the static faces.

        Raises:
            ValueError: wrong shapes, an index out of range, a value that is not finite, vertices not welded, winding
                not consistent, or more samples than fit one call.
        """
        mesh = check_mesh(vertices, faces, part_weight, static_faces)
        shape = (len(cameras), _CHANNELS, self.size, self.size)
        if not len(mesh.faces):
            return (vertices.sum() + part_weight.sum()) * 0.0 + torch.zeros(shape)
        if shape[0] * self.size**2 * max(self.spp, self.silhouette_spp) >= 2**32:
            raise ValueError(f"{shape[0]} views of {self.size}^2 pixels and {self.spp} samples: too many for one call")
        views = FilmCameras(cameras, self.size)
        wanted = torch.is_grad_enabled() and vertices.requires_grad and self.silhouette_spp > 0
        self._tracer.set_mesh(mesh.vertices, mesh.faces, mesh.static_faces)
        normals = self._normals(vertices, faces, mesh, static_vertices)

        def draw(positions: mi.Float, weights: mi.Float, normals: mi.Float) -> mi.Float:
            surface = ShadedMesh(positions, upload_indices(mesh.faces), weights, normals)
            uploaded = (dr.detach(positions), surface.faces)
            film, view = _film_points(views, self.spp, seed)
            pixel_samples, points = dr.width(view), None
            closed = is_closed(surface.faces)
            if wanted:
                outline = find_outline(mesh.faces, views, uploaded, closed)
                points = sample_outline(outline, views.count, self.silhouette_spp * self.size**2, seed)
                if points is not None:
                    beside = film_beside(points, self.size)
                    view = dr.concat([view, points.view])
                    film = mi.Point2f(*(dr.concat([a, b]) for a, b in zip(film, beside, strict=True)))
            from_outside = closed and is_outside(views.position, mesh.vertices)
            hit = self._tracer.see(views, film, view, uploaded, from_outside)
            picture = self._shade(surface, views, self.spp, seed, hit.part(0, pixel_samples))
            if points is not None:
                behind = hit.part(pixel_samples, pixel_samples + len(points))
                add_boundary_term(picture, surface, views, points, behind, self.normal_space)
            return _join(picture)

        flat = bridge.differentiable(draw, vertices, part_weight, normals)
        return flat.reshape(_CHANNELS, shape[0], self.size, self.size).transpose(0, 1)

    def render_primal(
        self,
        vertices: torch.Tensor,
        faces: torch.Tensor,
        part_weight: torch.Tensor,
        cameras: CameraBatch,
        seed: int,
        spp: int | None = None,
        static_faces: int = 0,
    ) -> torch.Tensor:
        """The same pictures without gradients, with any number of views and samples: they are traced in portions.

        With the `spp` of the pass (None) the values are those of `render`, but for rounding: here every ray is traced.

        Raises:
            ValueError: as `render`.
        """
        mesh = check_mesh(vertices, faces, part_weight, static_faces)
        count = len(cameras)
        pictures = torch.zeros(count, _CHANNELS, self.size, self.size)
        if not len(mesh.faces):
            return pictures
        spp = self.spp if spp is None else spp
        rounds = -(-spp * self.size**2 // RAYS_AT_ONCE)
        samples = -(-spp // rounds)
        together = max(1, RAYS_AT_ONCE // (samples * self.size**2))
        self._tracer.set_mesh(mesh.vertices, mesh.faces, mesh.static_faces)
        with torch.no_grad():
            normals = self._normals(vertices, faces, mesh, mesh.static_vertices)
        for begin in range(0, count, together):
            views = FilmCameras(_some(cameras, begin, begin + together), self.size)

            def draw(
                positions: mi.Float,
                weights: mi.Float,
                normals: mi.Float,
                views: FilmCameras = views,
                at: int = begin,
            ) -> mi.Float:
                surface = ShadedMesh(positions, upload_indices(mesh.faces), weights, normals)
                total = [mi.Float(0)] * _CHANNELS
                for turn in range(rounds):
                    part = self._interior(surface, views, samples, seed + at + turn * 1_000_003)
                    total = [old + new / rounds for old, new in zip(total, part, strict=True)]
                    dr.eval(total)
                return _join(total)

            with torch.no_grad():
                flat = bridge.differentiable(draw, vertices, part_weight, normals)
            portion = flat.reshape(_CHANNELS, views.count, self.size, self.size).transpose(0, 1)
            pictures[begin : begin + views.count] = portion
        return pictures

    def _normals(self, vertices: torch.Tensor, faces: torch.Tensor, mesh: CheckedMesh, constant: int) -> torch.Tensor:
        """Vertex normals; those of static faces are summed once where the first `constant` vertices are all theirs."""
        vertices = vertices.to(torch.float32)
        if self._static_sums_build != self._tracer.static_builds:
            fixed, used = faces[: mesh.static_faces], mesh.static_vertices
            self._static_sums = area_sums(vertices[:used], fixed)
            self._static_sums_build = self._tracer.static_builds
        if 0 < len(self._static_sums) <= constant:
            return vertex_normals(vertices, faces[mesh.static_faces :], self._static_sums)
        return vertex_normals(vertices, faces)

    def _interior(self, mesh: ShadedMesh, cameras: FilmCameras, spp: int, seed: int) -> list[mi.Float]:
        """Five arrays of B size^2 pixels: averages over jittered samples, all of them traced."""
        film, view = _film_points(cameras, spp, seed)
        hit = self._tracer.trace(cameras.at(view).ray(film), coherent=True)
        return self._shade(mesh, cameras, spp, seed, hit)

    def _shade(self, mesh: ShadedMesh, cameras: FilmCameras, spp: int, seed: int, hit: Hit) -> list[mi.Float]:
        """The averages of given hits, attached."""
        film, view = _film_points(cameras, spp, seed)
        camera = cameras.at(view)
        samples = shade_hit(mesh, camera.ray(film), hit, camera, self.normal_space)
        dr.eval(samples)  # together: the sums below would each repeat the shading
        # The samples of a pixel are neighbours: their sum has a fixed order, unlike atomic additions.
        return [dr.block_sum(sample, spp) / spp for sample in samples]


def _film_points(cameras: FilmCameras, spp: int, seed: int) -> tuple[mi.Point2f, mi.UInt32]:
    """Where the jittered samples of all pixels lie, and their views."""
    pixels = cameras.size**2
    lane = dr.arange(mi.UInt32, cameras.count * pixels * spp)
    place, view = lane // spp, lane // (spp * pixels)
    return film_position(place % pixels, lane % spp, spp, cameras.size, view + opaque_seed(seed)), view


def _some(cameras: CameraBatch, begin: int, end: int) -> CameraBatch:
    return cameras.some(slice(begin, end))


def _join(picture: list[mi.Float]) -> mi.Float:
    """One flat array, channel after channel."""
    return dr.concat(picture)
