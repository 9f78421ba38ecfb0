"""The plain way to the same pictures, as a yardstick: Mitsuba's projective integrator, scene rebuilt at every step.

One mesh, one `mi.render` for each view, derivatives by the stock silhouette sampling. Not used by the product.
"""

from __future__ import annotations

from typing import Any

from fd_mitsuba.backend import startup

mi = startup.start()

import drjit as dr  # noqa: E402
import torch  # noqa: E402
from mitsuba.ad.integrators.common import PSIntegrator  # noqa: E402

from fd_mitsuba.scene.views import CameraBatch  # noqa: E402


class PlainGeometryIntegrator(PSIntegrator):
    """Canonical-frame normals in the colour channels; masks as two more channels (they need the overrides below)."""

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.radiative_backprop = False
        self.sample_border_warning = False

    def aov_names(self) -> list[str]:
        return ["mask", "part_mask"]

    def sample_rays(self, *args: Any, **kwargs: Any) -> tuple[Any, Any, Any]:
        ray, _, position = super().sample_rays(*args, **kwargs)
        return ray, mi.Float(1), position  # a spectral weight would turn the one-channel masks into three

    def sample(self, mode: Any, scene: Any, sampler: Any, ray: mi.Ray3f, active: Any = True, **_: Any) -> Any:
        with dr.resume_grad(when=mode != dr.ADMode.Primal):
            hit = scene.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=True, active=active)
            normal, masks = self._channels(hit)
        return normal, hit.is_valid(), masks, None

    @staticmethod
    def _channels(hit: mi.SurfaceInteraction3f) -> tuple[mi.Spectrum, list[mi.Float]]:
        seen = hit.is_valid()
        normal = dr.select(seen, mi.Spectrum(hit.sh_frame.n.x, hit.sh_frame.n.y, hit.sh_frame.n.z), 0)
        part = dr.select(seen, hit.shape.eval_attribute_1("vertex_part", hit, seen), 0)
        return normal, [dr.select(seen, mi.Float(1), 0), part]

    def render_primarily_visible_silhouette(self, scene: Any, sensor: Any, sampler: Any, spp: int) -> mi.TensorXf:
        film = sensor.film()
        with dr.suspend_grad():
            centre = sensor.world_transform() @ mi.Point3f(0)
            edge = self.proj_detail.sample_primarily_visible_silhouette(scene, centre, sampler.next_2d(), True)
            active = edge.is_valid() & (edge.pdf > 0)
            jacobian = self.proj_detail.sensor_jacobian(sensor, edge)
            back = mi.SilhouetteSample3f(edge)
            back.d = -back.d
            to_eye = back.spawn_ray()
            to_eye.maxt = dr.norm(centre - to_eye.o) * (1 - mi.math.ShadowEpsilon)
            active &= ~scene.ray_test(to_eye, active)
            point = dr.zeros(mi.Interaction3f)
            point.p = edge.p
            place, _ = sensor.sample_direction(point, mi.Point2f(0), active)
            active &= place.pdf != 0
            behind = scene.ray_intersect(edge.spawn_ray(), active=active)
            front = dr.zeros(mi.PreliminaryIntersection3f)
            front.valid, front.t, front.shape = active, 1, edge.shape
            front.prim_index, front.prim_uv = edge.prim_index, edge.uv
            surface = front.compute_surface_interaction(mi.Ray3f(edge.p - edge.d, edge.d), mi.RayFlags.All, active)
            (normal, masks), (behind_normal, behind_masks) = self._channels(surface), self._channels(behind)
            jump = [*(normal - behind_normal), *(a - b for a, b in zip(masks, behind_masks, strict=True))]
        moving = dr.zeros(mi.SurfaceInteraction3f)
        moving.p, moving.prim_index, moving.uv = edge.p, edge.prim_index, edge.uv
        motion = dr.dot(edge.shape.differential_motion(dr.detach(moving), active), edge.n)
        factor = motion * dr.rcp(edge.pdf) * jacobian / spp
        red, green, blue, mask, part = (dr.select(active, value * factor, 0) for value in jump)
        film.prepare(self.aov_names())
        block = film.create_block(normalize=True)
        block.put(place.uv, [red, green, blue, mi.Float(0), mask, part], active)
        film.put_block(block)
        return film.develop()


mi.register_integrator("plain_geometry", PlainGeometryIntegrator)


def render_plain(
    vertices: torch.Tensor,
    faces: torch.Tensor,
    part_weight: torch.Tensor,
    cameras: CameraBatch,
    seed: int,
    size: int = 64,
    spp: int = 4,
    silhouette_spp: int = 1,
) -> torch.Tensor:
    """Pictures (B, 5, size, size) as by `GeometryPass(..., normal_space="world")`, from a scene made for this call."""
    triangles = mi.UInt32(faces.to(torch.int32).reshape(-1))

    @dr.wrap(source="torch", target="drjit")
    def draw(positions: mi.TensorXf, weights: mi.TensorXf) -> mi.TensorXf:
        mesh = mi.Mesh("mesh", len(vertices), len(faces), has_vertex_normals=True)
        mesh.add_attribute("vertex_part", 1, [0.0] * len(vertices))
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = dr.ravel(positions)
        parameters["faces"] = triangles
        parameters["vertex_part"] = dr.ravel(weights)
        parameters.update()
        scene = mi.load_dict({"type": "scene", "mesh": mesh, **_sensors(cameras, size, spp)}, optimize=False)
        integrator = mi.load_dict(
            {"type": "plain_geometry", "sppc": spp, "sppp": silhouette_spp, "sppi": 0, "guiding": "none"}
        )
        parameters = mi.traverse(scene)
        pictures = []
        for view in range(len(cameras)):
            seeds = {"seed": seed + view, "seed_grad": seed + view + 7919}
            pictures.append(mi.render(scene, parameters, sensor=view, integrator=integrator, **seeds))
        return dr.concat([dr.ravel(picture) for picture in pictures])

    flat = draw(vertices.reshape(-1) * 1.0, part_weight * 1.0)
    return flat.reshape(len(cameras), size, size, 5).permute(0, 3, 1, 2)


def _sensors(cameras: CameraBatch, size: int, spp: int) -> dict[str, Any]:
    _, ups, _ = cameras.basis()
    return {
        f"sensor_{view}": {
            "type": "perspective",
            "fov": float(cameras.fov_deg[view]),
            "to_world": mi.ScalarTransform4f().look_at(
                cameras.position[view].tolist(), cameras.target[view].tolist(), ups[view].tolist()
            ),
            "film": {
                "type": "hdrfilm",
                "width": size,
                "height": size,
                "pixel_format": "rgb",
                "filter": {"type": "box"},
                "component_format": "float32",
            },
            "sampler": {"type": "independent", "sample_count": spp},
        }
        for view in range(len(cameras))
    }
