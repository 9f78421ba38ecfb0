"""Noise in space: what makes coats furry, wood grained and stone speckled. Seeded, the same on every machine."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.ndimage import map_coordinates

_SIDE = 64


@lru_cache(maxsize=8)
def _table(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (_SIDE, _SIDE, _SIDE)).astype(np.float32)


def value_noise(p: np.ndarray, frequency: float, seed: int) -> np.ndarray:
    """(N,) smooth noise in [-1, 1] with `frequency` bumps a unit of length; repeats after 64 bumps."""
    # Irrational offsets keep the lattice's planes away from the models' planes of symmetry.
    at = (p * frequency + np.array([0.371, 17.618, 5.093])).T
    whole = np.floor(at)
    part = at - whole
    return map_coordinates(_table(seed), whole + part * part * (3 - 2 * part), order=1, mode="grid-wrap")


def cloud(p: np.ndarray, frequency: float, seed: int, octaves: int = 4) -> np.ndarray:
    """(N,) noise of several scales, roughly in [-1, 1], each octave twice as fine and half as strong."""
    total = np.zeros(len(p), np.float32)
    for octave in range(octaves):
        total += value_noise(p, frequency * 2**octave, seed + octave) * 0.5**octave
    return total / 1.5


def strands(p: np.ndarray, along: np.ndarray, frequency: float, length: float, seed: int) -> np.ndarray:
    """(N,) noise drawn out along the directions `along` (N, 3) over `length`, like hair; roughly in [-1, 1]."""
    steps = np.linspace(-0.5, 0.5, 9)
    total = sum(value_noise(p + along * (step * length), frequency, seed) for step in steps)
    return np.clip(total / len(steps) * 2.2, -1, 1)


def rings(p: np.ndarray, centre: tuple[float, float], spacing: float, seed: int) -> np.ndarray:
    """(N,) in [0, 1]: the growth rings of a trunk along z whose pith is at x, y = `centre`, wobbly as in real wood."""
    wobble = 0.55 * cloud(p * np.array([1, 1, 0.25]), 0.45 / spacing / 4, seed, 3)
    radius = np.hypot(p[:, 0] - centre[0], p[:, 1] - centre[1]) / spacing + wobble * 4
    saw = radius - np.floor(radius)
    return saw**2.5
