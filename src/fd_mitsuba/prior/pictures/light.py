"""Light for the colour pictures: small environments, and what a surface sends back under one of them.

An environment is (HEIGHT, WIDTH, 3) linear radiance over latitude and longitude, laid out as Mitsuba's `envmap`: up is
+y, row 0 is the zenith, column u = atan2(x, -z) / 2 pi. Blurring it with a kernel that depends on the angle alone is a
circular convolution along the longitudes, so a blurred copy for every roughness costs a few matrix products.

A surface is Lambert's diffuse part plus the split sum: the reflection blurred by the GGX lobe, times the average of the
Fresnel factor. No shadows, no bounces.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fd_mitsuba.backend.startup import start

HEIGHT, WIDTH = 32, 64
ROUGHNESSES = (0.15, 0.25, 0.4, 0.55, 0.75, 1.0)
HDR_FOLDER = Path(__file__).resolve().parents[4] / "scenes" / "lighting"
HDR_SHARE = 0.5
DIELECTRIC_F0 = 0.04
_LOBE_SAMPLES = 256


class Light(NamedTuple):
    """An environment ready for lookups: `diffuse` (H W, 3) irradiance / pi, `glossy` (roughnesses, H W, 3)."""

    diffuse: np.ndarray
    glossy: np.ndarray

    def glossy_at(self, roughness: float) -> np.ndarray:
        """Blurred radiance (H W, 3) for any roughness, between the two nearest ones."""
        place = float(np.interp(roughness, ROUGHNESSES, np.arange(len(ROUGHNESSES))))
        low = min(int(place), len(ROUGHNESSES) - 2)
        share = np.float32(place - low)
        return (1 - share) * self.glossy[low] + share * self.glossy[low + 1]


def directions() -> np.ndarray:
    """Unit vectors (HEIGHT, WIDTH, 3) of the environment's pixels."""
    polar = (np.arange(HEIGHT) + 0.5) * np.pi / HEIGHT
    around = (np.arange(WIDTH) + 0.5) * 2 * np.pi / WIDTH
    x, z = np.sin(polar)[:, None] * np.sin(around), -np.sin(polar)[:, None] * np.cos(around)
    return np.stack([x, np.broadcast_to(np.cos(polar)[:, None], x.shape), z], -1)


def pixel_of(direction: np.ndarray) -> np.ndarray:
    """Flat pixel index (N,) that unit vectors (N, 3) point at."""
    row = np.arccos(np.clip(direction[:, 1], -1, 1)) * (HEIGHT / np.pi)
    column = np.arctan2(direction[:, 0], -direction[:, 2]) * (WIDTH / (2 * np.pi))
    return np.minimum(row.astype(np.int64), HEIGHT - 1) * WIDTH + np.floor(column).astype(np.int64) % WIDTH


def lit_by(environment: np.ndarray) -> Light:
    """The light of an environment (HEIGHT, WIDTH, 3)."""
    spectrum = np.fft.rfft(environment, axis=1)
    blurred = np.einsum("koif,ifc->kofc", _kernels(), spectrum, optimize=True)
    maps = np.fft.irfft(blurred, WIDTH, axis=2).astype(np.float32).reshape(len(ROUGHNESSES) + 1, -1, 3)
    return Light(maps[0], maps[1:])


@cache
def _kernels() -> np.ndarray:
    """Fourier coefficients along longitude (1 + roughnesses, rows, rows, frequencies): the cosine, then GGX lobes."""
    unit = directions()
    solid_angle = np.sin((np.arange(HEIGHT) + 0.5) * np.pi / HEIGHT)
    cosine = np.clip(np.einsum("ok,iwk->oiw", unit[:, 0], unit), 0, 1)
    half_squared = (1 + cosine) / 2  # squared cosine between the lobe's axis and the half vector
    weights = [cosine]
    for roughness in ROUGHNESSES:
        # A lobe narrower than a pixel would fall between the pixels.
        alpha = max(roughness**2, 0.06)
        weights.append(cosine / (half_squared * (alpha**2 - 1) + 1) ** 2)
    kernels = np.stack(weights) * solid_angle[:, None]
    kernels /= kernels.sum((2, 3), keepdims=True)
    # Output column 0 reads input column w at distance w; a circular correlation, hence the conjugate.
    return np.conj(np.fft.rfft(kernels, axis=3))


@cache
def _fresnel_table() -> tuple[np.ndarray, np.ndarray]:
    """Factor and offset (roughnesses, 32 cosines): the lobe reflects F0 factor + offset of white light (split sum)."""
    cosine = (np.arange(32) + 0.5) / 32
    first = (np.arange(_LOBE_SAMPLES) + 0.5) / _LOBE_SAMPLES
    angle = 2 * np.pi * ((np.arange(_LOBE_SAMPLES) * 0.6180339887) % 1)
    factor, offset = np.zeros((2, len(ROUGHNESSES), 32))
    view = np.stack([np.sqrt(1 - cosine**2), np.zeros(32), cosine], -1)
    for row, roughness in enumerate(ROUGHNESSES):
        alpha = roughness**2
        up = np.sqrt((1 - first) / (1 + (alpha**2 - 1) * first))
        side = np.sqrt(1 - up**2)
        half = np.stack([side * np.cos(angle), side * np.sin(angle), up], -1)
        view_half = np.clip(view @ half.T, 1e-6, 1)
        light_up = 2 * view_half * up - cosine[:, None]

        def smith(c: np.ndarray, alpha: float = alpha) -> np.ndarray:
            return 2 * c / (c + np.sqrt(alpha**2 + (1 - alpha**2) * c**2))

        lit = np.clip(light_up, 1e-6, 1)
        visible = np.where(light_up > 0, smith(lit) * smith(cosine[:, None]) * view_half / (up * cosine[:, None]), 0)
        schlick = (1 - view_half) ** 5
        factor[row], offset[row] = (visible * (1 - schlick)).mean(1), (visible * schlick).mean(1)
    return factor.astype(np.float32), offset.astype(np.float32)


def lobes(
    light: Light, normal: np.ndarray, to_viewer: np.ndarray, zone: np.ndarray, roughness: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Radiances (N, 3) diffuse, tinted, white; the surface sends base_color (1 - metallic) diffuse + F0 tinted + white.

    Args:
        normal, to_viewer: unit vectors (N, 3).
        zone: (N,) which of the roughnesses (Z,) a point has.
    """
    cosine = np.einsum("ij,ij->i", normal, to_viewer)
    mirrored = 2 * cosine[:, None] * normal - to_viewer
    glossy = np.stack([light.glossy_at(float(r)) for r in roughness])[zone, pixel_of(mirrored)]
    level = np.rint(np.interp(roughness, ROUGHNESSES, np.arange(len(ROUGHNESSES)))).astype(int)[zone]
    column = np.clip((cosine * 32).astype(int), 0, 31)
    factor, offset = (table[level, column, None] for table in _fresnel_table())
    return light.diffuse[pixel_of(normal)], glossy * factor, glossy * offset


def reflected(
    light: Light,
    normal: np.ndarray,
    to_viewer: np.ndarray,
    zone: np.ndarray,
    base_color: np.ndarray,
    roughness: np.ndarray,
    metallic: np.ndarray,
) -> np.ndarray:
    """Linear radiance (N, 3) of points with a linear base colour (N, 3) and the rest (Z,) by zone; see `lobes`."""
    diffuse, tinted, white = lobes(light, normal, to_viewer, zone, roughness)
    metal = metallic[zone][:, None]
    f0 = DIELECTRIC_F0 * (1 - metal) + base_color * metal
    return base_color * (1 - metal) * diffuse + f0 * tinted + white


def random_environment(rng: np.random.Generator) -> np.ndarray:
    """A turned HDR picture of the repository or an invented sky (HEIGHT, WIDTH, 3); exposure is up to the caller."""
    pictures = _hdr_pictures()
    if pictures and rng.random() < HDR_SHARE:
        environment = pictures[rng.integers(len(pictures))]
    else:
        environment = _invented_sky(rng)
    environment = environment * rng.uniform(0.9, 1.1, 3)
    turned = np.roll(environment, int(rng.integers(WIDTH)), axis=1)
    return (turned[:, ::-1] if rng.random() < 0.5 else turned).astype(np.float32)


def _invented_sky(rng: np.random.Generator) -> np.ndarray:
    """A gradient from ground over horizon to zenith, a sun, and up to three soft boxes."""
    unit = directions()
    up = unit[..., 1:2]
    tint = rng.uniform(0.85, 1.15, (3, 3))
    ground, horizon, zenith = tint * (rng.uniform([0.1, 0.4, 0.3], [0.5, 1.2, 1.2]))[:, None]
    high, deep = np.clip(up, 0, 1) ** 0.6, np.clip(-4 * up, 0, 1)
    sky = np.where(up > 0, horizon + (zenith - horizon) * high, horizon + (ground - horizon) * deep)
    lamps = [(rng.uniform(6, 14), rng.uniform(2, 25), rng.uniform(20, 75))]
    lamps += [(rng.uniform(15, 35), rng.uniform(0.5, 4), rng.uniform(-20, 70)) for _ in range(rng.integers(4))]
    for width_deg, strength, elevation_deg in lamps:
        elevation, azimuth = np.deg2rad(elevation_deg), rng.uniform(0, 2 * np.pi)
        axis = [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
        lobe = np.exp((unit @ axis - 1) / (1 - np.cos(np.deg2rad(width_deg))))
        sky = sky + strength * lobe[..., None] * rng.uniform(0.85, 1.1, 3)
    return sky


@cache
def _hdr_pictures() -> tuple[np.ndarray, ...]:
    return tuple(read_environment(path) for path in sorted(HDR_FOLDER.glob("*.exr")))


def read_environment(path: Path) -> np.ndarray:
    """An HDR picture averaged down to (HEIGHT, WIDTH, 3), its mean brought to 1."""
    from fd_mitsuba.backend.file_threads import file_threads

    mi = start()
    with file_threads():
        bitmap = mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False)
        picture = np.array(bitmap)
    small = np.stack([_averaged(picture[..., k]) for k in range(3)], -1)
    return small / small.mean()


def _averaged(picture: np.ndarray) -> np.ndarray:
    """Area means over HEIGHT x WIDTH cells of any picture at least as large."""
    for axis, count in ((0, HEIGHT), (1, WIDTH)):
        edges = np.round(np.linspace(0, picture.shape[axis], count + 1)).astype(int)
        picture = np.add.reduceat(picture, edges[:-1], axis) / np.expand_dims(np.diff(edges), 1 - axis)
    return picture
