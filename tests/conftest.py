"""Fixtures that several test files share: Mitsuba, a small animal, and scenes written into a temporary folder."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jaxtyping
import numpy as np
import pytest
from shape_checks import PLACES

jaxtyping.install_import_hook(PLACES, "shape_checks.checked")  # before anything imports them

INTEGRATOR = """<integrator type="dual_path">
    <string name="prompt" value="a pig with two wings"/>
    <string name="base_prompt" value="a pig"/>
  </integrator>"""
LIGHT = '<emitter type="constant" id="light"/>'
BASE = '<shape type="ply" id="body"><string name="filename" value="animal.ply"/><bsdf type="diffuse"/></shape>'
PART = '<bsdf type="principled" id="part"><float name="roughness" value="0.5"/></bsdf>'
REGION = """<shape type="focal_region" id="wing">
    <transform name="to_world"><scale x="0.12" y="0.25" z="0.15"/><translate x="0" y="0.35" z="0"/></transform>
  </shape>"""


def pytest_collection_finish() -> None:
    """Spares later collections the modules and test items, which stay: each takes a fraction of a second otherwise."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def mi() -> Any:
    """Mitsuba with the default variant and the plugins of fd_mitsuba."""
    from fd_mitsuba.scene.scene_file import ready_mitsuba

    return ready_mitsuba()


@pytest.fixture(scope="module", autouse=True)
def _no_scenes_of_other_files() -> None:
    """Frees what earlier test files left in reference cycles, such as the frames of caught exceptions.

    A render is traced through every BSDF and texture that is alive in the process, in use or not, and fails where one
    of them cannot do what is asked: a checkerboard as bump map is enough.
    """
    gc.collect()
    gc.freeze()


@pytest.fixture
def one_thread(mi: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Sums are added up in one order, so that the same seed gives the same bytes.

    More threads round differently, and Adam makes whole steps of gradients that are nothing but rounding.
    """
    import drjit as dr
    import torch

    # What an earlier test in this process, as one of the Python API, has shared out for good.
    monkeypatch.setattr("fd_mitsuba.backend.threads._cores", 1)
    before = dr.thread_count(), torch.get_num_threads()
    dr.set_thread_count(1)
    torch.set_num_threads(1)
    yield
    dr.set_thread_count(before[0])
    torch.set_num_threads(before[1])


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray) -> Path:
    """An ASCII PLY file; nothing is checked, so that broken meshes can be written too."""
    lines = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    lines += [" ".join(f"{value:.9g}" for value in vertex) for vertex in vertices]
    lines += ["3 " + " ".join(str(int(index)) for index in face) for face in faces]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="session")
def animal() -> tuple[np.ndarray, np.ndarray]:
    """A four-legged blob that faces +z, closed, about 1000 faces: vertices (V, 3) in user units and faces (F, 3)."""
    from skimage.measure import marching_cubes

    balls = [((0, 0, 0), (0.28, 0.26, 0.45)), ((0, 0.22, 0.52), (0.2, 0.2, 0.22))]
    balls += [((x, -0.3, z), (0.09, 0.28, 0.09)) for x in (-0.16, 0.16) for z in (-0.26, 0.26)]
    balls += [((x, 0.42, 0.5), (0.06, 0.12, 0.05)) for x in (-0.12, 0.12)]
    size = 20
    axis = np.linspace(-1, 1, size)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    level = np.max([1 - np.linalg.norm((grid - centre) / radii, axis=-1) for centre, radii in balls], axis=0)
    vertices, faces, _, _ = marching_cubes(level, 0.0, gradient_direction="ascent")
    vertices = vertices * (2 / (size - 1)) - 1
    corners = vertices[faces]
    if np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) < 0:
        faces = faces[:, ::-1]
    return vertices.astype(np.float64), faces.astype(np.int64)


SceneWriter = Callable[..., Path]


@pytest.fixture
def make_scene(tmp_path: Path, animal: tuple[np.ndarray, np.ndarray]) -> SceneWriter:
    """A function that writes `scene.xml` beside `animal.ply` and returns its path; each piece can be replaced."""

    def make(
        *,
        integrator: str = INTEGRATOR,
        light: str = LIGHT,
        base: str = BASE,
        part: str = PART,
        region: str = REGION,
        extra: str = "",
        root: str = '<scene version="3.0.0">',
    ) -> Path:
        write_ply(tmp_path / "animal.ply", *animal)
        path = tmp_path / "scene.xml"
        path.write_text("\n  ".join([root, extra, integrator, light, base, part, region]) + "\n</scene>\n")
        return path

    return make
