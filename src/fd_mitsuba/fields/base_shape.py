"""The base's signed distance at fixed points: a constant of the run, computed once and cached by content."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from pathlib import Path

import numpy as np

from fd_mitsuba.scene.mesh_distance import MeshDistance

EXACT_SHARE = 0.04
"""Distances up to this share of the longest side of the points' box are exact: 0.08 for the canonical grid cube."""

_EXACT_BELOW = 60_000
_CELLS = 32
_VERSION = b"fd_mitsuba base_sdf 2"
_DIGEST = hashlib.sha256().digest_size


def base_sdf(
    points: np.ndarray, vertices: np.ndarray, faces: np.ndarray, cache_dir: Path | str | None = None
) -> np.ndarray:
    """Signed distance (N,) float32 from `points` to the base's surface, inside positive.

    Inside is where the absolute generalised winding number exceeds 1/2, so that open meshes, overlapping components,
    duplicate vertices and meshes turned inside out have an inside. A hole is closed by the level 1/2 of that number;
    there the value jumps, since no surface is near.

    Near the surface the value is exact. With many points, those in a cell of a coarse lattice whose corners all lie
    on one side and farther than `EXACT_SHARE` of the lattice's longest side plus a cell's diagonal are interpolated
    from the corners: the sign is right, and the error below half a cell's diagonal (0.017 was the largest seen on the
    canonical grid, at ridges of the distance field), since a distance changes no faster than one moves.

    Args:
        points: (N, 3), same frame and unit as `vertices`; finite.
        vertices: (V, 3) finite. faces: (F, 3) indices, F >= 1.
        cache_dir: where results are kept; None takes `$XDG_CACHE_HOME/fd_mitsuba`. A cache that cannot be written is
            not used; a damaged entry is computed anew.
    """
    points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
    vertices = np.ascontiguousarray(vertices, dtype=np.float64)
    faces = np.ascontiguousarray(faces, dtype=np.int64)
    entry = _cache_folder(cache_dir) / f"{_content_hash(points, vertices, faces)}.sdf"
    cached = _read(entry, len(points))
    if cached is not None:
        return cached
    mesh = MeshDistance(vertices, faces)
    # An exact lattice only pays off where it has fewer nodes than there are points.
    values = mesh.signed(points) if len(points) <= _EXACT_BELOW else _near_exact(mesh, points)
    result = values.astype(np.float32)
    _write(entry, result)
    return result


def _near_exact(mesh: MeshDistance, points: np.ndarray) -> np.ndarray:
    low, high = points.min(axis=0), points.max(axis=0)
    longest = float((high - low).max())
    # Cubic cells, so that one diagonal bounds the error; the count follows the points, 32 for 275k, 48 for 2.1M.
    cell = longest / min(max(_CELLS, round(_CELLS * (len(points) / 275_000) ** 0.2)), 64)
    count = np.maximum(np.ceil((high - low) / cell).astype(np.int64), 1)
    axes = [low[i] + cell * np.arange(count[i] + 1) for i in range(3)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    node_values = mesh.signed(nodes.reshape(-1, 3)).reshape(nodes.shape[:3])

    corners = np.stack(
        [
            node_values[i : i + count[0], j : j + count[1], k : k + count[2]]
            for i in (0, 1)
            for j in (0, 1)
            for k in (0, 1)
        ]
    )
    one_sided = np.all(corners > 0, axis=0) | np.all(corners < 0, axis=0)
    far = one_sided & (np.abs(corners).min(axis=0) > EXACT_SHARE * longest + np.sqrt(3.0) * cell)

    place = (points - low) / cell
    index = np.clip(place.astype(np.int64), 0, count - 1)
    flat = np.ravel_multi_index(index.T, count)
    is_far = far.reshape(-1)[flat]
    result = np.empty(len(points))
    result[~is_far] = mesh.signed(points[~is_far])
    weight = (place - index)[is_far]
    eight = corners.reshape(8, -1)[:, flat[is_far]]
    x, y, z = weight.T
    along_z = eight[0::2] * (1 - z) + eight[1::2] * z
    along_y = along_z[0::2] * (1 - y) + along_z[1::2] * y
    result[is_far] = along_y[0] * (1 - x) + along_y[1] * x
    return result


def _content_hash(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> str:
    digest = hashlib.sha256(_VERSION)
    for array in (points, vertices, faces):
        digest.update(str(array.shape).encode())
        digest.update(array.data)
    return digest.hexdigest()[:32]


def _cache_folder(given: Path | str | None) -> Path:
    if given is not None:
        return Path(given)
    home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(home) / "fd_mitsuba"


def _read(entry: Path, count: int) -> np.ndarray | None:
    """The cached values, or None if there are none or the file is not what was written."""
    try:
        data = entry.read_bytes()
    except OSError:
        return None
    if len(data) != _DIGEST + 4 * count or hashlib.sha256(data[_DIGEST:]).digest() != data[:_DIGEST]:
        return None
    return np.frombuffer(data, dtype="<f4", offset=_DIGEST).astype(np.float32)


def _write(entry: Path, values: np.ndarray) -> None:
    payload = values.astype("<f4").tobytes()
    temporary = None
    try:
        entry.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=entry.parent, prefix=entry.stem, suffix=".tmp", delete=False) as file:
            temporary = file.name
            file.write(hashlib.sha256(payload).digest() + payload)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, entry)
    except OSError:
        # A full or read-only cache costs time, not the run.
        if temporary is not None:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
