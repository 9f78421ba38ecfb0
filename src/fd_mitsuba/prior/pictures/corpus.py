"""Training mosaics for the built-in prior: four views of a body, without and with a part, as geometry latents.

A mosaic is 2x2 views at azimuths a, a+90, a+180, a+270 (row by row, the first top left), each 32x32, as the coarse
phase renders them: camera-space normal times coverage, and 2 coverage - 1. Base and edited mosaics share the views, and
the edited one is the nearer of the base's and the part's hits, so a base is traced once for all its parts.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from fd_mitsuba.backend.startup import start
from fd_mitsuba.evaluation.part_judge import CAMERA_RADIUS
from fd_mitsuba.prior.data.bodies import BODIES
from fd_mitsuba.prior.data.captions import caption, random_style, view_words
from fd_mitsuba.prior.data.parts import PARTS, resized
from fd_mitsuba.prior.data.primitives import Solid, transform
from fd_mitsuba.prior.pictures.region_picture import UNTOLD_SHARE, region_picture, regions_anywhere, regions_around
from fd_mitsuba.scene.vertex_normals import vertex_normals

VIEW_SIZE = 32
SUPERSAMPLING = 2
LEAST_PIXELS = 12
"""Of a mosaic that a part must change to be seen at all."""
STYLED_SHARE = 0.3
"""Captions that also name a colour or material, which normals do not show: the words must not disturb the shape."""
REGION_STREAM = (11,)
"""Before the seed of what is drawn for regions alone."""
STRETCH = 0.12
"""Most that an object is longer or shorter along an axis, as a logarithm: people's meshes have other proportions."""


@dataclass(frozen=True)
class Pair:
    """One training example: int8 latents (4, L, L) in units of 1/127, its caption, and what it shows.

    Attributes:
        removed: the part is in `base` and not in `edited`.
        region: (L, L) where the part may be, see `region_picture`; None: the prior is not told.
    """

    base: np.ndarray
    edited: np.ndarray
    caption: str
    body: str
    part: str | None
    azimuth_deg: float
    closeup: bool
    removed: bool = field(default=False, kw_only=True)
    region: np.ndarray | None = field(default=None, kw_only=True)

    def seen(self) -> np.ndarray:
        """(C, L, L) what the network sees beside the noise: the region where it is told, then the base."""
        return self.base if self.region is None else np.concatenate([self.region[None], self.base])

    def changed(self) -> np.ndarray:
        """Where the part is (L, L) bool: the pixels that count most in training."""
        return np.abs(self.edited.astype(np.int16) - self.base).max(0) > 12

    def shows_part(self) -> bool:
        """Whether enough of the mosaic changes to see that there is a part."""
        return bool(self.changed().sum() >= LEAST_PIXELS)


class RayCaster:
    """Nearest hits on a mesh with smooth normals, through Embree behind Mitsuba."""

    def __init__(self, solid: Solid) -> None:
        self._mi = mi = start()
        vertices = np.ascontiguousarray(solid.vertices, np.float32)
        faces = np.ascontiguousarray(solid.faces, np.uint32)
        mesh = mi.Mesh("solid", len(vertices), len(faces), has_vertex_normals=True)
        params = mi.traverse(mesh)
        params["vertex_positions"] = vertices.ravel()
        params["faces"] = faces.ravel()
        normals = vertex_normals(vertices, faces, weights="area")  # as the geometry pass shows it
        params["vertex_normals"] = normals.astype(np.float32).ravel()
        params.update()
        self._scene = mi.load_dict({"type": "scene", "solid": mesh})

    def cast(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance (N,), inf where nothing is hit, and world normal (N, 3) for rays (N, 3), (N, 3)."""
        distance, normal, _ = self.trace(origins, directions)
        return distance, normal

    def trace(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `cast`, and the face (N,) that each ray hits; faces of rays that hit nothing mean nothing."""
        mi = self._mi
        ray = mi.Ray3f(
            mi.Point3f(np.ascontiguousarray(origins.T, np.float32)),
            mi.Vector3f(np.ascontiguousarray(directions.T, np.float32)),
        )
        hit = self._scene.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=True)
        return np.array(hit.t), np.array(hit.sh_frame.n).T, np.array(hit.prim_index)


@dataclass(frozen=True)
class MosaicCamera:
    """Four pinhole cameras around a target, 90 degrees apart."""

    azimuth_deg: float
    elevation_deg: float
    fov_deg: float
    target: np.ndarray

    def rays(self, view_size: int = VIEW_SIZE) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Origins and unit directions (4 S S, 3), and world-to-camera rotations (4, 3, 3); S = supersampled size."""
        size = view_size * SUPERSAMPLING
        grid = (np.arange(size) + 0.5) / size * 2 - 1
        x, y = np.meshgrid(grid, -grid)
        half = np.tan(np.deg2rad(self.fov_deg) / 2)
        local = np.stack([x * half, y * half, -np.ones_like(x)], -1).reshape(-1, 3)
        local /= np.linalg.norm(local, axis=1, keepdims=True)
        origins, directions, rotations = [], [], []
        for quarter in range(4):
            azimuth, elevation = np.deg2rad(self.azimuth_deg + 90 * quarter), np.deg2rad(self.elevation_deg)
            back = np.array(
                [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
            )
            right = np.array([np.cos(azimuth), 0, -np.sin(azimuth)])
            world_to_camera = np.stack([right, np.cross(back, right), back])
            directions.append(local @ world_to_camera)
            origins.append(np.broadcast_to(self.target + CAMERA_RADIUS * back, local.shape))
            rotations.append(world_to_camera)
        return np.concatenate(origins), np.concatenate(directions), np.stack(rotations)


def shade(distance: np.ndarray, normal: np.ndarray, rotations: np.ndarray, view_size: int = VIEW_SIZE) -> np.ndarray:
    """The int8 latent (4, 2 view_size, 2 view_size) of four views' hits."""
    size, step = view_size * SUPERSAMPLING, SUPERSAMPLING
    mask = np.isfinite(distance).reshape(4, size, size, 1)
    camera = np.einsum("vij,vnj->vni", rotations, normal.reshape(4, -1, 3)).reshape(4, size, size, 3) * mask
    both = np.concatenate([camera, mask], -1)
    both = both.reshape(4, view_size, step, view_size, step, 4).mean((2, 4))
    both[..., 3] = 2 * both[..., 3] - 1
    mosaic = (
        both.reshape(2, 2, view_size, view_size, 4).transpose(4, 0, 2, 1, 3).reshape(4, 2 * view_size, 2 * view_size)
    )
    return np.clip(np.rint(mosaic * 127), -127, 127).astype(np.int8)


def global_camera(rng: np.random.Generator) -> MosaicCamera:
    """Cameras that see the whole object."""
    fov = 2 * np.rad2deg(np.arctan(rng.uniform(1.05, 1.45) / CAMERA_RADIUS))
    target = np.array([rng.uniform(-0.06, 0.06), rng.uniform(-0.2, 0.35), rng.uniform(-0.06, 0.06)])
    return MosaicCamera(rng.uniform(0, 90), rng.uniform(-10, 45), fov, target)


def closeup_camera(part: Solid, rng: np.random.Generator) -> MosaicCamera:
    """Cameras centred on a part, so near that it fills much of the view."""
    low, high = part.vertices.min(0), part.vertices.max(0)
    radius = np.linalg.norm(high - low) / 2
    half = np.clip(radius * rng.uniform(1.1, 1.9), 0.3, 1.25)
    fov = 2 * np.rad2deg(np.arctan(half / CAMERA_RADIUS))
    return MosaicCamera(
        rng.uniform(0, 90), rng.uniform(-10, 45), fov, (low + high) / 2 + rng.uniform(-0.2, 0.2, 3) * radius
    )


def random_stretch(rng: np.random.Generator) -> np.ndarray:
    """A diagonal matrix (3, 3) for body and part alike."""
    return np.diag(np.exp(rng.uniform(-STRETCH, STRETCH, 3)))


def told_region(
    part: Solid | None,
    body: Solid,
    origins: np.ndarray,
    directions: np.ndarray,
    rng: np.random.Generator,
    view_size: int = VIEW_SIZE,
) -> np.ndarray:
    """(L, L) int8 what a picture tells of where its part may be; without a part, somewhere on the body."""
    untold = rng.random() < UNTOLD_SHARE
    regions = regions_anywhere(body, rng) if part is None else regions_around(part, rng)
    return region_picture([] if untold else regions, origins, directions, view_size, SUPERSAMPLING)


def make_pairs(body: str, parts: list[str | None], seed: int) -> list[Pair]:
    """Two pairs (global, close) a part for one random body, deterministic in (body, parts, seed)."""
    rng = np.random.default_rng([seed, list(BODIES).index(body)])
    made = BODIES[body](rng)
    stretch = random_stretch(rng)
    region_rng = np.random.default_rng([*REGION_STREAM, seed, list(BODIES).index(body)])
    base_caster, overview, pairs = RayCaster(transform(made.solid, stretch)), global_camera(rng), []
    overview_hits = None
    for part in parts:
        solid = None if part is None else transform(resized(part, PARTS[part](made, rng), made, rng), stretch)
        caster = None if solid is None else RayCaster(solid)
        cameras = [(overview, False)] if solid is None else [(overview, False), (closeup_camera(solid, rng), True)]
        for camera, closeup in cameras:
            origins, directions, rotations = camera.rays()
            if closeup or overview_hits is None:
                base_hits = base_caster.cast(origins, directions)
                overview_hits = overview_hits if closeup else base_hits
            else:
                base_hits = overview_hits
            distance, normal = base_hits
            if caster is not None:
                part_distance, part_normal = caster.cast(origins, directions)
                nearer = part_distance < distance
                distance, normal = (
                    np.where(nearer, part_distance, distance),
                    np.where(nearer[:, None], part_normal, normal),
                )
            region = told_region(solid, made.solid, origins, directions, region_rng)
            style = random_style(rng) if rng.random() < STYLED_SHARE else ""
            words = f"{caption(body, part, rng, style)}, {view_words(camera.azimuth_deg, closeup)}"
            pairs.append(
                Pair(
                    shade(*base_hits, rotations),
                    shade(distance, normal, rotations),
                    words,
                    body,
                    part,
                    camera.azimuth_deg,
                    closeup,
                    region=region,
                )
            )
    return pairs
