"""The plain way to the same pictures, as a yardstick: the field baked to a texture, Mitsuba's `prb` for every view.

Not used by the product.
"""

from __future__ import annotations

from typing import Any

from fd_mitsuba.backend import startup

mi = startup.start()

import drjit as dr  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402

from fd_mitsuba.scene.edit_scene import EditScene  # noqa: E402
from fd_mitsuba.scene.views import CameraBatch  # noqa: E402

TEXELS = 512


def uv_ball(
    centre: tuple[float, float, float], radius: float, rings: int = 40
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (V, 3), faces (F, 3) and uv (V, 2) of a ball of meridians: a mesh that has an atlas by itself."""
    v, u = np.meshgrid(np.arange(rings + 1) / rings, np.arange(2 * rings + 1) / (2 * rings), indexing="ij")
    vertices = _on_ball(u.ravel(), v.ravel(), centre, radius)
    row = 2 * rings + 1
    corner = (np.arange(rings)[:, None] * row + np.arange(2 * rings)).ravel()
    faces = np.concatenate(
        [
            np.stack([corner, corner + 1, corner + row], axis=1),
            np.stack([corner + 1, corner + row + 1, corner + row], 1),
        ]
    )
    return vertices, faces, np.stack([u.ravel(), v.ravel()], axis=1)


def _on_ball(u: np.ndarray, v: np.ndarray, centre: tuple[float, float, float], radius: float) -> np.ndarray:
    turn, polar = 2 * np.pi * u, np.pi * v
    away = np.stack([np.sin(polar) * np.sin(turn), np.cos(polar), np.sin(polar) * np.cos(turn)], axis=-1)
    return np.array(centre) + radius * away


class PlainAppearance:
    """A scene whose part has three bitmaps of `TEXELS` x `TEXELS`, rendered by `prb`."""

    def __init__(
        self, scene: EditScene, vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, size: int, spp: int
    ) -> None:
        self.scene, self.size, self.spp = scene, size, spp
        centre = vertices.mean(axis=0)
        radius = float(np.linalg.norm(vertices - centre, axis=1).max())
        v, u = np.meshgrid(*[(np.arange(TEXELS) + 0.5) / TEXELS] * 2, indexing="ij")
        self.texel_points = torch.tensor(_on_ball(u.ravel(), v.ravel(), tuple(centre), radius), dtype=torch.float32)
        loaded = scene.mitsuba_scene(without=("focal_region", "sensor", "integrator"))
        names = {"base_color": 3, "roughness": 1, "metallic": 1}
        properties = mi.Properties()
        textures = {
            name: {"type": "bitmap", "data": dr.full(mi.TensorXf, 0.5, (TEXELS, TEXELS, count)), "raw": True}
            for name, count in names.items()
        }
        properties["bsdf"] = mi.load_dict({"type": "principled", "id": "part_bsdf", **textures})
        mesh = mi.Mesh(
            "part", len(vertices), len(faces), props=properties, has_vertex_normals=True, has_vertex_texcoords=True
        )
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = np.ascontiguousarray(scene.frame.to_user(vertices).ravel(), np.float32)
        parameters["faces"] = np.ascontiguousarray(faces.ravel(), np.uint32)
        parameters["vertex_texcoords"] = np.ascontiguousarray(uv.ravel(), np.float32)
        parameters.update()
        content = {f"shape_{i}": shape for i, shape in enumerate(loaded.shapes())}
        content |= {f"light_{i}": light for i, light in enumerate(loaded.emitters())}
        self._scene = mi.load_dict({"type": "scene", **content, "part": mesh}, optimize=False, parallel=False)
        self._parameters = mi.traverse(self._scene)
        self._keys = {
            name: next(
                key for key in self._parameters.keys() if key.startswith("part") and key.endswith(f"{name}.data")
            )
            for name in names
        }
        self._integrator = mi.load_dict({"type": "prb", "max_depth": 2, "hide_emitters": True})

    def render(
        self, base_color: torch.Tensor, roughness: torch.Tensor, metallic: torch.Tensor, cameras: CameraBatch, seed: int
    ) -> torch.Tensor:
        """Linear pictures (B, 3, S, S) with gradients to the texels' values (TEXELS^2, C)."""

        @dr.wrap(source="torch", target="drjit")
        def draw(color: mi.TensorXf, rough: mi.TensorXf, metal: mi.TensorXf) -> mi.TensorXf:
            for name, value in (("base_color", color), ("roughness", rough), ("metallic", metal)):
                self._parameters[self._keys[name]] = value
            self._parameters.update()
            pictures = []
            for view in range(len(cameras)):
                sensor = self._sensor(cameras, view)
                seeds = {"seed": seed + view, "seed_grad": seed + view + 7919}
                pictures.append(
                    mi.render(
                        self._scene, self._parameters, sensor=sensor, integrator=self._integrator, spp=self.spp, **seeds
                    )
                )
            return dr.concat([dr.ravel(picture) for picture in pictures])

        flat = draw(*(value.reshape(TEXELS, TEXELS, -1) * 1.0 for value in (base_color, roughness, metallic)))
        return flat.reshape(len(cameras), self.size, self.size, 3).permute(0, 3, 1, 2)

    def _sensor(self, cameras: CameraBatch, view: int) -> Any:
        position, target = (self.scene.frame.to_user(v[view]) for v in (cameras.position, cameras.target))
        film = {
            "type": "hdrfilm",
            "width": self.size,
            "height": self.size,
            "pixel_format": "rgb",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        }
        up = cameras.basis()[1][view]
        to_world = mi.ScalarTransform4f().look_at(position.tolist(), target.tolist(), up.tolist())
        return mi.load_dict(
            {
                "type": "perspective",
                "fov": float(cameras.fov_deg[view]),
                "to_world": to_world,
                "film": film,
                "sampler": {"type": "independent", "sample_count": self.spp},
            }
        )
