"""An object on a ground under its scene's own light, path-traced and without grain: what photographs are taken of."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np

from fd_mitsuba.backend.startup import VERTICES
from fd_mitsuba.scene.normalisation import Normalisation
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.viewing.denoising import denoised, has_denoiser

_PAPER = 0.6
"""Reflectance of the ground."""
_GROUND_SIZE = 400.0
"""Its half side, canonical units: its end is above any picture that looks down on the object."""
_DEPTH = 5
_GUIDE_SPP = 4
_WITHOUT_DENOISER = 4
"""How many times as many samples a pixel gets where nothing takes the grain away."""
SAMPLES_AT_ONCE = 1 << 22
"""Paths that are followed together, unless an image has more pixels."""
_LEVEL = 0.8
"""Linear value of the ground in a photograph: as bright as white paper looks beside what stands on it."""
_BALANCE = 0.8
"""How much of the light's tint is taken out: with all of it, an evening would be noon; without, gold in blue light is
green."""
_LIT = 0.7
_NEAR, _FAR = 2.0**-9, 2.0**14
"""Canonical units."""
_METERED_SIZE, _METERED_SAMPLES = 64, 1 << 19
"""The image that the exposure is found in has about so many pixels a side, and at least so many samples in all."""
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


@dataclass(frozen=True)
class PhotoSet:
    """A Mitsuba scene with a ground under it.

    Attributes:
        scene: `mi.Scene`.
        frame: the map between the scene's frame and the canonical one, which cameras are in.
        shapes: id -> shape, without the ground.
    """

    mi: Any
    scene: Any
    frame: Normalisation
    shapes: dict[str, Any]

    @classmethod
    def of(cls, mi: Any, loaded: Any, frame: Normalisation, ground: float) -> PhotoSet:
        """The set of all shapes and lights of a scene.

        Args:
            loaded: `mi.Scene`.
            ground: its height, canonical frame.
        """
        named = {shape.id(): shape for shape in loaded.shapes()}  # before they are in another scene, which renames them
        shapes = {f"shape_{number}": shape for number, shape in enumerate(loaded.shapes())}
        free = [light for light in loaded.emitters() if light.get_shape() is None]
        lights = {f"light_{number}": light for number, light in enumerate(free)}
        centre = frame.to_user(np.array([0.0, ground, 0.0]))
        place = mi.ScalarTransform4f().translate(centre.tolist()).rotate([1, 0, 0], -90)
        paper = {
            "type": "rectangle",
            "to_world": place.scale(_GROUND_SIZE / frame.scale),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [_PAPER] * 3}},
        }
        scene = mi.load_dict({"type": "scene", **shapes, **lights, "ground": paper}, optimize=False)
        return cls(mi, scene, frame, named)

    def photograph(self, camera: CameraBatch, size: int, spp: int, seed: int = 0) -> np.ndarray:
        """The linear image (size, size, 3) that the first camera sees, without grain where there is a denoiser.

        Args:
            spp: samples a pixel; several times as many without a denoiser.
        """
        if not has_denoiser():
            return self.radiance(camera, size, spp * _WITHOUT_DENOISER, seed)
        return denoised(self.radiance(camera, size, spp, seed), *self.guides(camera, size, seed))

    def radiance(
        self, camera: CameraBatch, size: int, spp: int, seed: int = 0, box: tuple[slice, slice] | None = None
    ) -> np.ndarray:
        """The image with its grain, (size, size, 3) float32, linear; of the rows and columns `box` only."""
        path = self.mi.load_dict({"type": "path", "max_depth": _DEPTH, "hide_emitters": True})
        box = box or (slice(0, size), slice(0, size))
        sensor, left = self.sensor(camera, size, box), spp
        total = np.zeros((box[0].stop - box[0].start, box[1].stop - box[1].start, 3), np.float32)
        while left > 0:  # in portions: the memory of a rendering grows with its samples
            now = min(left, max(1, SAMPLES_AT_ONCE // total[..., 0].size))
            own = spread_seed(seed * 4096 + left)
            drawn = self.mi.render(self.scene, sensor=sensor, integrator=path, spp=now, seed=own)
            total += np.nan_to_num(np.array(drawn)[..., :3], posinf=0.0, neginf=0.0) * (now / spp)
            left -= now
        return total

    def guides(
        self, camera: CameraBatch, size: int, seed: int = 0, box: tuple[slice, slice] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Albedo (size, size, 3) and shading normals (size, size, 3) of what the first camera sees."""
        aovs = self.mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})
        sensor = self.sensor(camera, size, box)
        seen = np.array(self.mi.render(self.scene, sensor=sensor, integrator=aovs, spp=_GUIDE_SPP, seed=seed))
        return np.clip(seen[..., :3], 0, 1), seen[..., 3:6]

    def exposure(self, camera: CameraBatch, size: int) -> np.ndarray:
        """What to multiply linear RGB with (3,): it shows the ground as paper, and takes most of the light's tint out.

        As a photographer does with a grey card. 1 where no light reaches the ground.

        Args:
            size: of an image that is taken anyway: each size is a kernel of its own, which takes seconds to compile.
        """
        # A power of two, as the photographs' own: others compile a kernel of their own too.
        spp = 1 << max(1, _METERED_SAMPLES // size**2).bit_length() - 1
        seen = self.radiance(camera, size, spp), *self.guides(camera, size)
        image, albedo, normal = (_coarser(values, max(1, size // _METERED_SIZE)) for values in seen)
        values = image[_is_ground(albedo, normal)].astype(np.float64)
        values = values[values @ _LUMINANCE > 0]
        if not len(values):
            return np.ones(3)
        bright = values @ _LUMINANCE
        # What is much darker lies in the object's shadow.
        light = values[bright > _LIT * np.percentile(bright, 75)].mean(axis=0)
        level = float(light @ _LUMINANCE)
        balance = (level / np.maximum(light, 1e-3 * level)) ** _BALANCE
        return balance * (_LEVEL / float(balance * light @ _LUMINANCE))

    def share_seen(self, camera: CameraBatch, names: Collection[str], size: int = 96) -> float:
        """Which share of the first camera's image shows shapes of the given ids."""
        mi = self.mi
        import drjit as dr

        index = dr.arange(mi.UInt32, size * size)
        place = mi.Point2f((index % size + 0.5) / size, (index // size + 0.5) / size)
        ray, _ = self.sensor(camera, size).sample_ray(0.0, 0.5, place, mi.Point2f(0.5))
        hit = self.scene.ray_intersect_preliminary(ray)
        seen = mi.Bool(False)
        for name in names:
            seen |= hit.shape == mi.ShapePtr(self.shapes[name])
        return float(dr.count(seen & hit.is_valid())[0]) / size**2

    def sensor(self, camera: CameraBatch, size: int, box: tuple[slice, slice] | None = None) -> Any:
        """The first camera as Mitsuba's, with the box filter that a denoiser wants; `box` crops rows and columns."""
        mi = self.mi
        position, target = (self.frame.to_user(point[0]) for point in (camera.position, camera.target))
        place = mi.ScalarTransform4f().look_at(
            origin=position.tolist(), target=target.tolist(), up=camera.basis()[1][0].tolist()
        )
        film = {
            "type": "hdrfilm",
            "width": size,
            "height": size,
            "pixel_format": "rgb",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        }
        if box is not None:
            for axis, side, rows in (("y", "height", box[0]), ("x", "width", box[1])):
                film |= {f"crop_offset_{axis}": rows.start, f"crop_{side}": rows.stop - rows.start}
        return mi.load_dict(
            {
                "type": "perspective",
                "fov": float(camera.fov_deg[0]),
                # Constants of a kernel, and so the same for all cameras: each other value takes seconds to compile.
                "near_clip": _NEAR / self.frame.scale,
                "far_clip": _FAR / self.frame.scale,
                "to_world": place,
                "film": film,
                # Its pixels are as independent as a denoiser wants them, its samples of a pixel are spread.
                "sampler": {"type": "multijitter", "sample_count": 4},
            }
        )


def spread_seed(seed: int) -> int:
    """Seeds far from each other for seeds that are near: with these, the stratified samplers of Mitsuba draw the same
    for a pixel and for one some columns further, and a denoiser takes what is alike in neighbours for the image.
    """
    return seed * 0x9E3779B1 % 2**32


def _coarser(values: np.ndarray, factor: int) -> np.ndarray:
    """Means (H // factor, W // factor, 3) of squares of an image (H, W, 3)."""
    side = len(values) // factor
    return values[: side * factor, : side * factor].reshape(side, factor, side, factor, -1).mean(axis=(1, 3))


def _is_ground(albedo: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Which pixels (H, W) show ground alone."""
    return (np.abs(albedo - _PAPER).max(axis=-1) < 0.01) & (normal[..., 1] > 0.999)


def vertex_positions(mi: Any, mesh: Any) -> np.ndarray:
    """(V, 3) float64, in the scene's frame."""
    return np.array(mi.traverse(mesh)[VERTICES], dtype=np.float64).reshape(-1, 3)
