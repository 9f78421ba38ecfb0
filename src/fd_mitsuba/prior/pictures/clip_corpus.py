"""Pictures for the evaluator: one view of a whole body, with a part, without one, or with the start of one.

They are made by the prior's makers of bodies and parts but are not the prior's pictures: other seeds, single views of
64 x 64 from all round, shapes stretched, parts turned, moved and bent. Each hit is drawn twice: as camera-space normals
on black, (n + 1) / 2, as `viewing.sheets.normal_pictures`, and lit on grey, as `viewing.lit_views`. Ellipsoids that
a run could start from stand where a part would, and are captioned as if they were not there: they are no part yet.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from fd_mitsuba.prior.data.catalogue import COARSE, Catalogue
from fd_mitsuba.prior.data.clip_captions import ANY_STYLE, NO_PART, NO_STYLE, STYLES, Claim
from fd_mitsuba.prior.data.looks import NAMED, Material, random_body_look
from fd_mitsuba.prior.data.primitives import Solid, rotation, transform
from fd_mitsuba.prior.data.starts import starts_like
from fd_mitsuba.prior.pictures.colour_corpus import pieces_of
from fd_mitsuba.prior.pictures.colour_picture import LUMINANCE, Hits, paint_hits, sum_of, visible
from fd_mitsuba.prior.pictures.corpus import RayCaster
from fd_mitsuba.prior.pictures.light import Light, lit_by, random_environment, reflected
from fd_mitsuba.render.tonemap import to_srgb

TRAINING_SEED, UNSEEN_SEED = 3 * 2**30, 7 * 2**29
"""The evaluator trains on seeds from the first and is judged from the second; the prior's are all below 3 * 2**30."""
SIZE, SUPERSAMPLING, PATCH = 64, 2, 8
STRETCH = 0.15
LEAST_PIXELS = 14
"""A part that shows less is not visible: the picture is left out."""


@dataclass(frozen=True)
class JudgePicture:
    """A picture (64, 64, 3) uint8, what it shows, and how much of each patch (8, 8) part and object cover, of 255."""

    pixels: np.ndarray
    shown: Claim
    part_share: np.ndarray
    body_share: np.ndarray


@dataclass(frozen=True)
class View:
    """A pinhole camera that sees a whole object."""

    rays: tuple[np.ndarray, np.ndarray]
    to_camera: np.ndarray

    @classmethod
    def random(cls, rng: np.random.Generator) -> View:
        """Any azimuth, elevation -5 to 50 degrees, some variety of distance, opening angle and aim."""
        azimuth, elevation = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(-5, 50))
        return cls.at(azimuth, elevation, rng.uniform(2.8, 3.8), rng.uniform(1.1, 1.6), _aim(rng))

    @classmethod
    def at(cls, azimuth: float, elevation: float, radius: float, half: float, aim: np.ndarray) -> View:
        """The camera at angles in radians, `half` the half side of what it sees in the plane through `aim`."""
        side = SIZE * SUPERSAMPLING
        grid = ((np.arange(side) + 0.5) / side * 2 - 1) * half / radius
        x, y = np.meshgrid(grid, -grid)
        local = np.stack([x, y, -np.ones_like(x)], -1).reshape(-1, 3)
        local /= np.linalg.norm(local, axis=1, keepdims=True)
        back = np.array([np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)])
        right = np.array([np.cos(azimuth), 0, -np.sin(azimuth)])
        to_camera = np.stack([right, np.cross(back, right), back])
        return cls((np.broadcast_to(aim + radius * back, local.shape), local @ to_camera), to_camera)


def make_pictures(
    body: str,
    parts: list[str],
    seed: int,
    cameras: list[View] | int = 5,
    parts_a_camera: int = 3,
    even: bool = False,
    catalogue: Catalogue = COARSE,
) -> list[JudgePicture]:
    """Normal and lit pictures of one random body: plain, with each of some parts, with a start.

    Args:
        cameras: given ones, each of which sees every part, or how many random ones, each of which sees some.
        even: whether every camera sees the body plain and a start for each part that it sees, so that starts and parts
            are equally many; otherwise a start in the first, third, … view and the plain body in the others.
        seed: with `body` and `parts` decides everything.
        catalogue: whose bodies and parts; parts must suit the body.
    """
    rng = np.random.default_rng([seed, list(catalogue.body_weights).index(body)])
    made, stretch = catalogue.make_body(body, rng), np.diag(1 + STRETCH * rng.uniform(-1, 1, 3))
    solid = transform(made.solid, stretch)
    caster, light = RayCaster(solid), lit_by(random_environment(rng))
    grown, zone_of = {}, {}
    for name in parts:
        part = catalogue.grow(made, name, rng)
        grown[name], zone_of[name] = transform(varied(part.solid, rng), stretch), part.zone_of
    casters = {name: (RayCaster(part), pieces_of(part)) for name, part in grown.items()}
    scene = _Scene(catalogue, body, solid, light)
    pictures = []
    for number, view in enumerate(cameras if isinstance(cameras, list) else [View.random(rng) for _ in range(cameras)]):
        base_hits = caster.cast(*view.rays)
        chosen = parts if isinstance(cameras, list) else list(rng.permutation(parts)[:parts_a_camera])
        for name in chosen:
            hits = visible(view.rays, base_hits, *casters[name])
            pictures += _draw(scene, hits, view, rng, str(name), grown[name], zone_of[name])
            if even:
                pictures += _draw_start(scene, grown[name], base_hits, view, stretch, rng)
        if even or number % 2 or not grown:
            hits = visible(view.rays, base_hits, _Nothing(), np.zeros(len(base_hits[0]), np.int64))
            pictures += _draw(scene, hits, view, rng)
        else:
            chosen_part = list(grown.values())[rng.integers(len(grown))]
            pictures += _draw_start(scene, chosen_part, base_hits, view, stretch, rng)
    return pictures


def random_pictures(seed: int, even: bool = False, catalogue: Catalogue = COARSE) -> list[JudgePicture]:
    """Pictures of the body and the parts that the seed draws; `even` as in `make_pictures`."""
    rng = np.random.default_rng([seed, 1000])
    parts = [str(name) for name in rng.permutation(list(catalogue.part_weights))]
    body = str(rng.choice(list(catalogue.body_weights)))
    parts = [part for part in parts if catalogue.suits(body, part)][:5]
    return make_pictures(body, parts, seed, even=even, catalogue=catalogue)


def varied(part: Solid, rng: np.random.Generator) -> Solid:
    """The part stretched, turned, moved and bent a little, as one that a run grows."""
    low, high = part.vertices.min(0), part.vertices.max(0)
    centre, size = (low + high) / 2, (high - low).max()
    turn = rotation(*rng.uniform(-8, 8, 3)) @ np.diag(1 + STRETCH * rng.uniform(-1, 1, 3))
    points = (part.vertices - centre) @ turn.T + centre + 0.05 * size * rng.uniform(-1, 1, 3)
    waves = rng.normal(size=(3, 3)) * (3.0 / size)
    bend = 0.04 * size * rng.random() * np.sin(points @ waves + rng.uniform(0, 2 * np.pi, 3))
    return Solid(points + bend, part.faces)


@dataclass(frozen=True)
class _Scene:
    """What all pictures of one body share."""

    catalogue: Catalogue
    body: str
    solid: Solid
    light: Light


class _Nothing:
    """Stands for the ray caster of a part that is not there."""

    def trace(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        count = len(origins)
        return np.full(count, np.inf), np.zeros((count, 3)), np.zeros(count, np.int64)


def _aim(rng: np.random.Generator) -> np.ndarray:
    return np.array([rng.uniform(-0.1, 0.1), rng.uniform(-0.2, 0.35), rng.uniform(-0.1, 0.1)])


def _draw_start(
    scene: _Scene,
    part: Solid,
    base_hits: tuple[np.ndarray, np.ndarray],
    view: View,
    stretch: np.ndarray,
    rng: np.random.Generator,
) -> list[JudgePicture]:
    start = transform(starts_like(part, rng), stretch)
    hits = visible(view.rays, base_hits, RayCaster(start), np.zeros(len(start.faces), np.int64))
    return _draw(scene, hits, view, rng, None, start)


def _draw(
    scene: _Scene,
    hits: Hits,
    view: View,
    rng: np.random.Generator,
    part: str | None = None,
    extra: Solid | None = None,
    zone_of: Callable[[np.ndarray], np.ndarray] = np.zeros_like,
) -> list[JudgePicture]:
    """The body with something extra, or without; `part` names it, None where it is no part."""
    catalogue, solid, light = scene.catalogue, scene.solid, scene.light
    on_part = hits.piece >= 0
    if extra is not None and on_part.sum() < LEAST_PIXELS * SUPERSAMPLING**2:
        return []
    covered = np.ones((len(hits.pixel), 1), np.float32)
    film = _film(hits.pixel, np.concatenate([hits.normal @ view.to_camera.T, covered, on_part[:, None]], 1))
    alpha = film[..., 3:4]
    shares = [_patches(film[..., 4]), _patches(film[..., 3])]
    number = NO_PART if part is None else list(catalogue.part_weights).index(part)
    body_number = list(catalogue.body_weights).index(scene.body)
    normals = JudgePicture(
        _bytes((film[..., :3] + alpha) / 2), Claim(body_number, number, ANY_STYLE, ANY_STYLE), *shares
    )
    body_word = str(rng.choice(STYLES)) if rng.random() < 0.45 else None
    look, style = ((), NO_STYLE) if extra is None else _part_look(part, rng, catalogue)
    zone = np.zeros_like(hits.piece) if len(look) < 2 else zone_of(hits.piece)
    paint = paint_hits(hits, solid, extra or solid, random_body_look(rng, body_word), look, zone, rng)
    linear = reflected(
        light, hits.normal, hits.to_viewer, paint.material, paint.colour, paint.roughness, paint.metallic
    )
    brightness = linear[~on_part] @ LUMINANCE
    exposure = rng.uniform(0.55, 0.95) / max(float(np.quantile(brightness, 0.95)) if len(brightness) else 1.0, 1e-6)
    background = 0.35 if rng.random() < 0.6 else rng.uniform(0.0, 0.9)
    shaded = _film(hits.pixel, linear) * exposure + background * (1 - alpha)
    claim = Claim(
        body_number, number, ANY_STYLE if part is None else style, STYLES.index(body_word) if body_word else NO_STYLE
    )
    lit = JudgePicture(_bytes(to_srgb(torch.from_numpy(shaded.astype(np.float32))).numpy()), claim, *shares)
    return [normals, lit]


def _part_look(part: str | None, rng: np.random.Generator, catalogue: Catalogue) -> tuple[tuple[Material, ...], int]:
    """Materials, and the number of the style that names them."""
    if part is None or rng.random() < 0.7:
        word = str(rng.choice(STYLES))
        return (NAMED[word],), STYLES.index(word)
    looks, style = catalogue.natural[part], catalogue.natural_styles.get(part)
    return looks[rng.integers(len(looks))], STYLES.index(style) if style else NO_STYLE


def _film(pixel: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(64, 64, C) means of values (N, C) at supersampled pixels, 0 elsewhere."""
    side, channels = SIZE * SUPERSAMPLING, values.shape[1]
    canvas = np.zeros((side * side, channels), np.float32)
    canvas[pixel] = values
    canvas = canvas.reshape(SIZE, SUPERSAMPLING, side, channels)
    rows = sum_of(canvas[:, k] for k in range(SUPERSAMPLING)).reshape(SIZE, SIZE, SUPERSAMPLING, channels)
    return sum_of(rows[:, :, k] for k in range(SUPERSAMPLING)) / np.float32(SUPERSAMPLING**2)


def _patches(share: np.ndarray) -> np.ndarray:
    cells = SIZE // PATCH
    return np.rint(255 * share.reshape(cells, PATCH, cells, PATCH).mean((1, 3))).astype(np.uint8)


def _bytes(picture: np.ndarray) -> np.ndarray:
    return np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8)


def render_shards(
    folder: Path,
    first_seed: int,
    seeds: int,
    seeds_a_shard: int = 8,
    even: bool = False,
    catalogue: Catalogue = COARSE,
) -> Iterator[Path]:
    """Write pictures as `folder/<seed>.npz`, one file for each `seeds_a_shard` seeds; files that are there are kept."""
    folder.mkdir(parents=True, exist_ok=True)
    for start in range(first_seed, first_seed + seeds, seeds_a_shard):
        path = folder / f"{start}.npz"
        if not path.is_file():
            made = [p for seed in range(start, start + seeds_a_shard) for p in random_pictures(seed, even, catalogue)]
            arrays = {
                "pixels": np.stack([p.pixels for p in made]),
                "shown": np.array([p.shown for p in made], np.int8),
                "part_share": np.stack([p.part_share for p in made]),
                "body_share": np.stack([p.body_share for p in made]),
            }
            part_file = path.with_suffix(f".{os.getpid()}")
            with open(part_file, "wb") as file:
                np.savez(file, **arrays)
            part_file.replace(path)
        yield path
