"""What a run has made so far: what the page shows of it, and what can be taken away."""

from __future__ import annotations

import io
import subprocess
import sys
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fd_mitsuba.errors import UserError
from fd_mitsuba.export.part_record import part_file
from fd_mitsuba.io.ply import read_ply
from fd_mitsuba.scene.normalisation import Normalisation
from fd_mitsuba.studio.base_glb import only_parts
from fd_mitsuba.studio.run_state import FINISHED, RunState

FORMATS = ("GLB", "OBJ", "PLY", "Mitsuba scene")
"""What the page offers to download."""


@dataclass(frozen=True)
class ShownPart:
    """Attributes:
    key: changes with what is shown.
    vertices: (V, 3) canonical.
    faces: (F, 3).
    glb: with the learned material, user frame; None: clay.
    whole: whether the GLB has the base in it, as after a cut.
    """

    key: str
    vertices: np.ndarray
    faces: np.ndarray
    glb: bytes | None = None
    whole: bool = False


def shown_key(run: RunState) -> str:
    """What `shown_part` would show now; "" for nothing."""
    if run.state == FINISHED and (run.folder / "export" / "asset.glb").is_file():
        return f"{run.name} finished"
    if run.stage == "appearance" and _part_names(run.folder):
        return f"{run.name} material {run.material_step if run.live_material.is_file() else 0}"
    return f"{run.name} live {run.mesh_step}" if run.mesh_step and run.live_mesh.is_file() else ""


def shown_part(run: RunState, frame: Normalisation) -> ShownPart | None:
    """The newest that there is of a run's part: as it grows, then with the material learned so far, then as exported;
    None: nothing yet.

    Args:
        frame: of the base that it is shown with.

    Raises:
        UserError: a file of the run was damaged.
    """
    key = shown_key(run)
    if not key:
        return None
    names = _part_names(run.folder)
    paths = [run.live_mesh] if " live " in key else [run.folder / "export" / part_file(name) for name in names]
    meshes = [read_ply(path) for path in paths]
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    vertices = frame.to_canonical(np.concatenate([vertices for vertices, _ in meshes]))
    faces = np.concatenate([faces + start for (_, faces), start in zip(meshes, starts, strict=False)])
    if not key.endswith(" finished"):
        learned = " material " in key and not key.endswith(" 0")
        return ShownPart(key, vertices, faces, _read(run.live_material) if learned else None)
    asset = (run.folder / "export" / "asset.glb").read_bytes()
    cut = any((run.folder / "export").glob("cut_face_*.ply"))
    return ShownPart(key, vertices, faces, asset if cut else only_parts(asset, names), cut)


def whole_result(run: RunState) -> bytes:
    """A finished run's GLB: base and part with their materials, user frame.

    Raises:
        UserError: it is not there.
    """
    return _read(run.folder / "export" / "asset.glb")


def download(run: RunState, wanted: str) -> tuple[str, bytes]:
    """File name and bytes of a finished run's result.

    OBJ and PLY are exported when they are asked for, by a process of its own, which takes some seconds.

    Args:
        wanted: one of `FORMATS`.

    Raises:
        UserError: the run is not finished, or the export failed.
    """
    export = run.folder / "export"
    if run.state != FINISHED:
        raise UserError(f"run {run.name}: has no result yet; let it finish first")
    stem = f"part_{run.name}"
    if wanted == "GLB":
        return f"{stem}.glb", whole_result(run)
    if wanted == "Mitsuba scene":
        return f"{stem}_mitsuba.zip", _zipped(export / "mitsuba")
    kind = wanted.lower()
    if not (export / kind).is_dir():
        _export(run.folder, kind)
    return f"{stem}_{kind}.zip", _zipped(export / kind)


def _export(folder: Path, kind: str) -> None:
    command = [sys.executable, "-m", "fd_mitsuba", "export", str(folder), "--format", kind]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["the export failed"])[-1]
        raise UserError(last.removeprefix("fd_mitsuba: error: "))


def _part_names(folder: Path) -> list[str]:
    found = (folder / "export").glob("part_*.ply")
    return sorted(path.stem.removeprefix("part_") for path in found)


def _zipped(folder: Path) -> bytes:
    if not folder.is_dir():
        raise UserError(f"{folder.name}: is not there; export the run anew")
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file() and not path.name.startswith("."):
                archive.write(path, path.relative_to(folder).as_posix())
    return memory.getvalue()


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:
        raise UserError(f"{path.name}: is not there; export the run anew") from None
