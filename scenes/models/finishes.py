"""Fine patterns for whole models: coats of hair, wood, stone, glaze, patina."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from models.model import Finish, Look
from models.noise import cloud, rings, strands

Field = Callable[[np.ndarray], np.ndarray]


def standing_coat(p: np.ndarray, belly: float, neck: tuple[float, float]) -> np.ndarray:
    """(N, 3) directions in which the hair of a standing animal lies: back along the body, down the legs and the neck.

    Args:
        belly: height below which the legs are.
        neck: z from which on the hair turns downwards, and over how much.
    """
    legs = np.clip((belly - p[:, 1]) / (0.25 * belly) + 0.5, 0, 1)
    front = 0.6 * np.clip((p[:, 2] - neck[0]) / neck[1], 0, 1)
    down = np.maximum(legs, front)
    return np.column_stack([np.zeros(len(p)), -down - 0.15, -(1 - 0.85 * legs)])


def fur(flow: Field, size: float, strength: float = 0.35, mottle: float = 0.12) -> Finish:
    """Hair of about `size` length that lies along `flow`; the roots are darker by `strength`, patches by `mottle`."""

    def finish(p: np.ndarray, normals: np.ndarray, looks: np.ndarray, seed: int) -> np.ndarray:
        along = flow(p)
        along = along - np.einsum("ij,ij->i", along, normals)[:, None] * normals
        along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-6)
        hair = strands(p, along, 4.2 / size, 1.5 * size, seed)
        patch = cloud(p, 0.35 / size, seed + 10)
        soft = np.clip((looks[:, 3] - 0.3) / 0.15, 0, 1)  # eyes and noses shine and have no hair
        shade = 1 + soft * (strength * hair + mottle * patch)
        result = looks.copy()
        result[:, :3] *= shade[:, None]
        return result

    return finish


def plush(size: float, strength: float = 0.3) -> Finish:
    """Short pile that stands up: speckles without a direction."""

    def finish(p: np.ndarray, normals: np.ndarray, looks: np.ndarray, seed: int) -> np.ndarray:
        soft = np.clip((looks[:, 3] - 0.3) / 0.15, 0, 1)
        shade = 1 + soft * strength * (0.7 * cloud(p, 2.2 / size, seed, 2) + 0.5 * cloud(p, 0.4 / size, seed + 10, 2))
        result = looks.copy()
        result[:, :3] *= shade[:, None]
        return result

    return finish


def wood(dark: Look, spacing: float, turned: Field | None = None) -> Finish:
    """Growth rings and pores mixed towards `dark`; `turned` maps points so that the trunk runs along z."""

    def finish(p: np.ndarray, normals: np.ndarray, looks: np.ndarray, seed: int) -> np.ndarray:
        q = p if turned is None else turned(p)
        ring = rings(q, (0.35 * spacing * 20, -0.6 * spacing * 20), spacing, seed)
        pores = strands(q, np.tile(np.array([0.0, 0.0, 1.0]), (len(q), 1)), 2.5 / spacing, 4 * spacing, seed + 20)
        share = np.clip(0.75 * ring + 0.22 * np.maximum(pores, 0), 0, 1)[:, None]
        result = looks.copy()
        result[:, :3] = looks[:, :3] * (1 - share) + looks[:, :3] * np.array(dark[:3]) * share
        result[:, 3] += 0.12 * share[:, 0]
        return result

    return finish


def mottled(size: float, strength: float, grit: float = 0.0, rough: float = 0.0) -> Finish:
    """Cloudy variation over `size`, fine grit, and a roughness that follows the clouds by `rough`."""

    def finish(p: np.ndarray, normals: np.ndarray, looks: np.ndarray, seed: int) -> np.ndarray:
        patch = cloud(p, 1 / size, seed, 5)
        fine = cloud(p, 14 / size, seed + 10, 2)
        result = looks.copy()
        result[:, :3] *= (1 + strength * patch + grit * fine)[:, None]
        result[:, 3] -= rough * patch
        return result

    return finish


def patina(green: Look, size: float) -> Finish:
    """Metal that is polished where it bulges up and outwards and greenish in between."""

    def finish(p: np.ndarray, normals: np.ndarray, looks: np.ndarray, seed: int) -> np.ndarray:
        under = np.clip(0.25 - 0.75 * normals[:, 1], 0, 1)
        share = np.clip(under + 1.3 * cloud(p, 1 / size, seed, 5) - 0.1, 0, 0.85)[:, None]
        result = looks.copy()
        result[:, :3] = looks[:, :3] * (1 - share) + np.array(green[:3]) * share
        result[:, 3] = looks[:, 3] + 0.3 * share[:, 0]
        return result

    return finish
