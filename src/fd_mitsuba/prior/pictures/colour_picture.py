"""Painting what rays hit: materials and light on a base and its part, and the mosaics that come of it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import reduce
from typing import Protocol

import numpy as np
import torch

from fd_mitsuba.guidance.colour_latents import shine
from fd_mitsuba.prior.data.looks import CLAY, Material, Pattern
from fd_mitsuba.prior.data.primitives import Solid
from fd_mitsuba.prior.pictures.corpus import SUPERSAMPLING, VIEW_SIZE
from fd_mitsuba.prior.pictures.light import Light, reflected
from fd_mitsuba.render.tonemap import to_srgb

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)


@dataclass(frozen=True)
class Hits:
    """What a mosaic shows, at supersampled pixels: points, unit normals and directions to the viewer (N, 3)."""

    pixel: np.ndarray
    point: np.ndarray
    normal: np.ndarray
    to_viewer: np.ndarray
    piece: np.ndarray
    """(N,) which closed piece of the part; -1 on the base."""


class Traced(Protocol):
    """What `RayCaster` is to `visible`."""

    def trace(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]: ...


def visible(
    rays: tuple[np.ndarray, np.ndarray], base_hits: tuple[np.ndarray, np.ndarray], caster: Traced, pieces: np.ndarray
) -> Hits:
    """What rays (N, 3), (N, 3) show of a base, whose hits are known, and of a part with these pieces a face."""
    (origins, directions), (distance, normal) = rays, base_hits
    part_distance, part_normal, face = caster.trace(origins, directions)
    on_part = part_distance < distance
    distance = np.where(on_part, part_distance, distance)
    pixel = np.flatnonzero(np.isfinite(distance))
    on_part, towards = on_part[pixel], directions[pixel]
    normal = np.where(on_part[:, None], part_normal[pixel], normal[pixel])
    piece = np.full(len(pixel), -1)
    piece[on_part] = pieces[face[pixel][on_part]]
    point = (origins[pixel] + distance[pixel, None] * towards).astype(np.float32)
    return Hits(pixel, point, normal, -towards.astype(np.float32), piece)


@dataclass(frozen=True)
class Paint:
    """Base colour (N, 3) linear and material number (N,) at the hits, roughness and metallic (Z,) by number."""

    colour: np.ndarray
    material: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray


def paint_hits(
    hits: Hits,
    body: Solid,
    part: Solid,
    body_look: tuple[Material, ...],
    look: tuple[Material, ...],
    zone: np.ndarray,
    rng: np.random.Generator,
) -> Paint:
    """The materials at the hits; the last material is the clay, which no hit has."""
    on_part, height = hits.piece >= 0, hits.point[:, 1]
    split = rng.uniform(np.quantile(body.vertices[:, 1], 0.2), np.quantile(body.vertices[:, 1], 0.8))
    base_zone = (height > split).astype(np.int64) * (len(body_look) - 1)
    material = np.where(on_part, len(body_look) + zone, base_zone)
    extents = [1.8] * len(body_look) + [float(np.ptp(part.vertices, axis=0).max())] * len(look)
    patterns = [Pattern(m, extent, rng) for m, extent in zip((*body_look, *look), extents, strict=True)]
    colour = np.empty_like(hits.point)
    for number, pattern in enumerate(patterns):
        here = material == number
        colour[here] = pattern.colour(hits.point[here])
    roughness = np.array([p.roughness for p in patterns] + [CLAY.roughness], np.float32)
    metallic = np.array([p.material.metallic for p in patterns] + [CLAY.metallic], np.float32)
    return Paint(colour, material, roughness, metallic)


def mosaics(
    hits: Hits, paint: Paint, light: Light, rng: np.random.Generator, view_size: int = VIEW_SIZE
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Latents (4, L, L) int8 with the part in clay and as painted, and the part's coverage (L, L) uint8.

    L is 2 view_size; `hits` are those of `MosaicCamera.rays(view_size)`. The fourth channel is the part's coverage
    beside the clay, and its shine times that beside the painting.
    """
    on_part = hits.piece >= 0
    clay = np.full(on_part.sum(), len(paint.roughness) - 1)
    painted = reflected(
        light, hits.normal, hits.to_viewer, paint.material, paint.colour, paint.roughness, paint.metallic
    )
    plain = painted.copy()
    plain[on_part] = reflected(
        light,
        hits.normal[on_part],
        hits.to_viewer[on_part],
        clay,
        np.full((len(clay), 3), CLAY.grey, np.float32),
        paint.roughness,
        paint.metallic,
    )
    shadow = _shadow(hits.point, rng)[:, None]
    plain, painted = plain * shadow, painted * shadow
    exposure = _exposure(plain @ LUMINANCE, on_part, rng)
    covered = on_part.astype(np.float32)
    fourth = (covered, covered * shine(paint.roughness, paint.metallic)[paint.material])
    latents = [
        _latent(hits.pixel, to_srgb(torch.from_numpy(picture * exposure)).numpy(), more, view_size)
        for picture, more in zip((plain, painted), fourth, strict=True)
    ]
    coverage = _tiled(hits.pixel, covered[:, None], view_size)[0]
    return latents[0], latents[1], np.rint(255 * coverage).astype(np.uint8)


def _exposure(brightness: np.ndarray, on_part: np.ndarray, rng: np.random.Generator) -> float:
    """As `render.tonemap.auto_exposure`, by the brightest of the base, give or take; the clay does not burn out."""
    factor = rng.uniform(0.45, 1.0) / (np.quantile(brightness[~on_part], 0.95) if not on_part.all() else 1.0)
    return float(min(factor, rng.uniform(0.7, 1.6) / np.quantile(brightness[on_part], 0.9)))


def _shadow(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A factor (N,) in [.45, 1] that varies slowly over space: a stand-in for shadows, the same in both pictures."""
    if rng.random() < 0.5:
        return np.ones(len(points), np.float32)
    waves = np.sin(points @ (rng.normal(size=(3, 3)) * 3.0) + rng.uniform(0, 6, 3)).mean(1)
    return (1 - rng.uniform(0, 0.55) * np.clip(2 * waves, 0, 1)).astype(np.float32)


def _latent(pixel: np.ndarray, colour: np.ndarray, fourth: np.ndarray, view_size: int) -> np.ndarray:
    both = _tiled(pixel, np.concatenate([colour, fourth[:, None]], axis=1), view_size)
    return np.clip(np.rint((2 * both - 1) * 127), -127, 127).astype(np.int8)


def sum_of(slices: Iterable[np.ndarray]) -> np.ndarray:
    """The slices added up one after another: numpy's mean over two short axes takes six times as long."""
    return reduce(np.add, slices)


def _tiled(pixel: np.ndarray, values: np.ndarray, view_size: int) -> np.ndarray:
    """The mosaic (C, 2 view_size, 2 view_size) of four views' values (N, C) at supersampled pixels, 0 elsewhere."""
    size, channels = view_size * SUPERSAMPLING, values.shape[1]
    canvas = np.zeros((4 * size * size, channels), np.float32)
    canvas[pixel] = values
    canvas = canvas.reshape(4 * view_size, SUPERSAMPLING, size, channels)
    canvas = sum_of(canvas[:, k] for k in range(SUPERSAMPLING)).reshape(-1, SUPERSAMPLING, channels)
    canvas = sum_of(canvas[:, k] for k in range(SUPERSAMPLING)) / np.float32(SUPERSAMPLING**2)
    rows = canvas.reshape(2, 2, view_size, view_size, channels)
    return rows.transpose(4, 0, 2, 1, 3).reshape(channels, 2 * view_size, 2 * view_size)
