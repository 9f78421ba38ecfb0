"""What the judge of parts is trained on: views of distorted bodies before and after a distorted part was added.

What is no part, but may come out of a run, is shown too: the ellipsoids that it started from, and lumps in a part's
place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fd_mitsuba.conventions import BASE_LONGEST_SIDE
from fd_mitsuba.evaluation.part_judge import LEAST_PIXELS, changed_pixels
from fd_mitsuba.prior.data.catalogue import COARSE, Catalogue
from fd_mitsuba.prior.data.primitives import Solid, ellipsoid, join, rotation
from fd_mitsuba.prior.pictures.corpus import MosaicCamera, RayCaster, closeup_camera, shade
from fd_mitsuba.scene.vertex_normals import vertex_normals

SEEN_SEED = 2**33
"""Training draws from here on, far from the prior's seeds (below 2**31), its evaluation's and the CLIP evaluator's."""
SEEDS_APART = 2**36
"""Between the bodies of one training and those of the next `--seed`."""
UNSEEN_SEED = 2**34
CLOSEUP_SHARE = 0.25
BLOB_SHARE = 0.35
"""Parts that are also shown as the ellipsoids that a run would start from, which are no part."""


@dataclass(frozen=True)
class Views:
    """Int8 views (N, 4, 32, 32) in units of 1/127 before and after, and what was added: an index into the classes.

    `closeup` (N,) tells views centred on the part, `blob` (N,) those with ellipsoids or lumps in its place.
    """

    before: np.ndarray
    after: np.ndarray
    label: np.ndarray
    body: np.ndarray
    closeup: np.ndarray
    blob: np.ndarray

    def __len__(self) -> int:
        return len(self.label)


def make_views(body: str, seed: int, catalogue: Catalogue = COARSE, lump_share: float = 0.0) -> Views:
    """Four views of every part on one random body and of the body alone, deterministic in all arguments.

    Args:
        body: a name of the catalogue.
        seed: from `SEEN_SEED` on for training, from `UNSEEN_SEED` on for measuring.
        lump_share: of the parts, that are also shown as `lumps_of` them.
    """
    number, parts = list(catalogue.body_weights).index(body), list(catalogue.part_weights)
    rng = np.random.default_rng([seed, number])
    made = catalogue.make_body(body, rng)
    warp = _Warp(made.solid, rng)
    base = warp(made.solid)
    base_caster, camera = RayCaster(base), _overview(rng)
    rays = camera.rays()
    hits = base_caster.cast(*rays[:2])
    rows: list[tuple] = []

    def see(solid: Solid, label: int, closeup: bool, blob: bool) -> None:
        at, seen, found = camera, rays, hits
        if closeup:
            at = closeup_camera(solid, rng)
            seen = at.rays()
            found = base_caster.cast(*seen[:2])
        before = _views(shade(*found, seen[2]))
        distance, normal = RayCaster(solid).cast(*seen[:2])
        nearer = distance < found[0]
        merged = np.where(nearer, distance, found[0]), np.where(nearer[:, None], normal, found[1])
        after = _views(shade(*merged, seen[2]))
        for one, two in zip(before, after, strict=True):
            if changed_pixels(one / 127.0, two / 127.0) >= LEAST_PIXELS:
                rows.append((one, two, label, number, closeup, blob))

    for label, part in enumerate(parts):
        if not catalogue.suits(body, part):
            continue
        original = catalogue.grow(made, part, rng).solid
        solid = warp(_distorted(original, rng))
        closeup = bool(rng.random() < CLOSEUP_SHARE)
        see(solid, label, closeup, False)
        if rng.random() < BLOB_SHARE:
            see(warp(blobs_of(original, rng)), len(parts), closeup, True)
        if lump_share and rng.random() < lump_share:
            see(warp(lumps_of(original, rng)), len(parts), closeup, True)
    alone = _views(shade(*hits, rays[2]))
    rows += [(view, view, len(parts), number, False, False) for view in alone]
    return Views(*(np.array(column) for column in zip(*rows, strict=True)))


def blobs_of(part: Solid, rng: np.random.Generator) -> Solid:
    """One ellipsoid in a part's bounding box, or two where it is in two halves with a gap or often otherwise."""
    points = part.vertices
    low, high = points.min(0), points.max(0)
    between = np.abs(points[:, 0]).min() > 0.02 or (high[0] - low[0] > 0.8 and rng.random() < 0.5)
    groups = [points[points[:, 0] > 0], points[points[:, 0] <= 0]] if between and low[0] < -0.02 else [points]
    solids = []
    for group in (g for g in groups if len(g)):
        centre, half = (group.min(0) + group.max(0)) / 2, np.ptp(group, axis=0) / 2
        half = np.maximum(half * rng.uniform(0.7, 1.15, 3), 0.05)
        solids.append(ellipsoid(centre, half, rotation(*rng.uniform(-12, 12, 3))))
    return join(solids)


def lumps_of(part: Solid, rng: np.random.Generator) -> Solid:
    """Two to six bent ellipsoids at random vertices of a part, as large as a third of it: what a run that failed grows.

    They fill the part's place and have none of its form.
    """
    size = np.ptp(part.vertices, axis=0)
    lumps = []
    for _ in range(rng.integers(2, 7)):
        centre = part.vertices[rng.integers(len(part.vertices))] * 0.8 + part.vertices.mean(0) * 0.2
        half = np.maximum(size.max() * rng.uniform(0.08, 0.3) * rng.uniform(0.5, 1.3, 3), 0.03)
        lump = ellipsoid(centre, half, rotation(*rng.uniform(-90, 90, 3)))
        waves = rng.normal(size=(3, 3)) * (2.0 / half.max())
        bumps = np.sin(lump.vertices @ waves + rng.uniform(0, 6, 3)) @ rng.normal(size=(3, 3))
        lumps.append(Solid(lump.vertices + bumps * (half.min() * rng.uniform(0, 0.25)), lump.faces))
    return join(lumps)


class _Warp:
    """A smooth bend, other proportions and a slight turn, the same for a body and its part; canonical frame after."""

    def __init__(self, body: Solid, rng: np.random.Generator) -> None:
        turn = rotation(*rng.uniform([-4, -10, -3], [4, 10, 3]))
        self._linear = turn @ np.diag(rng.uniform(0.85, 1.15, 3))
        self._waves, self._phases = rng.normal(size=(3, 3)) * 1.5, rng.uniform(0, 2 * np.pi, 3)
        self._shifts = rng.normal(size=(3, 3)) * rng.uniform(0, 0.02)
        self._inflate = rng.uniform(-0.01, 0.02)
        self._centre, self._scale = np.zeros(3), 1.0
        points = self(body).vertices
        low, high = points.min(0), points.max(0)
        self._centre, self._scale = (low + high) / 2, BASE_LONGEST_SIDE / (high - low).max()

    def __call__(self, solid: Solid) -> Solid:
        points = solid.vertices @ self._linear.T
        points = points + np.sin(points @ self._waves + self._phases) @ self._shifts
        points = points + self._inflate * vertex_normals(points, solid.faces, weights="area")
        return Solid((points - self._centre) * self._scale, solid.faces)


def _distorted(part: Solid, rng: np.random.Generator) -> Solid:
    """The part with other proportions, a little turned, moved, bent, and thinner or thicker."""
    low, high = part.vertices.min(0), part.vertices.max(0)
    middle, size = (low + high) / 2, (high - low).max()
    linear = rotation(*rng.uniform(-8, 8, 3)) @ np.diag(rng.uniform(0.85, 1.15, 3) * rng.uniform(0.9, 1.1))
    points = (part.vertices - middle) @ linear.T
    waves = rng.normal(size=(3, 3)) * (4.0 / size)
    points += np.sin(points @ waves + rng.uniform(0, 6, 3)) @ rng.normal(size=(3, 3)) * (size * rng.uniform(0, 0.02))
    points += rng.uniform(-0.01, 0.02) * vertex_normals(points, part.faces, weights="area")
    return Solid(points + middle + rng.normal(size=3) * 0.015, part.faces)


def _overview(rng: np.random.Generator) -> MosaicCamera:
    fov = 2 * np.rad2deg(np.arctan(rng.uniform(1.05, 1.5) / 3.0))
    target = np.array([rng.uniform(-0.1, 0.1), rng.uniform(-0.25, 0.35), rng.uniform(-0.1, 0.1)])
    return MosaicCamera(rng.uniform(0, 90), rng.uniform(-10, 45), fov, target)


def _views(mosaic: np.ndarray) -> np.ndarray:
    """The four views (4, C, 32, 32) of a mosaic (C, 64, 64)."""
    channels, side = mosaic.shape[0], mosaic.shape[1] // 2
    return mosaic.reshape(channels, 2, side, 2, side).transpose(1, 3, 0, 2, 4).reshape(4, channels, side, side)
